"""Iteratively reweighted least squares by kernels, against the tensor form."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fmtorch.estimators.one_pair.irls import weights

from fmtorch import presets
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.estimators.irls import _weight
from fmtorch.geometry.irls import reweighted
from fmtorch.geometry.irls_kernels import reweighted as compiled_reweighted
from fmtorch.geometry.robust_losses import KERNELS
from fmtorch.geometry.sampson_objective_kernels import LOSSES
from fmtorch.geometry.sigma_consensus import LOSS_TABLE
from tests.estimators.test_one_pair import (
    assert_scenes_alike,
    assert_told_alike,
    both,
    inputs,
    real_pairs,
    solved,
    told,
)
from tests.geometry.test_refine_kernels import matches

pytest.importorskip("numba", reason="numba is not installed")


def in_both_forms(name: str, c: Correspondences) -> list[Estimate]:
    estimator, found = presets.build("estimator", name), []
    for state in ("on", "off"):
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv(switch.SWITCH, state)
            found.append(estimator(c, seed=3))
    return found


@pytest.mark.parametrize("n", [8, 32, 300])
@pytest.mark.parametrize("loss", LOSSES)
def test_one_iteration(loss: str, n: int) -> None:
    F, points, weight, _ = matches(n)
    scale, weight[:2] = 0.02, [0, 1e-9]
    tensors = (torch.from_numpy(a) for a in (F.T[:, None].copy(), points[:, None], weight[None]))
    expected = reweighted(*tensors, KERNELS[loss], torch.tensor([scale], dtype=torch.float64))[:, 0].T.numpy()
    found = F.copy()
    compiled_reweighted(found, points, weight, np.full(n, scale**2), LOSSES[loss], LOSS_TABLE)

    def unit(F: np.ndarray) -> np.ndarray:
        return F / np.linalg.norm(F, axis=1)[:, None] * np.sign(np.take_along_axis(F, np.abs(F).argmax(1)[:, None], 1))

    np.testing.assert_allclose(unit(found), unit(expected), atol=1e-8)
    kept = F.copy()  # where the weights determine no model
    compiled_reweighted(kept, points, np.where(np.arange(n) < 6, weight, 0), np.ones(n), LOSSES[loss], LOSS_TABLE)
    np.testing.assert_array_equal(kept, F)


@pytest.mark.parametrize("known", [("prior", "quality"), ("quality",), ()])
def test_weights_of_matches(known: tuple[str, ...]) -> None:
    c = told(150)
    pairs, pair = both(c.replace(**{name: None for name in ("prior", "quality") if name not in known}))
    np.testing.assert_array_equal(weights(pair), _weight(pairs)[0, :150])


@pytest.mark.parametrize("loss", ["magsac", "huber"])
def test_presets_in_both_forms(loss: str) -> None:
    for names, c in inputs():
        compiled, tensors = in_both_forms(f"irls_{loss}", c)
        assert_told_alike(compiled, tensors, names)
        if len(names) > 1:
            assert_scenes_alike(compiled, tensors, 1e-7)


@pytest.mark.parametrize("loss", ["magsac", "cauchy"])
def test_both_forms_solve_the_same_real_pairs(loss: str) -> None:
    """Minima of nearly the same cost may be taken for each other: at most one pair is solved by one form alone."""
    c = real_pairs(step=4)[0].replace(size0=None, size1=None)
    compiled, tensors = in_both_forms(f"irls_{loss}", c)
    assert int((solved(compiled, step=4) != solved(tensors, step=4)).sum()) <= 1
