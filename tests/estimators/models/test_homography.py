"""`find_homography` from matches to estimate."""

from __future__ import annotations

from typing import NamedTuple
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import Correspondences, presets
from fmtorch.estimators import Ransac
from fmtorch.pipeline.build import load_pipeline
from tests.conftest import shared_path
from tests.reference import homography_family as reference

W, H = 640, 480
CORNERS = np.array([[0, 0], [W - 1, 0], [W - 1, H - 1], [0, H - 1]], float)
TRUTH = np.array([[0.85, -0.12, 60.0], [0.1, 0.9, -20.0], [1.5e-4, -2e-4, 1.0]])
ROAD = np.array([[1.0, 0.2, -50.0], [0.0, 1.2, -200.0], [0.0, 4e-3, -0.4]])  # its horizon is the line y = 100


class Matches(NamedTuple):
    """Matched points (n, 2) and which are right."""

    x0: np.ndarray
    x1: np.ndarray
    right: np.ndarray


def matches(
    seed: int, count: int = 200, noise: float = 0.5, wrong: float = 0.5, truth: np.ndarray = TRUTH, top: float = 0
) -> Matches:
    """Noise in px of every coordinate. top: y from which on right matches lie."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform([0, top], [W, H], (count, 2))
    x1 = reference.mapped(truth.ravel(), x0)
    right = np.arange(count) >= wrong * count
    x0[~right], x1[~right] = (rng.uniform(0, [W, H], (int((~right).sum()), 2)) for _ in range(2))
    x0[right] += noise * rng.normal(size=x0[right].shape)
    x1[right] += noise * rng.normal(size=x1[right].shape)
    return Matches(x0, x1, right)


def corner_error(estimated: torch.Tensor, truth: np.ndarray = TRUTH) -> float:
    """The mean distance of the corners in px."""
    apart = reference.mapped(estimated.detach().numpy(), CORNERS) - reference.mapped(truth.ravel(), CORNERS)
    return float(np.linalg.norm(apart, axis=1).mean())


def expected_error(m: Matches, noise: float) -> float:
    """The root of the mean squared distance of the corners that least squares of the right matches has in theory."""
    unit = 300.0
    to_units = np.diag([1 / unit, 1 / unit, 1.0])
    h = (to_units @ TRUTH @ np.linalg.inv(to_units)).ravel()
    points = np.c_[m.x0, m.x1][m.right].T / unit
    exact = points.copy()
    exact[2:] = reference.mapped(h, points[:2].T).T
    covariance = (noise / unit) ** 2 * np.linalg.pinv(
        reference.gauss_newton(h, exact, np.ones(exact.shape[1])), rcond=1e-12
    )
    moved = [(reference.mapped(h + 1e-6 * v, CORNERS / unit) - reference.mapped(h, CORNERS / unit)) for v in np.eye(9)]
    J = np.stack(moved, -1).reshape(8, 9) / 1e-6 * unit
    return float(np.sqrt(np.trace(J @ covariance @ J.T) / 4))


def test_noise_and_wrong_matches() -> None:
    for seed in range(10):
        m = matches(seed)
        estimate = fmtorch.find_homography(m.x0, m.x1, seed=seed)
        assert estimate.ok.tolist() == [True]
        assert estimate.reason == ("",)
        assert estimate.model == "homography"
        assert estimate.significance.isnan().all()
        assert torch.linalg.norm(estimate.H[0]) == pytest.approx(1, abs=1e-14)
        assert (torch.from_numpy(np.c_[m.x0, np.ones(200)][m.right]) @ estimate.H[0, 2] > 0).all()
        # Were all of it in one direction, a normal error would exceed 4 deviations (3.6 of a fit with an efficiency of
        # 80 %) once in 3000 pairs.
        assert corner_error(estimate.H[0]) < 4 * expected_error(m, 0.5)
        # Inliers lie within 5 standard deviations: P(|r| > 2.5 px) is 4e-6 for a right match, but for H's own error.
        inliers = estimate.inliers[0].numpy()
        assert inliers[m.right].all()
        assert inliers[~m.right].sum() <= 3


def test_wrong_matches_beyond_the_horizon() -> None:
    """A road: right matches below its horizon, wrong ones on both sides of it."""
    for seed in range(5):
        m = matches(seed, truth=ROAD, top=200)
        estimate = fmtorch.find_homography(m.x0, m.x1, seed=seed)
        below = Matches(m.x0[m.right], m.x1[m.right], m.right[m.right])
        alone = fmtorch.find_homography(*below[:2], seed=seed)
        assert bool(estimate.ok)
        assert bool(alone.ok)
        # Cauchy's weight of a wrong match falls with the square of its distance: the two fits are nearer to each other
        # at the right matches than these are to them, 0.5 px.
        a, b = (reference.mapped(each.H[0].numpy(), below.x0) for each in (estimate, alone))
        assert np.sqrt(np.square(a - b).sum(1).mean()) < 0.5


def test_four_exact_matches() -> None:
    for seed in range(10):
        m = matches(seed, 4, noise=0, wrong=0)
        estimate = fmtorch.find_homography(m.x0, m.x1)
        assert estimate.ok.tolist() == [True]
        assert estimate.inliers.all()
        # The fit is in float64: 1e-13 of 640 px, times the condition of four points, 1e3 or so.
        assert corner_error(estimate.H[0]) < 1e-7


def broken(kind: str) -> tuple[np.ndarray, np.ndarray]:
    m = matches(1, 20, noise=0, wrong=0)
    x0, x1 = m.x0.copy(), m.x1.copy()
    if kind == "none":
        x0, x1 = x0[:0], x1[:0]
    elif kind == "three":
        x0, x1 = x0[:3], x1[:3]
    elif kind == "collinear":
        x0[:, 1] = 0.5 * x0[:, 0] + 10
        x1 = reference.mapped(TRUTH.ravel(), x0)
    elif kind == "collinear in image 1":
        x1[:, 1] = 7
    elif kind == "coincident":
        x0[:], x1[:] = x0[0], x1[0]
    elif kind == "two places":
        x0[::2], x1[::2], x0[1::2], x1[1::2] = x0[0], x1[0], x0[1], x1[1]
    elif kind == "NaN":
        x0[:] = np.nan
    elif kind == "infinite":
        x1[:] = np.inf
    elif kind == "mirrored":
        x1[:, 0] *= -1
    return x0, x1


BROKEN = [
    "none", "three", "collinear", "collinear in image 1", "coincident", "two places", "NaN", "infinite", "mirrored",
]  # fmt: skip


@pytest.mark.parametrize("kind", BROKEN)
def test_what_determines_no_homography_is_not_ok_with_a_reason(kind: str) -> None:
    x0, x1 = broken(kind)
    estimate = fmtorch.find_homography(x0, x1)
    assert estimate.ok.tolist() == [False]
    assert estimate.reason[0]
    assert estimate.significance.tolist() == [-np.inf]
    assert not estimate.H.any()
    assert not estimate.inliers.any()


def test_matches_that_are_not_finite_are_left_out() -> None:
    m = matches(2)
    x0 = m.x0.copy()
    x0[150:160] = np.nan
    estimate = fmtorch.find_homography(x0, m.x1)
    assert bool(estimate.ok)
    assert not estimate.inliers[0, 150:160].any()
    assert corner_error(estimate.H[0]) < 4 * expected_error(Matches(m.x0, m.x1, m.right & np.isfinite(x0[:, 0])), 0.5)


def test_the_prior_chooses_between_two_planes() -> None:
    other = np.array([[1.1, 0.1, -40.0], [-0.05, 1.0, 30.0], [-1e-4, 1e-4, 1.0]])
    a, b = matches(3, 100, wrong=0), matches(4, 100, wrong=0, truth=other)
    x0, x1 = np.concatenate([a.x0, b.x0]), np.concatenate([a.x1, b.x1])
    first = np.arange(200) < 100
    for chosen, truth in ((first, TRUTH), (~first, other)):
        estimate = fmtorch.find_homography(x0, x1, prior=np.where(chosen, 0.9, 0.05))
        assert bool(estimate.ok)
        assert corner_error(estimate.H[0], truth) < 3
        assert estimate.inliers[0].numpy()[chosen].mean() > 0.95
    with pytest.raises(ValueError, match="prior"):
        fmtorch.find_homography(x0, x1, prior=np.full(200, 1.5))


def test_gradients_equal_finite_differences() -> None:
    """At exact matches, where weights do not change to first order; of wrong ones they are zero."""
    m = matches(5, 60, noise=0, wrong=0.3)
    x1 = torch.from_numpy(m.x1).requires_grad_()
    estimate = fmtorch.find_homography(m.x0, x1)
    v = torch.from_numpy(np.random.default_rng(0).normal(size=(3, 3)) * [[1, 1, 1], [1, 1, 1], [1e3, 1e3, 1]])
    (gradient,) = torch.autograd.grad((estimate.H[0] * v).sum(), x1)
    step = 1e-3  # px: 1e-6 of the error of central differences, which is (step / 0.3 px, the scale of the loss)^2
    size = float(gradient.norm())
    assert size > 0
    for i in (18, 30, 59):
        for k in range(2):
            values = []
            for sign in (1, -1):
                moved = m.x1.copy()
                moved[i, k] += sign * step
                values.append(float((fmtorch.find_homography(m.x0, moved).H[0] * v).sum()))
            assert gradient[i, k] == pytest.approx((values[0] - values[1]) / (2 * step), abs=1e-3 * size)
    assert (gradient[~m.right].abs() < 1e-3 * size).all()


@pytest.mark.parametrize(("final", "tolerance"), [("gauss_newton", 0.03), ("adaptive", 0.1)])
def test_gradients_under_noise_are_those_of_the_estimate(final: str, tolerance: float) -> None:
    """Against finite differences of the whole estimate, along random directions.

    The scale of the adaptive fit is held, though it changes with the residuals, and both stop near the optimum.
    """
    m = matches(2, 60, 0.3, 0.2)
    x0, x1 = (torch.from_numpy(x).requires_grad_() for x in (m.x0, m.x1))
    weight = torch.from_numpy(np.random.default_rng(0).normal(size=(3, 3)))

    def value(x0: torch.Tensor, x1: torch.Tensor) -> torch.Tensor:
        model = fmtorch.find_homography(x0, x1, final=final).H[0]
        return (model / model[2, 2] * weight).sum()

    gradients = torch.autograd.grad(value(x0, x1), (x0, x1))
    rng, step, attached, numeric = np.random.default_rng(1), 1e-3, [], []  # px
    for _ in range(12):
        directions = [torch.from_numpy(rng.normal(size=(60, 2))) for _ in range(2)]
        with torch.no_grad():
            ahead, behind = (value(x0 + s * directions[0], x1 + s * directions[1]) for s in (step, -step))
        numeric.append(float(ahead - behind) / (2 * step))
        attached.append(float(sum((g * d).sum() for g, d in zip(gradients, directions, strict=True))))
    apart = np.linalg.norm(np.subtract(attached, numeric)) / np.linalg.norm(numeric)
    assert apart < tolerance, apart


def test_the_same_bits_alone_and_in_a_batch() -> None:
    each = [matches(seed, count) for seed, count in ((6, 40), (7, 200), (8, 3), (9, 90))]
    x0, x1 = [m.x0 for m in each], [m.x1 for m in each]
    keys = [11, 12, 13, 14]
    together = fmtorch.find_homography(x0, x1, key=np.array(keys), seed=3)
    assert together.ok.tolist() == [True, True, False, True]
    for i, m in enumerate(each):
        alone = fmtorch.find_homography(m.x0, m.x1, key=keys[i], seed=3)
        assert torch.equal(alone.H[0], together.H[i])
        assert alone.reason[0] == together.reason[i]
        assert torch.equal(alone.inliers[0], together.inliers[i, : len(m.x0)])
        assert not together.inliers[i, len(m.x0) :].any()


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_any_unit_of_pixels(scale: float) -> None:
    """Thresholds are pixels: all matches are inliers of points within a pixel, only exact ones of huge images."""
    m = matches(10, noise=0, wrong=0.3)
    # Behind the door, which refuses points within a pixel.
    points = [scale * torch.from_numpy(x)[None] for x in (m.x0, m.x1)]
    estimate = presets.build("estimator", "homography")(
        Correspondences(*points, torch.ones(1, len(m.x0), dtype=torch.bool))
    )
    assert estimate.ok.tolist() == [True]
    assert estimate.H.isfinite().all()
    if scale > 1:
        np.testing.assert_array_equal(estimate.inliers[0].numpy(), m.right)
        S = np.diag([scale, scale, 1])
        # Rounding grows with the points, so at the scale of the photograph it is that of exact matches above.
        assert corner_error(torch.from_numpy(np.linalg.inv(S) @ estimate.H[0].numpy() @ S)) < 1e-7
    else:
        assert estimate.inliers.all()


def test_another_model_is_refused() -> None:
    m = matches(11)
    with pytest.raises(ValueError, match="gives fundamental matrices; find_homography needs"):
        fmtorch.find_homography(m.x0, m.x1, estimator="fmtorch")
    with pytest.raises(ValueError, match="gives homography matrices; find_fundamental needs"):
        fmtorch.find_fundamental(m.x0, m.x1, estimator="homography")
    with pytest.raises(AttributeError, match="fundamental"):
        _ = fmtorch.find_fundamental(m.x0, m.x1).H


def test_a_warped_photograph() -> None:
    image = cv2.imread(str(shared_path("data/planar/graf/graf1.png")))
    h, w = image.shape[:2]
    c = fmtorch.match(image, cv2.warpPerspective(image, TRUTH, (w, h)), pipeline="sift_fmtorch").correspondences
    estimate = fmtorch.find_homography(c.x0, c.x1, mask=c.mask, ratio=c.ratio, prior=c.prior, noise=c.noise)
    assert bool(estimate.ok)
    assert corner_error(estimate.H[0]) < 0.5


def test_a_photographed_wall() -> None:
    """Graffiti 1 and 3 of Mikolajczyk and Schmid, whose homography is known to about a pixel."""
    folder = shared_path("data/planar/graf")
    a, b = (cv2.imread(str(folder / name)) for name in ("graf1.png", "graf3.png"))
    text = ElementTree.parse(folder / "H1to3p.xml").getroot().findtext(".//data")
    truth = np.array(str(text).split(), float).reshape(3, 3)
    c = fmtorch.match(a, b, pipeline="sift_fmtorch").correspondences
    estimate = fmtorch.find_homography(c.x0, c.x1, mask=c.mask, ratio=c.ratio, prior=c.prior, noise=c.noise)
    assert bool(estimate.ok)
    assert corner_error(estimate.H[0], truth) < 5


@pytest.mark.parametrize("options", [{"degeneracy": "degensac"}, {"local_optimization": "graph_cut"}, {"focal": {}}])
def test_parts_for_fundamental_matrices_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"seven_point|is for fundamental matrices"):
        Ransac(solver="four_point", **options)


def test_a_pipeline_needs_fundamental_matrices() -> None:
    with pytest.raises(ValueError, match="the estimator gives homography matrices; a pipeline needs fundamental"):
        load_pipeline("sift_gms", overrides=["estimator=homography"])
