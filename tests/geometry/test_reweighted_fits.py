"""Iterated fits whose weights any function predicts: the kernels' make `irls`, a network learns, hopeless pairs."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from fmtorch.core.types import collate
from fmtorch.geometry import eight_point, irls, reweighted_fits, sampson
from fmtorch.geometry.robust_losses import LOSSES, named_loss
from tests import laws
from tests.geometry.test_irls_gradients import SCALE, degenerate, inputs
from tests.geometry.test_refine import distance


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_of_a_loss_make_it_irls(loss: str) -> None:
    """The same step serves both: `irls` is the iteration whose weights are w rho'(r^2) / g^2."""
    x0, x1, F0, weight = (torch.stack(v) for v in zip(*(inputs(s) for s in range(3)), strict=True))
    F0 = F0 / F0.flatten(1).norm(dim=1)[:, None, None]
    robust = named_loss(loss)

    def weigh(F: Tensor | None, residual: Tensor | None) -> Tensor:
        assert F is not None
        assert residual is not None
        line1 = torch.einsum("bij,bnj->bni", F, torch.nn.functional.pad(x0, (0, 1), value=1.0))
        line0 = torch.einsum("bji,bnj->bni", F, torch.nn.functional.pad(x1, (0, 1), value=1.0))
        g2 = line1[..., :2].square().sum(-1) + line0[..., :2].square().sum(-1)
        return weight * robust.weight(residual.square(), torch.tensor(SCALE**2, dtype=torch.float64)) / g2

    fits = reweighted_fits(x0, x1, weigh, 3, F0=F0)
    assert bool(fits.valid.all())
    assert fits.F.shape == (3, 3, 3, 3)
    for i in range(3):
        expected = irls(x0, x1, F0, weight, loss=loss, scale=SCALE, iterations=i + 1)
        # Rounding of 1e-16 times the condition of the normal equations, 1e6.
        assert float(distance(fits.F[i].flatten(1).T, expected.flatten(1).T).max()) < 1e-9


def test_a_network_learns_through_the_fits() -> None:
    """Weights of side information and residuals fed back: gradients reach every parameter; descending them helps."""
    c = collate([laws.scene(1), laws.scene(2, 60)])
    assert c.ratio is not None
    truth = torch.stack(
        [
            eight_point(p.x0.double(), p.x1.double())[0][0]
            for p in (laws.scene(i, n, 0.0, 0.0) for i, n in ((1, 150), (2, 60)))
        ]
    )
    ratio = torch.where(c.mask, c.ratio, 0).double()
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(2, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1)).double()

    def weigh(F: Tensor | None, residual: Tensor | None) -> Tensor:
        assert (F is None) == (residual is None)
        distance = torch.zeros_like(ratio) if residual is None else residual
        assert distance.shape == ratio.shape
        return torch.sigmoid(network(torch.stack([ratio, torch.log1p(distance)], -1))[..., 0])

    optimiser = torch.optim.Adam(network.parameters(), lr=0.1)
    losses = []
    for _ in range(20):
        fits = reweighted_fits(c.x0, c.x1, weigh, 3, c.mask)
        assert bool(fits.valid.all())
        clean0, clean1 = (torch.where(c.mask[..., None], x, 0).double() for x in (c.x0, c.x1))
        inliers = c.mask & (sampson(truth, clean0, clean1) < 3)
        loss = torch.log1p(torch.where(inliers, sampson(fits.F, clean0, clean1), 0)).mean()
        optimiser.zero_grad()
        loss.backward()
        assert all(p.grad is not None and bool((p.grad != 0).any()) for p in network.parameters())
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]


def test_fits_of_hopeless_pairs() -> None:
    """Zero and not valid without a start, and that start with one; a fit that fails later repeats the last."""
    pairs = [laws.scene(1), *degenerate().values()]
    c = collate([pair.replace(x0=pair.x0.double(), x1=pair.x1.double()) for pair in pairs])
    base = torch.where(c.mask, c.prior, 0).double().nan_to_num(0)
    weight = base.clone().requires_grad_()
    calls: list[int] = []

    def weigh(F: Tensor | None, residual: Tensor | None) -> Tensor:
        calls.append(0)
        weights = weight if residual is None else weight / (1 + residual.square())
        return weights if len(calls) < 3 else torch.where(torch.arange(len(c.mask))[:, None] == 0, -weights, weights)

    fits = reweighted_fits(c.x0, c.x1, weigh, 3, c.mask)
    assert fits.valid[:, 0].tolist() == [True, True, False]
    assert torch.equal(fits.F[2, 0], fits.F[1, 0])
    assert bool(fits.F.isfinite().all())
    never = ~fits.valid.any(0)
    assert bool(never.any())
    assert bool((fits.F[:, never] == 0).all())
    (gradient,) = torch.autograd.grad(fits.F.sum(), weight)
    assert bool(gradient.isfinite().all())
    assert bool((gradient[never] == 0).all())
    start = torch.eye(3, dtype=torch.float64).expand(len(c.mask), 3, 3) / 3**0.5
    calls.clear()
    assert bool((reweighted_fits(c.x0, c.x1, weigh, 1, c.mask, F0=start).F[0, never] == start[0]).all())
    alone = reweighted_fits(pairs[0].x0.double(), pairs[0].x1.double(), lambda F, r: base[:1, :150], 1)
    assert torch.equal(alone.F[0, 0], fits.F[0, 0])
