"""GeoDesc's loss: its definition, its gradients, what it presses on."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from fmtorch.training.geodesc_loss import geodesc, geometric, margins, structured
from tests.reference import geodesc as reference


def match_sets(sets: int, n: int, d: int, seed: int, noise: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Unit descriptors of match sets, alike within the noise, and random S_patch."""
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(sets, n, d, generator=generator, dtype=torch.float64)
    b = a + noise * torch.randn(sets, n, d, generator=generator, dtype=torch.float64)
    similarity = torch.rand(sets, n, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(a, dim=2), torch.nn.functional.normalize(b, dim=2), similarity


@pytest.mark.parametrize("seed", range(3))
def test_the_loss_is_its_definition(seed: int) -> None:
    a, b, similarity = match_sets(3, 9, 4, seed)
    sets = list(zip(a.tolist(), b.tolist(), similarity.tolist(), strict=True))
    first = sum(reference.structured(x, y, 0.3) for x, y, _ in sets) / 3
    second = sum(reference.geometric(x, y, s) for x, y, s in sets) / 3
    assert min(first, second) > 0.02
    assert float(structured(a, b, ratio=0.3)) == pytest.approx(first, abs=1e-12)
    assert float(geometric(a, b, similarity)) == pytest.approx(second, abs=1e-12)
    assert float(geodesc(a, b, similarity, ratio=0.3, geometric_weight=0.2)) == pytest.approx(first + 0.2 * second)


def test_gradients() -> None:
    a, b, similarity = match_sets(2, 5, 3, 0)
    assert torch.autograd.gradcheck(lambda x, y: geodesc(x, y, similarity), (a.requires_grad_(), b.requires_grad_()))


def test_coincident_descriptors_have_finite_gradients() -> None:
    a = torch.nn.functional.normalize(torch.ones(1, 4, 3), dim=2).requires_grad_()
    geodesc(a, a, torch.full((1, 4), 0.5)).backward()
    assert torch.isfinite(a.grad).all()


def test_margins_are_those_of_the_paper() -> None:
    similarity = torch.tensor([1.0, 0.5, 0.4999, 0.2, 0.1999, 0.0], dtype=torch.float64)
    assert margins(similarity).tolist() == [0.7, 0.7, 0.5, 0.5, 0.2, 0.2]


def test_the_ratio_is_a_margin_relative_to_the_match() -> None:
    # Two matches of similarity s whose patches are else of similarity c: no loss while c <= (1 - ratio) s.
    def loss(c: float, s: float) -> float:
        S = torch.tensor([[s, c], [c, s]])
        return float(structured(torch.eye(2), S.mT, ratio=0.4))

    assert loss(0.54, 0.9) == pytest.approx(0.0, abs=1e-7)
    assert loss(0.64, 0.9) == pytest.approx(2 * 0.1)
    assert loss(0.34, 0.4) == pytest.approx(2 * 0.1)


def test_sets_do_not_see_each_other() -> None:
    a, b, similarity = match_sets(4, 6, 5, 1)
    alone = [float(geodesc(a[i : i + 1], b[i : i + 1], similarity[i : i + 1])) for i in range(4)]
    assert float(geodesc(a, b, similarity)) == pytest.approx(sum(alone) / 4)
