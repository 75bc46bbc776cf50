"""Estimators that would drop a gradient in silence are refused where somebody asks for it."""

import pytest
import torch

import fmtorch
from tests.laws import scene
from tests.variants import built, keywords, variants


def says_what_gradients_reach(name: str) -> bool:
    """Whether a preset is of our own; peers may not be installed."""
    try:
        return hasattr(built("estimator", name), "gradients_reach")
    except ImportError:
        return False


OWN = [name for name in variants("estimator") if says_what_gradients_reach(name) and name != "homography"]
C = scene(1, 60, outliers=0.2)


REFUSED = {
    "paper/usac": ("x0", "prior"),
    **dict.fromkeys((name for name in OWN if name.startswith("paper/") and name != "paper/usac"), ("prior",)),
}
"""Gradients that the final fit takes no account of: that of paper/usac is none, those of the others are unweighted."""


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize("field", ["x0", "prior"])
def test_a_gradient_arrives_or_is_refused(name: str, field: str) -> None:
    values = {key: getattr(C, key).double() for key in ("x0", "x1", "prior")}
    asked = values[field].requires_grad_()
    if field in REFUSED.get(name, ()):
        said = f"{field} requires a gradient, and the final fit of estimator={name.partition(':')[0]} passes none"
        with pytest.raises(ValueError, match=said):
            fmtorch.find_fundamental(**values, **keywords(name), key=C.key)
        return
    estimate = fmtorch.find_fundamental(**values, **keywords(name), key=C.key)
    (gradient,) = torch.autograd.grad(estimate.F.square().sum() + estimate.F.sum(), asked)
    assert bool(gradient.any())


@pytest.mark.parametrize("name", ["paper/usac", "paper/cf_ransac"])
def test_without_a_gradient_they_go_on(name: str) -> None:
    x0 = C.x0.double().requires_grad_()
    with torch.no_grad():
        assert bool(fmtorch.find_fundamental(x0, C.x1, prior=C.prior, estimator=name).ok)
    assert bool(fmtorch.find_fundamental(x0.detach(), C.x1, prior=C.prior, estimator=name).ok)
