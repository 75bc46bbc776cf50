"""`find_homography` from matches to estimate."""

from typing import NamedTuple
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import torch

import fmtorch
from fmtorch.pipeline import load_pipeline
from tests.conftest import shared_path
from tests.reference import homography as reference

W, H = 640, 480
CORNERS = np.array([[0, 0], [W - 1, 0], [W - 1, H - 1], [0, H - 1]], float)
TRUTH = np.array([[0.85, -0.12, 60.0], [0.1, 0.9, -20.0], [1.5e-4, -2e-4, 1.0]])


class Matches(NamedTuple):
    """Matched points (n, 2) and which are right."""

    x0: np.ndarray
    x1: np.ndarray
    right: np.ndarray


def matches(seed: int, count: int = 200, noise: float = 0.5, wrong: float = 0.5, truth: np.ndarray = TRUTH) -> Matches:
    rng = np.random.default_rng(seed)
    x0 = rng.uniform(0, [W, H], (count, 2))
    x1 = reference.mapped(truth.ravel(), x0)
    right = np.arange(count) >= wrong * count
    x0[~right], x1[~right] = (rng.uniform(0, [W, H], (int((~right).sum()), 2)) for _ in range(2))
    x0[right] += noise * rng.normal(size=x0[right].shape)
    x1[right] += noise * rng.normal(size=x1[right].shape)
    return Matches(x0, x1, right)


def corner_error(estimated: torch.Tensor, truth: np.ndarray = TRUTH) -> float:
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
    information = reference.gauss_newton(h, exact, np.ones(exact.shape[1]))
    covariance = (noise / unit) ** 2 * np.linalg.pinv(information, rcond=1e-12)
    moved = [(reference.mapped(h + 1e-6 * v, CORNERS / unit) - reference.mapped(h, CORNERS / unit)) for v in np.eye(9)]
    J = np.stack(moved, -1).reshape(8, 9) / 1e-6 * unit
    return float(np.sqrt(np.trace(J @ covariance @ J.T) / 4))


def test_noise_and_wrong_matches() -> None:
    for seed in range(10):
        m = matches(seed)
        estimate = fmtorch.find_homography(m.x0, m.x1, seed=seed)
        assert (estimate.ok.tolist(), estimate.reason, estimate.model) == ([True], ("",), "homography")
        assert bool(estimate.related.all())
        assert torch.linalg.norm(estimate.H[0]) == pytest.approx(1, abs=1e-14)
        assert (torch.from_numpy(np.c_[m.x0, np.ones(200)][m.right]) @ estimate.H[0, 2] > 0).all()
        # Were all of it in one direction, a normal error would exceed 4 deviations (3.6 of a fit with an efficiency of
        # 80 %) once in 3000 pairs.
        assert corner_error(estimate.H[0]) < 4 * expected_error(m, 0.5)
        # Inliers lie within 5 standard deviations: P(|r| > 2.5 px) is 4e-6 for a right match, but for H's own error.
        inliers = estimate.inliers[0].numpy()
        assert inliers[m.right].all()
        assert inliers[~m.right].sum() <= 3


def broken() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    m = matches(1, 20, noise=0, wrong=0)
    line, places = np.c_[m.x0[:, 0], 0.5 * m.x0[:, 0] + 10], np.arange(20) % 2
    return {
        "three": (m.x0[:3], m.x1[:3]),
        "collinear": (line, reference.mapped(TRUTH.ravel(), line)),
        "collinear in image 1": (m.x0, m.x1 * [1, 0] + [0, 7]),
        "two places": (m.x0[places], m.x1[places]),
        "infinite": (m.x0, m.x1 * np.inf),
    }


@pytest.mark.parametrize("kind", broken())
def test_what_determines_no_homography_is_not_ok_with_a_reason(kind: str) -> None:
    estimate = fmtorch.find_homography(*broken()[kind])
    assert estimate.ok.tolist() == [False]
    assert estimate.reason[0]
    assert estimate.significance.tolist() == [-np.inf]
    assert not estimate.H.any()
    assert not estimate.inliers.any()


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


def test_another_model_is_refused() -> None:
    m = matches(11)
    fundamental, homography = (fmtorch.find_fundamental, fmtorch.find_homography)
    colmap = {"estimator": "colmap"}
    for find, options, said in (
        (homography, {"estimator": "fmtorch"}, "gives fundamental matrices; find_homography needs"),
        (homography, colmap, r"find_homography needs one that gives .* \(here by model=homography\)"),
        (fundamental, {"estimator": "homography"}, "gives homography matrices; find_fundamental needs"),
        (fundamental, colmap | {"model": "homography"}, "estimator=colmap gives homography matrices"),
        (fundamental, colmap | {"model": "line"}, "model=line; it must be one of: fundamental, homography"),
    ):
        with pytest.raises(ValueError, match=said):
            find(m.x0, m.x1, **options)
    with pytest.raises(AttributeError, match="fundamental"):
        _ = fmtorch.find_fundamental(m.x0, m.x1).H


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


def test_a_pipeline_needs_fundamental_matrices() -> None:
    with pytest.raises(ValueError, match="the estimator gives homography matrices; a pipeline needs fundamental"):
        load_pipeline("sift_gms", overrides=["estimator=homography"])


def test_matches_that_are_not_finite_are_left_out() -> None:
    m = matches(2)
    x0 = m.x0.copy()
    x0[150:160] = np.nan
    estimate = fmtorch.find_homography(x0, m.x1)
    assert bool(estimate.ok)
    assert not estimate.inliers[0, 150:160].any()
    assert corner_error(estimate.H[0]) < 4 * expected_error(Matches(m.x0, m.x1, m.right & np.isfinite(x0[:, 0])), 0.5)
