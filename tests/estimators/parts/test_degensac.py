"""Plane and parallax finds the geometry of scenes that a plane rules, where a plain search fits the plane alone."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fmtorch.core.types import Correspondences, Estimate, collate
from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.families.family import Hypotheses
from fmtorch.estimators.parts.degensac import (
    FITS,
    KEPT,
    PLANE_THRESHOLD_PX,
    Degensac,
    fit_plane,
    parallax,
    plane_of_sample,
)
from fmtorch.estimators.parts.scores import Msac
from fmtorch.estimators.search import Verified
from tests.estimators.pairs import apart, pair_of, to_units
from tests.laws import SMALL_KINDS, assert_same, small
from tests.reference import homography as reference

PAIRS = 64
COUNT = 200
OPTIONS = {
    "threshold": 1.0,
    "hypotheses": 200,
    "round": 100,
    "confidence": None,
    "pool": 4,
    "refine": {"kernel": "truncated"},
}
K = np.array([[900, 0, 480], [0, 900, 320], [0, 0, 1.0]])
PLANE = np.array([0.4, -0.3])  # Z = 6 + 0.4 X - 0.3 Y


def cameras(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return Rotation.from_rotvec(rng.uniform(-0.15, 0.15, 3)).as_matrix(), rng.uniform(-1, 1, 3)


def points(rng: np.random.Generator, n: int, on_plane: np.ndarray) -> np.ndarray:
    X = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (n, 3))
    X[on_plane, 2] = 6 + X[on_plane, :2] @ PLANE
    return X


def project(X: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.concatenate([y[:, :2] / y[:, 2:] for y in (X @ K.T, (X @ R.T + t) @ K.T)], 1)


def matches(x: np.ndarray, key: int = 1) -> Correspondences:
    x0, x1 = (torch.from_numpy(np.ascontiguousarray(y))[None] for y in (x[:, :2], x[:, 2:]))
    return Correspondences(x0, x1, torch.ones(1, len(x), dtype=torch.bool), key=torch.tensor([key]))


def fundamental(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    skew = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return np.asarray(np.linalg.inv(K).T @ skew @ R @ np.linalg.inv(K))


@functools.cache
def planar(index: int, share: float = 0.9) -> tuple[Correspondences, np.ndarray]:
    """A pair with 25 % outliers and this share of the inliers on a plane, and exact matches off the plane (100, 4)."""
    rng = np.random.default_rng(index)
    R, t = cameras(rng)
    x = project(points(rng, COUNT, rng.random(COUNT) < share), R, t) + rng.normal(0, 0.3, (COUNT, 4))
    wrong = rng.random(COUNT) < 0.25
    x[wrong, 2:] = rng.uniform([0, 0], [960, 640], (int(wrong.sum()), 2))
    return matches(x, index + 1), project(points(rng, 100, np.zeros(100, dtype=bool)), R, t)


def error(F: torch.Tensor, exact: np.ndarray) -> float:
    """The median Sampson distance of exact matches off the plane, px."""
    h0, h1 = (np.c_[x, np.ones(len(x))] for x in (exact[:, :2], exact[:, 2:]))
    l1, l0 = h0 @ F.numpy().T, h1 @ F.numpy()
    return float(np.median(np.abs((h1 * l1).sum(1)) / np.sqrt((l1[:, :2] ** 2).sum(1) + (l0[:, :2] ** 2).sum(1))))


def share_right(**options: object) -> float:
    estimate = HypothesizeAndVerify(**{**OPTIONS, **options})(collate([planar(i)[0] for i in range(PAIRS)]))
    return float(np.mean([error(F, planar(i)[1]) < 2.0 for i, F in enumerate(estimate.F)]))


def test_a_scene_ruled_by_a_plane() -> None:
    plain, completed = share_right(), share_right(degeneracy="degensac")
    # Shares of 64 pairs have a standard error of at most 6 %: a gain of 0.3 is five of them.
    assert completed > plain + 0.3
    assert completed > 0.8


def test_a_general_scene_is_left_alone() -> None:
    options = {**OPTIONS, "refine": None, "final": "none", "pool": 1, "score": "inlier_count"}
    scenes = collate([planar(i, 0.0)[0] for i in range(8)])
    plain = HypothesizeAndVerify(**options)(scenes)
    assert torch.equal(HypothesizeAndVerify(**options, degeneracy="degensac")(scenes).F, plain.F)


@pytest.mark.parametrize("on_plane", [4, 5, 6, 7])
def test_a_sample_is_degenerate_from_five_matches_on(on_plane: int) -> None:
    degenerate = 0
    for index in range(10):
        rng = np.random.default_rng(100 + index)
        R, t = cameras(rng)
        members = rng.permutation(7)[:on_plane]
        pair = pair_of(matches(project(points(rng, 7, members), R, t)))
        limit = (PLANE_THRESHOLD_PX / pair.pixels_per_unit) ** 2
        H = np.empty(9)
        near = plane_of_sample(to_units(fundamental(R, t), pair), pair.points, Degensac.TRIPLETS, limit, H)
        degenerate += near >= Degensac.ON_PLANE
        if on_plane > Degensac.ON_PLANE:  # the only plane with so many
            for i in members:
                transfer = reference.transfer(H.reshape(3, 3), pair.points[:2, i], pair.points[2:, i])
                assert transfer * pair.pixels_per_unit < PLANE_THRESHOLD_PX
    # Four on a plane: a fifth comes within 2 px by chance now and then.
    assert degenerate <= 3 if on_plane < Degensac.ON_PLANE else degenerate == 10


def test_a_plane_is_fitted_to_its_matches_and_completed_by_two_off_it() -> None:
    rng = np.random.default_rng(0)
    R, t = cameras(rng)
    on_plane = np.arange(80) < 60
    pair = pair_of(matches(project(points(rng, 80, on_plane), R, t)))
    limit, inside = (PLANE_THRESHOLD_PX / pair.pixels_per_unit) ** 2, np.empty(80, np.bool_)
    H = reference.dlt(pair.points[:2, :4].T, pair.points[2:, :4].T).ravel()
    fit_plane(H, pair.points, limit, FITS, inside)
    assert inside[:60].all()
    assert inside[60:].sum() < 5  # near the plane by chance
    expected = reference.dlt(pair.points[:2, :60].T, pair.points[2:, :60].T)
    assert apart(H, expected) < 0.01  # matches near the plane by chance were fitted, too
    H[:] = expected.ravel()
    weight = np.where(inside, 0, 1)
    F = np.empty((200, 9), np.float32)
    count = parallax(H, pair.points, np.cumsum(weight), np.array([1, 2, 0]), F)
    truth = to_units(fundamental(R, t), pair)
    assert count > 100
    # Two matches near each other, or near the plane, determine no epipole; most do: float32, twice normalised.
    assert np.median([apart(model, truth) for model in F[:count]]) < 1e-4


def test_the_best_model_of_a_round_is_completed_where_it_beats_the_score() -> None:
    completed = 0
    for i in range(8):
        pair = pair_of(planar(i)[0])
        engine = HypothesizeAndVerify(hypotheses=100, round=100)
        sample = engine.search.sampler.draw(pair, 0, 100, 7)
        hypotheses = engine.search.family.solve(pair, sample, 0)
        score, which = Msac(1.0), np.arange(len(hypotheses.F))
        models = Verified(hypotheses.F, which, score(hypotheses.F, which, pair))
        part = Degensac(score)
        assert part(hypotheses, models, float(models.score.max()), pair) is models  # it beats nothing
        after = part(hypotheses, models, -np.inf, pair)
        assert len(after.F) - len(models.F) in (0, KEPT)
        np.testing.assert_array_equal(after.F[: len(models.F)], models.F)
        added = after.which[len(models.F) :]
        np.testing.assert_array_equal(after.score[len(models.F) :], score(after.F, added, pair))
        completed += len(added) > 0
        nothing = Verified(hypotheses.F[:0], which[:0], models.score[:0])
        assert part(Hypotheses(hypotheses.F[:0], which[:0], sample, 0), nothing, -np.inf, pair) is nothing
    assert completed >= 4


@pytest.mark.parametrize("kind", SMALL_KINDS)
@pytest.mark.parametrize("count", [8, 20])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_what_determines_no_plane(kind: str, count: int, scale: float) -> None:
    """Any model at all: nothing raises, and what is added is finite."""
    if kind == "coincident":
        return  # refused before any search
    c, rng = small()[f"{count} {kind}"], np.random.default_rng(0)
    pair = pair_of(c.replace(x0=scale * c.x0, x1=scale * c.x1))
    F = np.vstack([np.zeros(9), np.ones(9), rng.normal(size=(10, 9))]).astype(np.float32)
    sample = np.stack([rng.permutation(count)[:7] for _ in F], 1)
    for m in range(len(F)):
        hypotheses = Hypotheses(F[m : m + 1], np.array([m]), sample, 0)
        models = Verified(F[m : m + 1], np.array([0]), np.array([1.0]))
        after = Degensac(Msac(1.0))(hypotheses, models, -np.inf, pair)
        assert np.isfinite(after.F).all()
        assert np.isfinite(after.score).all()


def test_laws() -> None:
    estimator = HypothesizeAndVerify(**OPTIONS, degeneracy="degensac")
    pairs = [planar(i)[0] for i in range(5)]
    degenerate = [
        pairs[0].replace(x1=pairs[0].x0 * 1.1 + 3),  # one plane, nothing off it
        pairs[0].replace(x0=torch.full_like(pairs[0].x0, 100.0)),
        pairs[0].replace(mask=torch.arange(COUNT)[None] < 8),
    ]

    def values(e: Estimate) -> dict[str, torch.Tensor]:
        return {"F": e.F, "inliers": e.inliers, "ok": e.ok, "draws": e.draws}

    together = estimator(collate([*degenerate, *pairs]))
    assert not bool(torch.isnan(together.F).any())
    for i, pair in enumerate(pairs):
        alone = estimator(pair)
        assert_same(values(alone), values(together[i + len(degenerate)]), f"pair {i}")
    padded = torch.nn.functional.pad
    garbage = [padded(x, (0, 0, 0, 77), value=torch.nan) for x in (pairs[0].x0, pairs[0].x1)]
    wide = estimator(pairs[0].replace(x0=garbage[0], x1=garbage[1], mask=padded(pairs[0].mask, (0, 77))))
    assert torch.equal(wide.F, estimator(pairs[0]).F)


def test_degensac_needs_samples_of_seven() -> None:
    with pytest.raises(ValueError, match="degeneracy=degensac needs solver=seven_point; solver is 'eight_point'"):
        HypothesizeAndVerify(solver="eight_point", degeneracy="degensac")
