"""Lenses that nobody calibrated: `find_fundamental` and `find_essential` of bent photographs."""

import re
from typing import Any

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch.core.types import Estimate
from fmtorch.metrics import nsgd
from fmtorch.two_view.arguments import lens_fields
from tests.reference import lenses as division

SIZE = (480, 640)
SIZES = {"size0": SIZE, "size1": SIZE}
INF = float("inf")


def found(x0: Any, x1: Any, **said: Any) -> Estimate:
    return fmtorch.find_fundamental(x0, x1, **SIZES | said)


def error(estimate: Estimate, F: np.ndarray, i: int = 0) -> float:
    size = torch.tensor(SIZE)
    return float(nsgd(torch.from_numpy(F), estimate.F[i], size, size))


def lenses(estimate: Estimate) -> list[float]:
    assert estimate.lens is not None
    return estimate.lens[0].tolist()


@pytest.mark.parametrize(
    ("lens", "fields"),
    [
        (-0.1, [[-0.1, 0], [-0.1, 0]]),
        ((-0.1, 0.02), [[-0.1, 0.02], [-0.1, 0.02]]),
        (((-0.1, 0), None), [[-0.1, 0], [0, INF]]),
        ("shared", [[0, INF], [0, INF]]),
        (np.full((3, 2, 2), 0.1), [[[0.1, 0.1], [0.1, 0.1]]] * 3),
    ],
)
def test_forms_of_what_is_known(lens: Any, fields: Any) -> None:
    assert lens_fields(lens)["lens"].tolist() == fields
    assert ("shared_lens" in lens_fields(lens)) == isinstance(lens, str)
    assert lens_fields(None) == {}


@pytest.mark.parametrize("lens", [-0.1, -0.3])
def test_one_unknown_lens(lens: float) -> None:
    x0, x1, F, _ = division.photographs(1, (lens, lens))
    estimate = found(x0, x1, lens="shared")
    assert lenses(estimate) == pytest.approx([lens, lens], abs=0.02)
    known = found(x0, x1, lens=lens)
    assert lenses(known) == pytest.approx([lens, lens], abs=1e-4)
    assert error(known, F) < 0.01
    assert error(estimate, F) < min(0.01, error(found(x0, x1), F))
    right = np.arange(len(x0)) >= len(x0) // 4
    distances = np.array(
        [
            division.sampson(estimate.F[0].numpy(), np.r_[a, b], (SIZE, SIZE), (lens, lens))
            for a, b in zip(x0, x1, strict=True)
        ]
    )
    inliers = estimate.inliers[0].numpy()
    assert inliers[right].mean() > 0.97
    assert np.abs(distances[inliers]).max() < 2.5


def test_a_straight_lens_costs_nothing() -> None:
    x0, x1, _, _ = division.photographs(2, (0, 0))
    estimate = found(x0, x1, lens="shared")
    assert lenses(estimate) == [0, 0]
    assert torch.equal(estimate.F, found(x0, x1).F)


def test_two_lenses_one_of_them_straight() -> None:
    x0, x1, F, _ = division.photographs(3, (-0.2, 0))
    estimate = found(x0, x1, lens="unknown")
    assert lenses(estimate) == pytest.approx([-0.2, 0], abs=0.04)
    rough = found(x0, x1, lens=((-0.15, 0.05), (0, 0)))
    assert lenses(rough) == pytest.approx([-0.2, 0], abs=0.03)
    assert max(error(estimate, F), error(rough, F)) < 0.007 < error(found(x0, x1), F)


def test_a_pose_through_a_lens() -> None:
    x0, x1, _, K = division.photographs(4, (-0.2, -0.2))
    for estimate, most in (
        (fmtorch.find_essential(x0, x1, K, K, lens="shared", **SIZES), 1.0),
        (found(x0, x1, lens="shared", focal="shared"), 3.0),
    ):
        assert lenses(estimate) == pytest.approx([-0.2, -0.2], abs=0.03)
        assert estimate.t is not None
        cosine = float(estimate.t[0] @ torch.nn.functional.normalize(torch.tensor([-0.8, 0.1, 0.3]).double(), dim=0))
        assert np.degrees(np.arccos(min(cosine, 1))) < most


def test_pairs_keep_to_themselves() -> None:
    pairs = [division.photographs(5, (-0.2, -0.2))[:2], division.photographs(6, (0, 0))[:2]]
    pairs.append((pairs[0][0][:30], np.full((30, 2), 100.0)))
    together = found([x for x, _ in pairs], [x for _, x in pairs], lens="shared")
    assert together.ok.tolist() == [True, True, False]
    assert together.lens is not None
    for i, pair in enumerate(pairs):
        alone = found(*pair, lens="shared")
        assert torch.equal(together.F[i], alone.F[0])
        assert alone.lens is not None
        assert torch.equal(together.lens[i].nan_to_num(9), alone.lens[0].nan_to_num(9))


def test_sizes_may_be_assumed() -> None:
    x0, x1, F, _ = division.photographs(1, (-0.2, -0.2))
    estimate = fmtorch.find_fundamental(x0, x1, lens="shared")
    assert estimate.sizes is not None
    assert estimate.sizes.isfinite().all()
    assert lenses(estimate) == pytest.approx([-0.2, -0.2], abs=0.05)
    assert error(estimate, F) < 0.02
    centred = fmtorch.find_fundamental(x0 - 300, x1 - 300, lens="shared")
    assert centred.reason == ("a lens needs the image sizes",)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"lens": "fisheye"}, "lens is 'fisheye'; it must be None, 'unknown', 'shared', lambda"),
        ({"lens": -0.6}, "lens of image 0 of pair 0 is [-0.6, 0.0]; it is lambda in half diagonals, from -0.45"),
        ({"lens": (-0.1, -1)}, "lens of image 0 of pair 0 is"),
        ({"lens": (0.1, 0.1, 0.1)}, "lens has shape (3,)"),
        ({"lens": "shared", "covariance": True}, "covariance and pair_type are of pinholes"),
        ({"lens": "shared", "size0": "unknown", "size1": "unknown"}, "lens needs the image sizes"),
        ({"lens": "shared", "K0": np.eye(3), "K1": np.eye(3), "size0": None, "size1": None}, "lens needs the image"),
        ({"lens": "shared", "estimator": "ransac"}, "lens needs an estimator with the option focal"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(said: dict[str, Any], message: str) -> None:
    x0, x1, _, _ = division.photographs(1, (0, 0))
    with pytest.raises(ValueError, match=re.escape(message)):
        found(x0, x1, **said)


def test_gradients_are_refused() -> None:
    x0, x1, _, _ = division.photographs(1, (0, 0))
    with pytest.raises(ValueError, match="lens is given, and its estimates have no gradients"):
        found(torch.from_numpy(x0).requires_grad_(), torch.from_numpy(x1), lens="shared")
