"""NSGD's kernel against its tensor form: the same draws, the same figures."""

from __future__ import annotations

import pytest
import torch

from fmtorch.jit import kernel
from fmtorch.metrics import nsgd, nsgd_released, sgd
from tests.metrics.test_nsgd import HD, VGA, columns_shifted, random_pairs, rows_shifted

pytest.importorskip("numba", reason="numba is not installed")


def matrices() -> tuple[torch.Tensor, torch.Tensor]:
    """Random pairs, and ones whose lines are vertical, horizontal, far outside, at infinity, or none."""
    pairs = [random_pairs(seed, 1, spread=spread) for seed, spread in enumerate((0.0, 0.001, 0.05, 0.5, 2.0))]
    F_gt, F_est = (torch.cat(batch) for batch in zip(*pairs, strict=True))
    special = [rows_shifted(0.0), rows_shifted(700.0), rows_shifted(5000.0), columns_shifted(0.0), columns_shifted(9.0)]
    affine = torch.zeros(3, 3, dtype=torch.float64)
    affine[2, 2] = 1
    special += [affine, affine * 0, affine * torch.nan, special[0] * 1e-200, special[0] * 1e200]
    both = torch.cartesian_prod(torch.arange(len(special)), torch.arange(len(special)))
    stacked = torch.stack(special)
    return torch.cat([F_gt, stacked[both[:, 0]]]), torch.cat([F_est, stacked[both[:, 1]]])


@pytest.mark.parametrize(("samples", "cap"), [(1, True), (1, False), (100, True), (100, False), (1000, False)])
def test_both_forms_are_alike(samples: int, cap: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    F_gt, F_est = matrices()
    key = torch.arange(len(F_gt)) * 77 - 500
    for distance in (nsgd, sgd):
        for sizes in ((HD, HD), (VGA, HD)):
            monkeypatch.setenv(kernel.SWITCH, "on")
            compiled = distance(F_gt, F_est, *sizes, samples=samples, seed=3, key=key, cap=cap)
            monkeypatch.setenv(kernel.SWITCH, "off")
            tensors = distance(F_gt, F_est, *sizes, samples=samples, seed=3, key=key, cap=cap)
            # The same sums of the same terms, but torch's roots of float64 are not always correctly rounded. Distances
            # of 1e3 px are differences of terms of 1e3; those below are rounding of such.
            torch.testing.assert_close(compiled, tensors, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("samples", [1, 100, 1000])
def test_both_forms_of_the_released_figure_are_alike(samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    F_gt, F_est = matrices()
    key = torch.arange(len(F_gt)) * 77 - 500
    for sizes in ((HD, HD), (VGA, HD)):
        monkeypatch.setenv(kernel.SWITCH, "on")
        compiled = nsgd_released(F_gt, F_est, *sizes, samples=samples, seed=3, key=key)
        monkeypatch.setenv(kernel.SWITCH, "off")
        tensors = nsgd_released(F_gt, F_est, *sizes, samples=samples, seed=3, key=key)
        torch.testing.assert_close(compiled, tensors, rtol=1e-9, atol=1e-12)


def test_gradients_take_the_tensor_form() -> None:
    F_gt, F_est = random_pairs(0, 3)
    F_est.requires_grad_()
    nsgd(F_gt, F_est, HD, HD, cap=False).sum().backward()
    assert F_est.grad is not None
    assert bool((F_est.grad != 0).any())
