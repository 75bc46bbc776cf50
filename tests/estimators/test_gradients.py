"""Gradients of estimates: those of the fit and of the optimum, zero for failed pairs, and no change of any value."""

from collections.abc import Mapping

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.core import Correspondences, collate
from fmtorch.estimators import IterativelyReweighted, Ransac, final_fits
from fmtorch.geometry import LOSSES
from tests.estimators.models.photographs import TALL, WIDE, photographs
from tests.laws import degenerate, scene

VARIABLES = ("x0", "x1", "prior", "noise")
SEARCH = {"hypotheses": 200, "round": 200, "confidence": None, "refit_inliers": False, "inlier_threshold": 3.0}
REFINED = {"refine": {"loss": "truncated"}, "select": {"scale": 1.0}, "pool": 4}
CAMERAS = "adaptive, with cameras"
FITS: Mapping[str, Mapping[str, object]] = {
    "least_squares": {"final": "least_squares"},
    "unweighted_least_squares": {"final": "unweighted_least_squares"},
    "gauss_newton": {"final": "gauss_newton", **REFINED},
    "adaptive": {"final": "adaptive", **REFINED},
    CAMERAS: {"final": "adaptive", **REFINED, "focal": {"samples": 100, "pool": 8}},
}
UNMOVED = {"unweighted_least_squares": ("prior", "noise"), **{f"irls {name}": ("noise",) for name in LOSSES}}
"""What a fit takes no account of."""


def estimator(name: str) -> Ransac | IterativelyReweighted:
    """One whose fits converge."""
    if name.startswith("irls "):
        return IterativelyReweighted(loss=name.removeprefix("irls "), threshold=2.0, refine_iterations=60)
    return Ransac(**(SEARCH | FITS[name]))  # type: ignore[arg-type]


def inputs(seed: int, noise: float, same: bool = False) -> dict[str, Tensor]:
    """Points, priors and noises of a pair without outliers."""
    c, rng = (
        photographs(seed, (WIDE, WIDE if same else TALL), (1.1, 1.2), 60, noise, 0.0).c,
        np.random.default_rng(seed),
    )
    prior, sigma = torch.from_numpy(rng.uniform(0.2, 0.9, (1, 60))), torch.from_numpy(rng.uniform(0.5, 2, (1, 60)))
    return {"x0": c.x0, "x1": c.x1, "prior": prior, "noise": sigma}


@pytest.fixture
def converging(monkeypatch: pytest.MonkeyPatch) -> None:
    """Final fits that go on to the optimum."""
    monkeypatch.setattr(final_fits, "STEPS", final_fits.STEPS._replace(iterations=30, tolerance=None))
    monkeypatch.setattr(final_fits, "FOCAL_ITERATIONS", 30)
    monkeypatch.setattr(final_fits, "FOCAL_TOLERANCE", 0.0)


@pytest.mark.usefixtures("converging")
@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("name", [*FITS, *(f"irls {loss}" for loss in LOSSES)])
def test_they_are_the_differences_of_estimates(name: str, same: bool) -> None:
    """Where residuals are small against the image: Gauss and Newton's Hessian leaves out their curvature."""
    given, built = inputs(7, 1e-3, same), estimator(name)
    c = photographs(7, (WIDE, WIDE if same else TALL), (1.1, 1.2), 60).c
    rng = np.random.default_rng(1)
    weights, D = torch.from_numpy(rng.normal(size=(3, 3))), torch.diag(torch.tensor([480.0, 320, 1]).double())

    def value(values: dict[str, Tensor]) -> Tensor:
        (F,) = built(c.replace(**values)).F  # in units of half the image
        G = D @ F @ D
        return (weights * G / G.norm()).sum()

    attached = {key: tensor.clone().requires_grad_() for key, tensor in given.items()}
    output = value(attached)
    assert torch.equal(output.detach(), value(given))
    gradients = torch.autograd.grad(output, list(attached.values()), allow_unused=True)
    for (key, tensor), gradient in zip(given.items(), gradients, strict=True):
        if key in UNMOVED.get(name, ()):
            assert gradient is None or not bool(gradient.any())
            continue
        step = torch.from_numpy(rng.normal(size=tuple(tensor.shape)))
        h = 1e-4  # px, or of numbers about one
        ends = [float(value(given | {key: tensor + sign * h * step})) for sign in (-1, 1)]
        # By prior and noise the optimum moves in proportion to its residuals, 1e-5 of half the image and less.
        numeric, rounding = (ends[1] - ends[0]) / (2 * h), 1e-12 / h
        assert float((gradient * step).sum()) == pytest.approx(numeric, rel=5e-3, abs=rounding), key


def with_noise(c: Correspondences) -> Correspondences:
    """In float64, with the noise of matches."""
    noise = torch.linspace(0.5, 2, c.mask.shape[1]).double()[None]
    return c.replace(x0=c.x0.double(), x1=c.x1.double(), noise=noise)


@pytest.mark.parametrize("name", [*FITS, "irls cauchy", "irls magsac"])
def test_failed_pairs_have_none_and_change_no_other(name: str) -> None:
    """Among degenerate pairs, as alone."""
    good, built = [with_noise(scene(1)), with_noise(scene(2, 60))], estimator(name)

    def differentiated(c: Correspondences) -> tuple[Tensor, dict[str, Tensor]]:
        values = {key: getattr(c, key).double() for key in VARIABLES}
        attached = {key: value.clone().requires_grad_() for key, value in values.items()}
        estimate, without = built(c.replace(**attached), seed=5), built(c.replace(**values), seed=5)
        assert torch.equal(estimate.F.detach(), without.F)
        assert torch.equal(estimate.inliers, without.inliers)
        assert estimate.reason == without.reason
        estimate.F[:, 0, 1].square().sum().backward()
        return estimate.ok, {key: value.grad for key, value in attached.items() if value.grad is not None}

    c = collate([good[0], *map(with_noise, degenerate().values()), good[1]])
    ok, gradients = differentiated(c)
    assert bool(ok[[0, -1]].all())
    assert not bool(ok.all())
    for key, gradient in gradients.items():
        assert bool(gradient.isfinite().all()), key
        assert not bool(gradient[~ok].any()), key
        assert not bool(gradient[~c.mask].any()), key
    assert bool(gradients["x0"][[0, -1]].flatten(1).any(1).all())
    for row, each in ((0, good[0]), (-1, good[1])):
        for key, alone in differentiated(each)[1].items():
            # Sums over paddings of other lengths are rounded otherwise.
            torch.testing.assert_close(gradients[key][row, : alone.shape[1]], alone[0], rtol=1e-9, atol=1e-15)
