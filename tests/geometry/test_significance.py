"""The significance of a fundamental matrix: its definition, its symmetries, and what it says of chance."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.core import collate
from fmtorch.geometry import significance
from fmtorch.jit import kernel
from tests.geometry.scenes import scene
from tests.laws import degenerate, small
from tests.reference import significance as reference

SIZE = (800, 1000)


@pytest.fixture(params=["on", "off"])
def form(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(kernel.SWITCH, request.param)


def pair(n: int, seed: int = 0, outliers: float = 0.4) -> tuple[Tensor, Tensor, Tensor]:
    """F, x0, x1 of a pair, the first share of whose matches is anywhere."""
    s = scene(n, seed, noise=0.5)
    x1, wrong = s.x1.clone(), round(outliers * n)
    x1[:wrong] = torch.from_numpy(np.random.default_rng(seed).uniform(0, 800, (wrong, 2)))
    return s.F[None], s.x0[None], x1[None]


def crowded(n: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """The same with every third match beside another one, in both images."""
    F, x0, x1 = pair(n, seed)
    near = torch.from_numpy(np.random.default_rng(seed).normal(0, 2, (2, 1, n, 2)))
    copied = (torch.arange(n) % 3 == 0)[None, :, None]
    return F, torch.where(copied, x0[:, :1] + near[0], x0), torch.where(copied, x1[:, :1] + near[1], x1)


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("n", [0, 1, 7, 8, 9, 60, 900])
@pytest.mark.parametrize("sizes", [False, True])
@pytest.mark.parametrize("make", [pair, crowded])
def test_equals_the_definition(n: int, sizes: bool, make: type[pair]) -> None:
    F, x0, x1 = make(n, n)
    size = SIZE if sizes else None
    expected = reference.significance(F[0].numpy(), x0[0].numpy(), x1[0].numpy(), size, size)
    size = torch.tensor([SIZE]) if sizes else None
    assert float(significance(F, x0, x1, size0=size, size1=size)[0]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.usefixtures("form")
def test_the_same_bits_in_any_batch_padding_and_order() -> None:
    pairs = [crowded(n, n) for n in (11, 300, 64, 8, 131)]
    alone = [float(significance(*p)[0]) for p in pairs]
    rng = torch.Generator().manual_seed(0)
    for slots, garbage in ((300, torch.nan), (401, 1e30), (1000, -7.0)):
        x0, x1 = torch.full((2, len(pairs), slots, 2), garbage, dtype=torch.float64)
        mask = torch.zeros(len(pairs), slots, dtype=torch.bool)
        for i, (_, a, b) in enumerate(pairs):
            place = torch.randperm(slots, generator=rng)[: a.shape[1]]
            x0[i, place], x1[i, place], mask[i, place] = a[0], b[0], True
        together = significance(torch.cat([p[0] for p in pairs]), x0, x1, mask)
        assert together.tolist() == alone


@pytest.mark.parametrize("sizes", [False, True])
def test_scale_and_shift_change_nothing(sizes: bool) -> None:
    F, x0, x1 = pair(80)
    size = torch.tensor([SIZE], dtype=torch.float64) if sizes else None
    known = float(significance(F, x0, x1, size0=size, size1=size)[0])

    def moved(scale: float, shift: float) -> float:
        T = torch.tensor([[scale, 0, shift], [0, scale, -shift], [0, 0, 1]], dtype=torch.float64).inverse()
        y0, y1 = (scale * x + torch.tensor([shift, -shift]) for x in (x0, x1))
        scaled = None if size is None else scale * size
        return float(significance(T.T @ F @ T, y0, y1, size0=scaled, size1=scaled)[0])

    for scale in (2.0**-30, 1e-9, 3.0, 1e9):
        assert moved(scale, 0.0) == pytest.approx(known, rel=1e-6)
    assert moved(1.0, 5000.0) == pytest.approx(known, rel=1e-6)


@pytest.mark.parametrize("times", [2, 5])
def test_matches_that_are_repeated_count_once(times: int) -> None:
    F, x0, x1 = crowded(70, 3)
    known = significance(F, x0, x1)
    repeated = significance(F, x0.repeat(1, times, 1), x1.repeat(1, times, 1))
    assert torch.equal(known, repeated)


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize(
    "F", [torch.zeros(3, 3), torch.full((3, 3), torch.nan), torch.full((3, 3), torch.inf)], ids=["0", "NaN", "infinite"]
)
def test_no_model_is_not_significant(F: Tensor) -> None:
    good, x0, x1 = pair(50)
    values = significance(torch.stack([F.double(), good[0]]), x0.expand(2, -1, -1), x1.expand(2, -1, -1))
    assert (values[0], values[1]) == (-math.inf, significance(good, x0, x1)[0])


def test_matches_without_extent_are_not_significant() -> None:
    """Eight places are needed; matches on a horizontal line leave nothing to chance where no size is known."""
    F, x0, x1 = pair(50)
    assert significance(F, x0[:, :1].expand_as(x0), x1[:, :1].expand_as(x1))[0] == -math.inf
    flat = torch.stack([x0[..., 0], torch.zeros_like(x0[..., 0])], -1)
    assert float(significance(F, flat, x1)[0]) < 0
    assert significance(F, x0 * torch.nan, x1)[0] == -math.inf


@pytest.mark.parametrize("sizes", [False, True])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_both_forms_agree_on_degenerate_pairs(scale: float, sizes: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within rounding: sums of logarithms of factorials, of which each form rounds one."""
    c = collate([*degenerate().values(), *small().values()])
    size = (scale * torch.tensor([SIZE])).expand(len(c), 2) if sizes else None
    for F in (torch.eye(3), scene(20, 1).F.float()):
        values = []
        for state in ("on", "off"):
            monkeypatch.setenv(kernel.SWITCH, state)
            values.append(significance(F.expand(len(c), 3, 3), scale * c.x0, scale * c.x1, c.mask, size, size))
        torch.testing.assert_close(*values, rtol=1e-12, atol=1e-9)
