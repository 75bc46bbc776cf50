"""Iteratively reweighted least squares by kernels, against the tensor form."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from fmtorch import kernels, metrics, presets
from fmtorch.estimators.irls import _weight
from fmtorch.estimators.one_pair.irls import weights
from fmtorch.geometry.irls import reweighted
from fmtorch.geometry.irls_kernels import reweighted as compiled_reweighted
from fmtorch.geometry.robust_kernels import KERNELS
from fmtorch.geometry.sampson_objective_kernels import LOSSES
from fmtorch.geometry.sigma_consensus import LOSS_TABLE
from fmtorch.types import Correspondences, Estimate
from tests.conftest import oracle
from tests.estimators.test_one_pair import both, inputs, told
from tests.geometry.test_refine_kernels import matches
from tests.laws import scenes

pytest.importorskip("numba", reason="numba is not installed")


def in_both_forms(name: str, c: Correspondences) -> list[Estimate]:
    estimator, found = presets.build("estimator", name), []
    for switch in ("on", "off"):
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv(kernels.SWITCH, switch)
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
    """Of degenerate pairs both forms say the same; how many inliers fit nothing is a matter of rounding."""
    for what, c in inputs():
        compiled, tensors = in_both_forms(f"irls_{loss}", c)
        kinds = [tuple(re.sub(r"\d+", "N", reason) for reason in e.reason) for e in (compiled, tensors)]
        assert kinds[0] == kinds[1], what
        assert torch.equal(compiled.ok, tensors.ok), what
    compiled, tensors = in_both_forms(f"irls_{loss}", scenes())
    torch.testing.assert_close(compiled.F, tensors.F, rtol=0, atol=1e-7)


@pytest.mark.parametrize("loss", ["magsac", "cauchy"])
def test_both_forms_solve_the_same_real_pairs(loss: str) -> None:
    """Minima of nearly the same cost may be taken for each other: at most one pair is solved by one form alone."""
    file, solved = oracle("robust.npz"), []
    for i in range(0, len(file["names"]), 4):
        x0, x1 = (torch.from_numpy(file[f"{i:03d}.{field}"])[None] for field in ("X1", "X2"))
        c = Correspondences(x0, x1, torch.ones(x0.shape[:2], dtype=torch.bool), key=torch.tensor([i]))
        F_true, *sizes = (torch.from_numpy(file[f"{i:03d}.{field}"])[None] for field in ("F_gt", "size1", "size2"))
        forms = in_both_forms(f"irls_{loss}", c)
        solved.append([float(metrics.nsgd(F_true, e.F, *(s.long() for s in sizes))) < 0.05 for e in forms])
    compiled, tensors = np.array(solved).T
    assert np.count_nonzero(compiled != tensors) <= 1
