"""DEGENSAC and the Gauss-Newton fit on the arrays of one pair, against the tensor form."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch.core.types import Correspondences
from fmtorch.estimators import HypothesizeAndVerify, final_fits, inliers
from fmtorch.estimators.degeneracy import Degensac, _fitted, _parallax
from fmtorch.estimators.degeneracy_kernels import fit_plane
from fmtorch.estimators.models import Models, Pool
from fmtorch.estimators.one_pair.degeneracy import Degensac as DegensacOfOne
from fmtorch.estimators.one_pair.degeneracy import _limit
from fmtorch.estimators.one_pair.models import Models as ModelsOfOne
from fmtorch.estimators.one_pair.models import Pool as PoolOfOne
from fmtorch.estimators.one_pair.pair import OnePair
from fmtorch.estimators.one_pair.selection import Selection
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.registry import kernel_form
from fmtorch.estimators.scores import TruncatedSquares
from fmtorch.estimators.selection import without_cameras
from tests.conftest import oracle
from tests.estimators.test_degeneracy import _scene
from tests.estimators.test_one_pair import both, told
from tests.laws import SMALL_KINDS, small

pytest.importorskip("numba", reason="numba is not installed")

NAMES = ("plane 0", "general 1", "real 0", "real 7", "real 13", "real 20")


def given(name: str) -> Correspondences:
    """A synthetic pair ("plane 0", "general 1"), or one of the real ones ("real 7")."""
    kind, i = name.split()[0], int(name.split()[1])
    if kind != "real":
        return _scene(i, 0.9 if kind == "plane" else 0.0)[0]
    file = oracle("robust.npz")
    x0, x1 = (torch.from_numpy(file[f"{i:03d}.{field}"])[None] for field in ("X1", "X2"))
    return Correspondences(x0, x1, torch.ones(x0.shape[:2], dtype=torch.bool), key=torch.tensor([i]))


def checks() -> tuple[Degensac, DegensacOfOne]:
    score = TruncatedSquares(1.0)
    part = Degensac(score)
    return part, DegensacOfOne(part, kernel_form(score))


def rounds(c: Correspondences) -> tuple[NormalizedPairs, OnePair, Models, ModelsOfOne]:
    """The verified models of 100 samples, the same in both forms."""
    pairs, pair = both(c)
    search = HypothesizeAndVerify(confidence=None).search
    models = search.verify(search.generator(pairs, 0, 100), pairs)
    assert models.score is not None
    F, draw, samples = models.F[:, 0].T.contiguous(), models.draw[0].numpy(), models.samples[:, 0].numpy()
    score = models.score[0].double().numpy()
    return pairs, pair, models, ModelsOfOne(F.numpy(), draw, samples, 0, np.arange(len(F)), score)


@pytest.mark.parametrize("name", NAMES)
def test_planes_of_samples(name: str) -> None:
    pairs, pair, models, arrays = rounds(given(name))
    part, compiled = checks()
    most = []
    for m in range(min(len(arrays.F), 100)):
        H, degenerate = part._plane(models.F[..., m], models.sample_of(models.draw[:, m]), pairs)
        found, members = compiled.plane(arrays.F[m].astype(np.float64), arrays.sample_of(int(arrays.draw[m])), pair)
        most.append(members)
        assert (members >= part.ON_PLANE) == bool(degenerate[0])
        expected = H[:, 0].numpy()
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    assert len(set(most)) > 1


@pytest.mark.parametrize("name", NAMES)
def test_planes_are_fitted_and_completed_alike(name: str) -> None:
    """The draws are the same; of models with nearly equal scores either may be among the best."""
    pairs, pair, models, _ = rounds(given(name))
    part, compiled = checks()
    best = int(models.score[0].argmax())  # type: ignore[index]
    H, _ = part._plane(models.F[..., best], models.sample_of(models.draw[:, best]), pairs)
    plane = _fitted(H, pairs)
    found, inside = H[:, 0].numpy().copy(), np.empty(pair.count, np.bool_)
    fit_plane(found, pair.points, _limit(pair), 3, inside)
    assert inside.sum() >= 3  # those of a triplet
    expected = plane[:, 0].numpy()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    for turn in (0, 500):
        F, score = _parallax(plane, pairs, part.score, turn)
        more, more_score = compiled.completed(H[:, 0].numpy().copy(), pair, turn)
        assert len(more) == int(torch.isfinite(score).sum())
        np.testing.assert_allclose(more_score, score[0, : len(more)], atol=pair.count / 8 * 2.0**-10)
        if len(more) and float(score[0, 0] - score[0, 1]) > 1:
            np.testing.assert_allclose(more[0], F[:, 0, 0], atol=1e-5)


def test_a_better_degenerate_model_is_completed_and_others_are_left_alone() -> None:
    completed = 0
    for c in [_scene(i)[0] for i in range(8)] + [_scene(1, 0.0)[0], told(150)]:
        pairs, pair, models, arrays = rounds(c)
        part, compiled = checks()
        assert models.score is not None
        top = float(models.score.max())
        for best in (-np.inf, top):  # which is not beaten
            expected = part(models, torch.tensor([best]), pairs)
            found = compiled(arrays, best, pair)
            assert expected.score is not None
            assert found.score is not None
            added = int(torch.isfinite(expected.score[0]).sum()) - len(arrays.F)
            assert len(found.score) - len(arrays.F) == added
            assert (added == 0) or best == -np.inf
            np.testing.assert_allclose(found.score, expected.score[0, : len(found.score)], atol=0.1)
            np.testing.assert_array_equal(found.draw, expected.draw[0, : len(found.draw)])
            completed += added > 0
            pools = Pool.of(pairs, 8), PoolOfOne.of(pair, 8)
            pools[0].merge([0], expected)
            pools[1].merge([0], found)
            assert pools[1].best_score([0]) == pytest.approx(float(pools[0].best_score([0])), abs=0.1)
    assert completed >= 4


@pytest.mark.parametrize("kind", SMALL_KINDS)
@pytest.mark.parametrize("count", [8, 20])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_what_determines_no_plane(kind: str, count: int, scale: float) -> None:
    """Any model at all: nothing raises, and what is added is finite."""
    c = small()[f"{count} {kind}"]
    buckets = both(c.replace(x0=scale * c.x0, x1=scale * c.x1)) if "half" in kind or kind[:3] != "coi" else None
    if buckets is None:  # refused at the door
        return
    pair = buckets[1]
    rng, (_, compiled) = np.random.default_rng(0), checks()
    F = np.vstack([np.zeros(9), np.ones(9), rng.normal(size=(10, 9))]).astype(np.float32)
    samples = np.stack([rng.permutation(count)[:7] for _ in F], 1)
    for m in range(len(F)):
        arrays = ModelsOfOne(F[m : m + 1], np.array([m]), samples, 0, np.array([0]), np.array([1.0]))
        found = compiled(arrays, -np.inf, pair)
        assert found.score is not None
        assert np.isfinite(found.F).all()
        assert np.isfinite(found.score).all()


@pytest.mark.parametrize("kind", ["all", "nothing"])
def test_the_gauss_newton_step(kind: str) -> None:
    pairs, pair = both(told(300, kind))
    pool = HypothesizeAndVerify(hypotheses=200).search(pairs)
    selection = without_cameras(pool.F[:, :, 0].double(), pool)
    counted = inliers.WithinThreshold(1.0)(selection.matrices, pairs)
    part = final_fits.GaussNewton()
    expected = part.value(selection, pairs, counted)
    F = selection.F[:, 0].numpy()
    found = kernel_form(part).value(Selection(F, True, 200), pair, counted[0, :300].numpy())
    assert np.abs(found.F - found.at).max() > 1e-6
    np.testing.assert_allclose(found.F, expected.F[0], atol=1e-10)
    np.testing.assert_array_equal(found.at, expected.at[0])
    nothing = kernel_form(part).value(Selection(F, True, 200), pair, np.zeros(300, np.bool_))
    np.testing.assert_array_equal(nothing.F, nothing.at)
