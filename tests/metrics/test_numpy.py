"""Every metric takes NumPy arrays as it takes tensors."""

from typing import Any

import numpy as np
import pytest
import torch

from fmtorch import metrics

RNG = np.random.default_rng(0)
F0, F1, R = RNG.normal(size=(3, 4, 3, 3))
X0, X1 = RNG.uniform(0, 400, (2, 4, 20, 2))
T = RNG.normal(size=(4, 3))
SIZES = np.array([[480, 640]] * 4)
CALLS: dict[str, tuple[Any, ...]] = {
    "sgd": (F0, F1, SIZES, SIZES), "nsgd": (F0, F1, SIZES, SIZES), "nsgd_released": (F0, F1, SIZES, SIZES),
    "inlier_rate": (F0, X0, X1, X0[..., 0] > 9, SIZES, SIZES), "ground_truth_inliers": (F0, X0, X1, SIZES, SIZES),
    "pose_error": (R, T, R[::-1], T[::-1]), "pose_auc": (T[:, 0],), "recall": (T,), "recall_curve": (T, T[0]),
    "mean_recall": (T,), "pose_map": (T[:, 0],), "pose_maa": (T,),
    "fundamental_pose_error": (F0, np.eye(3) + 0 * R, np.eye(3) + 0 * R, X0, X1, R, T),
    "closest_pose_error": (F0, np.eye(3) + 0 * R, np.eye(3) + 0 * R, R, T),
    "corner_error": (F0, F1, SIZES), "right_of_homography": (F0, X0, X1),
}  # fmt: skip


def test_every_metric_is_called() -> None:
    functions = {name for name in metrics.__all__ if name.islower()}
    assert functions == CALLS.keys()


@pytest.mark.parametrize("name", CALLS)
def test_arrays_are_taken_as_tensors(name: str) -> None:
    function = getattr(metrics, name)
    expected = function(*(torch.from_numpy(np.ascontiguousarray(value)) for value in CALLS[name]))
    for arguments in (CALLS[name], [CALLS[name][0], *map(torch.tensor, map(np.ascontiguousarray, CALLS[name][1:]))]):
        result = function(*arguments)
        for a, b in zip(result, expected, strict=True):
            assert isinstance(a, torch.Tensor)
            assert torch.equal(a, b)


def test_a_size_may_be_a_tuple() -> None:
    tuples = metrics.nsgd(F0, F1, (480, 640), size1=[480, 640], key=np.arange(4))
    assert torch.equal(tuples, metrics.nsgd(F0, F1, SIZES, SIZES, key=torch.arange(4)))
