"""The five-point algorithm finds what an eigenvalue solver finds before both cameras, and nothing else."""

import numpy as np
from scipy.spatial.transform import Rotation

from fmtorch.geometry.five_point import five_point
from tests.reference import solvers as reference
from tests.reference.solvers import consistently_oriented

SAMPLES = 203  # not whole lanes


def scene(seed: int, noise: float = 0.0, plane: bool = False) -> tuple[np.ndarray, np.ndarray]:
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


def solved(
    points: np.ndarray, depth: np.ndarray | None = None, offset: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
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


def test_solutions_are_essential_matrices_of_the_sample() -> None:
    points, _ = scene(0, noise=0.05)
    E, draw = solved(points)
    assert len(E) > SAMPLES
    assert (np.diff(draw) >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(E, axis=1), 1, atol=1e-6)
    M = E.reshape(-1, 3, 3)
    own = np.concatenate([points.reshape(4, SAMPLES, 5)[:, draw], np.ones((1, len(E), 5))])
    residual = np.einsum("isn,sij,jsn->sn", own[[2, 3, 4]], M, own[[0, 1, 4]])
    # Rounded to float32, entries of 1 with coordinates of about 1; the polynomial's roots are in float64.
    assert np.abs(residual).max() < 1e-5
    trace = M @ M.transpose(0, 2, 1) @ M - np.einsum("sij,sij->s", M, M)[:, None, None] * M / 2
    # Four steps of Newton's method leave nearly double roots, a few in a hundred, to some digits.
    for error in (np.abs(trace).max((1, 2)), np.abs(np.linalg.det(M))):
        assert np.quantile(error, 0.95) < 1e-6
        assert np.quantile(error, 0.99) < 1e-3


def test_nine_tenths_of_the_real_solutions_before_the_cameras_are_found() -> None:
    points, _ = scene(1, noise=0.02)
    E, draw = solved(points)
    recovered = total = spurious = 0
    for s in range(SAMPLES):
        x0, x1 = points[:2, 5 * s : 5 * s + 5].T, points[2:, 5 * s : 5 * s + 5].T
        every = reference.five_point(x0, x1)
        expected = np.array([M.ravel() for M in every if consistently_oriented(M, x0, x1)]).reshape(-1, 9)
        distance = apart(E[draw == s], expected)
        recovered += int((distance.min(0, initial=9) < 1e-4).sum())
        spurious += int((distance.min(1, initial=9) > 0.1).sum())  # nearly double roots are known to some digits
        total += len(expected)
    assert total > SAMPLES
    assert recovered > 0.85 * total  # two roots within one interval of the grid are missed
    assert spurious < 0.01 * len(E)  # double roots that the eigenvalue solver takes for a complex pair


def test_focal_lengths_and_the_centre_of_coordinates() -> None:
    """F acts on pixels as E acts on rays."""
    points, _ = scene(3)
    rng = np.random.default_rng(0)
    depth, offset = rng.uniform(0.5, 2, (2, SAMPLES)), rng.uniform(-0.3, 0.3, 4)
    E, draw = solved(points)
    scaled = points * np.repeat(depth[[0, 0, 1, 1]], 5, axis=1)
    F, same = solved(scaled, depth, offset)
    np.testing.assert_array_equal(draw, same)
    for model, essential, s in zip(F, E, draw, strict=True):
        K0, K1 = (
            np.array([[f, 0, -x], [0, f, -y], [0, 0, 1]])
            for f, (x, y) in zip(depth[:, s], offset.reshape(2, 2), strict=True)
        )
        expected = K1.T @ model.reshape(3, 3) @ K0
        # Twice float32, through calibrations of condition 4; dividing scaled points rounds, which roots magnify.
        assert apart(expected.reshape(1, 9), essential[None])[0, 0] < 1e-4


def test_a_sample_has_the_same_bits_alone_and_degenerate_ones_have_no_solution() -> None:
    points, _ = scene(4, noise=0.05)
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
