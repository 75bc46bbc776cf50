"""Pose errors of rows: of known cameras as the reference has them, and why a pair has none."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from fmtorch.core import Correspondences, Estimate
from fmtorch.data import ImagePair, ImageSource
from fmtorch.evaluation import evaluate
from fmtorch.pipeline import Outcome
from tests.geometry.scenes import scene
from tests.reference import metrics as reference
from tests.reference import solvers

N = 30


def outcome(seed: int, noise: float = 1.0) -> Outcome:
    """A pair of known cameras whose F is of the eight-point algorithm, with a match or two that are no inliers."""
    s = scene(N, seed, noise)
    F = torch.from_numpy(solvers.eight_point(s.x0.numpy(), s.x1.numpy()))
    pair = ImagePair(
        f"p{seed}", "family", "scene", ImageSource("a", Path("a")), ImageSource("b", Path("b")), s.F.numpy(),
        s.K0.numpy(), s.K1.numpy(), s.R.numpy(), s.t.numpy(),
    )  # fmt: skip
    size = torch.tensor([[800, 1000]])
    c = Correspondences(s.x0[None], s.x1[None], torch.ones(1, N, dtype=torch.bool), size0=size, size1=size)
    inliers = torch.arange(N)[None] < N - seed
    estimate = Estimate((F / F.norm())[None], inliers, torch.tensor([True]), ("",), torch.tensor([1]))
    return Outcome(pair, (N, N), c, estimate)


def without(o: Outcome, **changes: object) -> Outcome:
    return dataclasses.replace(o, pair=dataclasses.replace(o.pair, **changes))


def test_rows_have_the_pose_errors_of_the_reference() -> None:
    outcomes = [outcome(seed) for seed in range(4)]
    for o, row in zip(outcomes, evaluate(outcomes), strict=True):
        kept = o.estimate.inliers[0].numpy()
        x0, x1 = (x[0].numpy()[kept] for x in (o.correspondences.x0, o.correspondences.x1))
        R, t, _ = solvers.pose(o.estimate.F[0].numpy(), o.pair.K0, o.pair.K1, x0, x1)
        assert row.rotation_error == pytest.approx(reference.rotation_angle(R, o.pair.R), abs=1e-7)
        assert row.translation_error == pytest.approx(reference.direction_angle(t, o.pair.t), abs=1e-7)
        assert row.pose_reason is None
        assert 0 < row.rotation_error < 20


def test_why_a_pair_has_no_pose_error() -> None:
    sound = outcome(0)
    failed = dataclasses.replace(outcome(1), estimate=None, correspondences=None, reason="no keypoints in image 0")
    nothing = dataclasses.replace(
        outcome(2), estimate=sound.estimate.replace(inliers=torch.zeros(1, N, dtype=torch.bool))
    )
    uncalibrated = without(outcome(3), K0=None, K1=None)
    unposed = without(outcome(4), R=None, t=None)
    broken = without(outcome(5), t=np.full(3, np.nan))
    rows = evaluate([failed, uncalibrated, sound, unposed, nothing, broken])
    assert [(row.rotation_error, row.translation_error, row.pose_reason) for row in (*rows[:2], *rows[3:])] == [
        (180.0, 90.0, "no F"),
        (None, None, "K0, K1 unknown"),
        (None, None, "R, t unknown"),
        (180.0, 90.0, "no inlier in front of both cameras"),
        (None, None, "t not finite"),
    ]
    (alone,) = evaluate([sound])
    assert (alone.rotation_error, alone.translation_error) == (rows[2].rotation_error, rows[2].translation_error)


def test_signed_errors_are_of_the_best_of_four_poses_and_keep_the_sign_of_an_estimates_own() -> None:
    outcomes = [outcome(seed) for seed in range(3)]
    for o, row in zip(outcomes, evaluate(outcomes, signed=True), strict=True):
        four = solvers.poses(o.pair.K1.T @ o.estimate.F[0].numpy() @ o.pair.K0)
        expected = reference.closest_pose_error(four, o.pair.R, o.pair.t)
        assert (row.rotation_error, row.translation_error) == pytest.approx(expected, abs=1e-6)
    own = [o.estimate.replace(R=torch.eye(3)[None], t=-torch.from_numpy(o.pair.t)[None].float()) for o in outcomes]
    posed = [dataclasses.replace(o, estimate=estimate) for o, estimate in zip(outcomes, own, strict=True)]
    for row, folded in zip(evaluate(posed, signed=True), evaluate(posed), strict=True):
        assert row.translation_error == pytest.approx(180, abs=0.1)  # t in float32: the root of its rounding
        assert folded.translation_error == pytest.approx(0, abs=0.1)
        assert row.rotation_error == folded.rotation_error
    failed = dataclasses.replace(outcomes[0], estimate=None, correspondences=None, reason="no keypoints in image 0")
    nothing = dataclasses.replace(outcomes[1], estimate=outcomes[1].estimate.replace(F=torch.zeros(1, 3, 3).double()))
    rows = evaluate([failed, nothing], signed=True)
    assert [(row.rotation_error, row.translation_error) for row in rows] == [(180.0, 180.0)] * 2
    assert [row.pose_reason for row in rows] == ["no F", "F has no pose"]
