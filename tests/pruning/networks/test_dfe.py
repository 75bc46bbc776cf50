"""DFE: its fits, what it sees of them, padding, degenerate pairs."""

import pytest
import torch
from torch import Tensor

from fmtorch.core import Correspondences, collate
from fmtorch.geometry import eight_point, sampson
from fmtorch.pruning import DFE
from fmtorch.pruning.networks.architectures import masked_softmax
from fmtorch.pruning.networks.layers import Slots
from tests.laws import scene

K = torch.tensor([[[800.0, 0, 480], [0, 800, 320], [0, 0, 1]]])


def small(**options: object) -> DFE:
    torch.manual_seed(0)
    return DFE(widths=(16, 32, 8), side=["ratio"], **options)  # type: ignore[arg-type]


def robust(x: Tensor, slots: Slots) -> Tensor:
    """A backbone whose weights fall with the square of the residual, as those of a robust kernel."""
    return torch.stack([-2 * x[:, -2], -x[:, -2]], 1)


def test_each_stage_is_the_fit_with_its_weights() -> None:
    c = scene(0)
    prediction = small()(c)
    assert prediction.logit.shape == prediction.weight.shape == (5, 1, 150)
    torch.testing.assert_close(prediction.weight.sum(-1), torch.ones(5, 1))
    for weight, F in zip(prediction.weight, prediction.F, strict=True):
        expected, valid = eight_point(c.x0.double(), c.x1.double(), weight.double())
        assert valid.all()
        torch.testing.assert_close(F, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("coordinates", ["size", "K"])
def test_residuals_are_fed_back(coordinates: str) -> None:
    """Weights that fall with the residual make the fits those of robust least squares: few outliers are left out."""
    c = scene(0, outliers=0.05).replace(K0=K, K1=K)
    prediction = small(coordinates=coordinates).predict(c, robust)
    first, *_, last = (float(sampson(F, c.x0.double(), c.x1.double()).median()) for F in prediction.F)
    assert last < 0.3 < 3 < first  # px; the noise of a coordinate is 0.3
    assert (prediction.weight[-1].log() - prediction.logit[-1] * 2).std() < 1e-4  # both follow the last residual


def degenerate() -> Correspondences:
    """Collinear, coincident, seven, two and no matches, one plane, and a sound pair."""
    sound = scene(0, count=60)
    line = torch.linspace(0, 600, 60)[None, :, None] * torch.tensor([1.0, 0.5])
    seven, two = (torch.arange(60)[None] < n for n in (7, 2))
    plane = sound.x0 * 1.1 + 3
    cases = [
        sound, sound.replace(x0=line, x1=line + 5), sound.replace(x0=torch.full_like(line, 7.0), x1=line * 0),
        sound.keep(seven), sound.keep(two), sound.keep(two & ~two), sound.replace(x1=plane),
    ]  # fmt: skip
    return collate(cases)


@pytest.mark.parametrize("network", [small(), small(coordinates="K")])
def test_gradients_are_finite_on_degenerate_pairs(network: DFE) -> None:
    """Of weights, log-odds and fits alike, in training mode, and no pair takes the sound one's gradient with it."""
    c = degenerate().replace(K0=K.expand(7, 3, 3), K1=K.expand(7, 3, 3))
    prediction = network.train()(c)
    loss = prediction.F.square()[..., 0, :].sum() + (prediction.logit * c.mask).sum() + prediction.weight.square().sum()
    gradients = torch.autograd.grad(loss, list(network.parameters()))
    assert all(torch.isfinite(g).all() for g in gradients)
    assert any(g.any() for g in gradients)
    assert torch.isfinite(prediction.logit).all()
    assert torch.isfinite(prediction.F).all()
    assert not prediction.F[:, 3:6].any()  # fewer than eight matches fit nothing
    assert all(torch.isfinite(b).all() for b in network.buffers())


def test_weights_of_no_match_are_zero() -> None:
    logit = torch.tensor([[1.0, 2.0], [3.0, 4.0]], requires_grad=True)
    weight = masked_softmax(logit, torch.tensor([[False, False], [True, False]]))
    assert weight.tolist() == [[0, 0], [1, 0]]
    weight.square().sum().backward()
    assert torch.isfinite(logit.grad).all()  # type: ignore[arg-type]


def test_iterations() -> None:
    with pytest.raises(ValueError, match="iterations=0"):
        DFE(iterations=0)
