"""Minimal solvers, the oriented constraint and weighted fits, against definitions, OpenCV and kornia."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from kornia.geometry.epipolar import find_fundamental
from scipy.spatial.transform import Rotation

from fmtorch.geometry import canonical, seven_point
from fmtorch.geometry.eight_point import eight_point_kernel, weighted_eight_point
from fmtorch.geometry.five_point import five_point
from fmtorch.geometry.seven_point import cube_root, cubic_roots, seven_point_kernel
from fmtorch.jit.kernel import F8x1, kernel
from tests import laws
from tests.conftest import oracle
from tests.estimators.pairs import normalized
from tests.geometry.scenes import scene, scenes
from tests.reference import solvers as reference

Kernel = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], int]
SOLVERS: dict[str, tuple[Kernel, int, int]] = {"seven": (seven_point_kernel, 7, 3), "eight": (eight_point_kernel, 8, 1)}
SAMPLES = 203  # not whole lanes
DIFFERENT = [((1, -6, 11, -6), [1, 2, 3]), ((1, 0, 0, -8), [2]), ((1, 0, 1, 0), [0])]
EQUAL = [((1, -3, 3, -1), [1, 1, 1]), ((1, 0, 0, 0), [0, 0, 0]), ((2, 0, 0, 0), [0, 0, 0]), ((0, 1, 0, 0), [0, 0])]
QUADRATIC = [((0, 1, -3, 2), [1, 2]), ((0, 1, 0, 1), []), ((1e-12, 1, -3, 2), [-1e12 - 3, 1 + 1e-12, 2 - 8e-12])]
LINEAR = [((0, 0, 2, -3), [1.5]), ((0, 0, 1, 0), [0]), ((0, 0, 0, 1), []), ((0, 0, 0, 0), [])]
LARGE = ((1, -1e8, -1e8, 1), [-1, 1e-8 - 1e-16, 1e8 + 1 - 1e-8])
SMALL = ((1e-9, 1e-9, -1, -1), [-31622.7766016838, -1, 31622.7766016838])
NOT_FINITE = [((float("nan"), 1, 1, 1), []), ((float("inf"), 1, 1, 1), [])]


def distance_to_nearest(F, solutions):
    """For each of the solutions the distance to the nearest row of F, all of unit norm and sign."""
    return (F[:, None] - solutions[None]).norm(dim=(-2, -1)).min(0).values


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_reference_opencv_and_kornia_live(batch):
    x0, x1, _ = (a.float().double() for a in scenes(batch, 7))  # OpenCV rounds points to float32
    F, valid = seven_point(x0, x1)
    assert F.shape == (*batch, 3, 3, 3)
    for i in np.ndindex(batch):
        a, b = x0[i].numpy(), x1[i].numpy()
        ours = F[i][valid[i]]
        ref = torch.from_numpy(np.stack(reference.seven_point(a, b)))
        stacked = torch.from_numpy(cv2.findFundamentalMat(a, b, cv2.FM_7POINT)[0].reshape(-1, 3, 3))
        kornia = find_fundamental(x0[i][None], x1[i][None], method="7POINT")[0]
        kornia = kornia[kornia.abs().amax((1, 2)) > 0]
        for theirs in (ref, stacked, kornia):
            assert len(theirs) == len(ours)
            # the null space's and the root's condition numbers, up to 1e3 each, times eps, and some room
            assert distance_to_nearest(ours, canonical(theirs)).max() < 1e-9
        assert torch.linalg.det(ours).abs().max() < 1e-15


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_samples_are_invalid_and_alone(dtype):
    x0, x1, _ = (a.to(dtype).clone() for a in scenes((8,), 7))
    good, good_valid = seven_point(x0, x1)
    x0[0, 3], x1[0, 3] = x0[0, 1], x1[0, 1]  # a repeated match
    x0[1], x1[1] = x0[1, :1], x1[1, :1]  # all the same
    x0[2, 4, 1] = torch.nan
    x1[3, 0, 0] = torch.inf
    line = torch.arange(7, dtype=dtype)[:, None]
    x0[4], x1[4] = line * torch.tensor([8.0, 16], dtype=dtype), line * torch.tensor([4.0, 4], dtype=dtype)
    x0[5], x1[5] = 0, 0
    F, valid = seven_point(x0, x1)
    assert not valid[:6].any()
    assert not F[:6].any()
    assert torch.equal(F[6:], good[6:])
    assert torch.equal(valid[6:], good_valid[6:])


def test_gradient():
    s = scene(7, seed=1)
    x0, x1 = (s.x0 / 500).requires_grad_(), (s.x1 / 500).requires_grad_()

    def invariant(a, b):
        F, valid = seven_point(a, b)
        return F[valid] @ F[valid].mT  # independent of the sign

    assert torch.autograd.gradcheck(invariant, (x0, x1))


def points_of() -> dict[str, np.ndarray]:
    """Points (4, n) of pairs of many kinds, in normalised units."""
    given = {"random": laws.scene(1, 300), "right": laws.scene(1, 300, outliers=0, noise=0)}
    given |= laws.degenerate() | laws.small()
    pairs = {name: normalized(c) for name, c in given.items()}
    return {name: pair[0].points for name, pair in pairs.items() if not isinstance(pair, str)}


def solved_by(solver: str, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Models (m, 9) of random samples, of which draw each is, and the samples (size, SAMPLES)."""
    kernel, size, most = SOLVERS[solver]
    rng, n = np.random.default_rng(0), points.shape[1]
    sample = np.stack([rng.permutation(max(n, size))[:size] % n for _ in range(SAMPLES)], 1)
    F, draw = np.empty((most * SAMPLES, 9), np.float32), np.empty(most * SAMPLES, np.int64)
    count = kernel(points, sample, F, draw)
    return F[:count].astype(np.float64), draw[:count], sample


@pytest.mark.parametrize("solver", SOLVERS)
def test_models_of_any_matches_are_sound_and_explain_their_samples(solver: str) -> None:
    for name, points in points_of().items():
        F, draw, sample = solved_by(solver, points)
        assert np.isfinite(F).all()
        assert (np.diff(draw) >= 0).all()
        np.testing.assert_allclose(np.linalg.norm(F, axis=1), 1, atol=1e-5)
        assert np.abs(np.linalg.det(F.reshape(-1, 3, 3))).max(initial=0) < 1e-6, name
        own = np.concatenate([points[:, sample[:, draw]], np.ones((1, *sample[:, draw].shape))])
        if solver == "seven":  # float32 models of points within 1
            residual = np.einsum("isk,kij,jsk->ks", own[[2, 3, 4]], F.reshape(-1, 3, 3), own[[0, 1, 4]])
            assert np.abs(residual).max(initial=0) < 1e-5, name


@pytest.mark.parametrize("kind", ["ones", "random", "some", "none"])
def test_weighted_fits_are_those_of_the_definition(kind: str) -> None:
    for name, points in points_of().items():
        rng, n = np.random.default_rng(2), points.shape[1]
        sparse = rng.random(n) * (rng.random(n) < 0.5)
        weight = {"ones": np.ones(n), "random": rng.random(n), "some": sparse, "none": np.zeros(n)}[kind]
        F = np.empty(9)
        solved_by = weighted_eight_point(points, weight, F)
        assert not solved_by or np.isfinite(F).all()
        if name in ("random", "right", "all outliers"):
            assert solved_by == (kind != "none")
            if solved_by:
                theirs = reference.eight_point(points[:2].T, points[2:].T, weight).ravel()
                # The sums of 300 products, each rounded, over the gap of the eigenvalues, some 1e-5.
                np.testing.assert_allclose(F * np.sign(F @ theirs), theirs, atol=1e-8, err_msg=name)


def rays(seed: int, noise: float = 0.0, plane: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Rays (4, 5 SAMPLES) and the true essential matrices (SAMPLES, 9), every five of another pair of cameras."""
    rng = np.random.default_rng(seed)
    X = np.concatenate([rng.uniform(-1.5, 1.5, (SAMPLES, 5, 2)), rng.uniform(3, 7, (SAMPLES, 5, 1))], 2)
    if plane:
        X[..., 2] = 5 + X[..., 0] * 0.3
    R = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, (SAMPLES, 3))).as_matrix()
    t = rng.normal(size=(SAMPLES, 3))
    Y = X @ R.transpose(0, 2, 1) + t[:, None]
    rays = np.concatenate([X[..., :2] / X[..., 2:], Y[..., :2] / Y[..., 2:]], 2) + rng.normal(0, noise, (SAMPLES, 5, 4))
    E = (np.cross(np.eye(3)[None], t[:, None]).transpose(0, 2, 1) @ R).reshape(-1, 9)
    return np.ascontiguousarray(rays.reshape(-1, 4).T), E / np.linalg.norm(E, axis=1)[:, None]


def solved(points: np.ndarray, depth: Any = None, offset: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """Models (m, 9) of every five points, and of which sample each is; depth, offset: the kernel's."""
    s = points.shape[1] // 5
    sample = np.arange(5 * s).reshape(s, 5).T.copy()
    F, draw = np.empty((10 * s, 9), np.float32), np.empty(10 * s, np.int64)
    depth, offset = np.ones((2, s)) if depth is None else depth, np.zeros(4) if offset is None else offset
    count = five_point(points, sample, depth, offset, F, draw)
    return F[:count].astype(np.float64), draw[:count]


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between vectors of unit norm, up to sign, all of a (m, 9) to all of b (n, 9)."""
    a, b = a / np.linalg.norm(a, axis=1)[:, None], b / np.linalg.norm(b, axis=1)[:, None]
    return np.sqrt(np.maximum(2 - 2 * np.abs(a @ b.T), 0))


def test_nine_tenths_of_the_real_solutions_before_the_cameras_are_found() -> None:
    points, _ = rays(1, noise=0.02)
    E, draw = solved(points)
    recovered = total = spurious = 0
    for s in range(SAMPLES):
        x0, x1 = points[:2, 5 * s : 5 * s + 5].T, points[2:, 5 * s : 5 * s + 5].T
        every, _ = cv2.findEssentialMat(np.ascontiguousarray(x0), np.ascontiguousarray(x1), np.eye(3))
        every = np.zeros((0, 3, 3)) if every is None else every.reshape(-1, 3, 3)
        expected = np.array([M.ravel() for M in every if reference.consistently_oriented(M, x0, x1)]).reshape(-1, 9)
        distance = apart(E[draw == s], expected)
        recovered += int((distance.min(0, initial=9) < 1e-4).sum())
        spurious += int((distance.min(1, initial=9) > 0.1).sum())  # nearly double roots are known to some digits
        total += len(expected)
    assert total > SAMPLES
    assert recovered > 0.85 * total  # two roots within one interval of the grid are missed
    assert spurious < 0.01 * len(E)  # double roots that the eigenvalue solver takes for a complex pair


def test_focal_lengths_and_the_centre_of_coordinates() -> None:
    points, _ = rays(3)
    rng = np.random.default_rng(0)
    depth, offset = rng.uniform(0.5, 2, (2, SAMPLES)), rng.uniform(-0.3, 0.3, 4)
    E, draw = solved(points)
    scaled = points * np.repeat(depth[[0, 0, 1, 1]], 5, axis=1)
    F, same = solved(scaled, depth, offset)
    np.testing.assert_array_equal(draw, same)
    for model, essential, s in zip(F, E, draw, strict=True):
        cameras = zip(depth[:, s], offset.reshape(2, 2), strict=True)
        K0, K1 = (np.array([[f, 0, -x], [0, f, -y], [0, 0, 1]]) for f, (x, y) in cameras)
        expected = K1.T @ model.reshape(3, 3) @ K0
        # Twice float32, through calibrations of condition 4; dividing scaled points rounds, which roots magnify.
        assert apart(expected.reshape(1, 9), essential[None])[0, 0] < 1e-4


def test_a_sample_has_the_same_bits_alone_and_degenerate_ones_have_no_solution() -> None:
    points, _ = rays(4, noise=0.05)
    E, draw = solved(points)
    for s in (0, 17, SAMPLES - 1):
        alone, zero = solved(points[:, 5 * s : 5 * s + 5].copy())
        np.testing.assert_array_equal(alone, E[draw == s])
        assert not zero.any()
    bad = points.copy()
    bad[:, 51] = bad[:, 50]  # a match twice
    bad[0, 102], bad[:, 150:155], bad[1, 203] = np.nan, 0, np.inf
    others = ~np.isin(draw, [10, 20, 30, 40])
    solutions, left = solved(bad)
    np.testing.assert_array_equal(left, draw[others])
    np.testing.assert_array_equal(solutions, E[others])


def roots_of(*coefficients):
    """The real roots, by the kernel's function interpreted."""
    roots, valid = np.zeros(3), np.zeros(3, np.bool_)
    cubic_roots(np.array(coefficients, dtype=np.float64), roots, valid)
    return sorted(roots[valid].tolist())


@pytest.mark.parametrize(
    ("coefficients", "expected"), [*DIFFERENT, *EQUAL, *QUADRATIC, *LINEAR, LARGE, SMALL, *NOT_FINITE]
)
def test_known_roots(coefficients, expected):
    # To the digits of the expectations; a triple root with representable coefficients is exact.
    np.testing.assert_allclose(roots_of(*coefficients), expected, rtol=1e-12, atol=1e-13)


@settings(max_examples=300, deadline=None)
@example([1.0, 2149678235974625.0, 1.770644304821928e26, 0.0])  # -2e15, -8e10, 0
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=4, max_size=4))
def test_never_nan_and_every_root_is_one(coefficients):
    roots = roots_of(*coefficients)
    assert np.isfinite(roots).all()
    for root in roots:
        c = np.array(coefficients) / np.abs(coefficients).max()
        powers = np.array([root**3, root**2, root, 1.0])
        # a double root is known to sqrt(eps), where the polynomial is still of the order of eps
        # (or, for roots near 0: the polynomial with coefficients changed by far less than eps of the largest)
        assert abs((c * powers).sum()) <= ((1e-9 * np.abs(c) + 1e-20) * np.abs(powers)).sum()


@kernel
def cube_roots(x: F8x1, out: F8x1) -> None:
    for i in range(len(x)):
        out[i] = cube_root(x[i])


def test_cube_roots():
    x = 10.0 ** np.linspace(-300, 300, 10007)
    out = np.empty(len(x))
    cube_roots(x, out)
    np.testing.assert_allclose(out * out * out, x, rtol=8 * np.finfo(float).eps)
    assert [cube_root(number) for number in x[::100].tolist()] == out[::100].tolist()


def test_opencv_and_kornia_oracle():
    data = oracle("epipolar_7pt.npz")
    for i in range(len(data["names"])):
        x0, x1 = (torch.from_numpy(data[f"{i:03d}.X{k}"]) for k in (1, 2))
        F, valid = seven_point(x0, x1)
        theirs = canonical(torch.from_numpy(data[f"{i:03d}.F_opencv"]))
        assert valid.sum() == len(theirs)
        assert distance_to_nearest(F[valid], theirs).max() < 3e-12  # the oracles' own agreement
        assert not F[~valid].any()
