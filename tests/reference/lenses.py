"""Lenses of the division model: bent points, F between such photographs, one match and one number at a time."""

import numpy as np
import scipy.linalg

from tests.reference.solvers import skew

Size = tuple[int, int]


def frame(size: Size) -> tuple[np.ndarray, float]:
    """The principal point and the half diagonal of an image."""
    h, w = size
    return np.array([(w - 1) / 2, (h - 1) / 2]), np.hypot(h, w) / 2


def bent(x: np.ndarray, size: Size, lens: float) -> np.ndarray:
    """Where a lens puts a point (2,) of a pinhole's image: the root of ``lambda r_u r_d^2 - r_d + r_u = 0``."""
    centre, half = frame(size)
    ru = np.linalg.norm(x - centre) / half
    rd = ru if lens == 0 or ru == 0 else (1 - np.sqrt(1 - 4 * lens * ru * ru)) / (2 * lens * ru)
    return centre + (x - centre) * (rd / ru if ru else 1)


def straight(x: np.ndarray, size: Size, lens: float) -> np.ndarray:
    """Where a pinhole would have put a point (2,) of a photograph."""
    centre, half = frame(size)
    r2 = ((x - centre) ** 2).sum() / half**2
    return centre + (x - centre) / (1 + lens * r2)


def constraint(F: np.ndarray, x: np.ndarray, sizes: tuple[Size, Size], lenses: tuple[float, float]) -> float:
    """``x1^T F x0`` of points (x0, y0, x1, y1) of photographs, times both denominators of the model."""
    h = []
    for i in range(2):
        centre, half = frame(sizes[i])
        own = x[2 * i : 2 * i + 2] - centre
        w = 1 + lenses[i] * (own**2).sum() / half**2
        h.append(np.append(own + centre * w, w))
    return float(h[1] @ F @ h[0])


def sampson(F: np.ndarray, x: np.ndarray, sizes: tuple[Size, Size], lenses: tuple[float, float]) -> float:
    """The Sampson distance of a match by the photograph's coordinates, px: the gradient by differences."""
    e = constraint(F, x, sizes, lenses)
    ends = ((constraint(F, x + d, sizes, lenses), constraint(F, x - d, sizes, lenses)) for d in 1e-3 * np.eye(4))
    return float(e / np.linalg.norm([(there - back) / 2e-3 for there, back in ends]))


def nine_points(x0: np.ndarray, x1: np.ndarray, size: Size) -> list[tuple[float, np.ndarray]]:
    """Each lambda of one lens with the F of pinholes for nine matches (9, 2) of photographs of one size.

    Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens distortion" (CVPR 2001): the
    constraint is (D1 + lambda D2 + lambda^2 D3) f = 0, a quadratic eigenvalue problem."""
    centre, half = frame(size)
    h0, h1 = (np.c_[(x - centre) / half, np.ones(9)] for x in (x0, x1))
    e0, e1 = (np.c_[np.zeros((9, 2)), (h[:, :2] ** 2).sum(1)] for h in (h0, h1))
    sums = ([(h1, h0)], [(h1, e0), (e1, h0)], [(e1, e0)])
    D1, D2, D3 = (sum(np.einsum("ni,nj->nij", b, a).reshape(9, 9) for b, a in terms) for terms in sums)
    zero, eye = np.zeros((9, 9)), np.eye(9)
    values, vectors = scipy.linalg.eig(np.block([[zero, eye], [-D1, -D2]]), np.block([[eye, zero], [zero, D3]]))
    real = [i for i in range(18) if abs(values[i].imag) < 1e-6 and abs(values[i]) < 1]
    A = np.array([[1 / half, 0, -centre[0] / half], [0, 1 / half, -centre[1] / half], [0, 0, 1]])
    models = [A.T @ vectors[:9, i].real.reshape(3, 3) @ A for i in real]
    return [(values[i].real, F / np.linalg.norm(F)) for i, F in zip(real, models, strict=True)]


def photographs(
    seed: int, lenses: tuple[float, float], size: Size = (480, 640), noise: float = 0.3, wrong: float = 0.25
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Matches (n, 2) all over two bent photographs, F of pinholes, and K."""
    rng, (h, w) = np.random.default_rng(seed), size
    K = np.array([[0.8 * w, 0, (w - 1) / 2], [0, 0.8 * w, (h - 1) / 2], [0, 0, 1]])
    X = np.c_[rng.uniform(-5, 5, (1500, 2)), rng.uniform(3, 6, 1500)]
    turn, t = np.array([[0.995, 0, 0.0998], [0, 1, 0], [-0.0998, 0, 0.995]]), np.array([-0.8, 0.1, 0.3])
    U, _, V = np.linalg.svd(turn)
    R = U @ V
    points = []
    for Y, lens in ((X, lenses[0]), (X @ R.T + t, lenses[1])):
        x = Y @ K.T
        x = x[:, :2] / x[:, 2:]
        points.append(np.array([bent(each, size, lens) for each in x]) + rng.normal(0, noise, x.shape))
    inside = np.all([(x >= 0).all(1) & (x < (w, h)).all(1) for x in points], 0)
    x0, x1 = (x[inside] for x in points)
    some = slice(int(wrong * len(x1)))
    x1[some] = rng.permutation(x1[some])
    F = np.linalg.inv(K).T @ skew(t) @ R @ np.linalg.inv(K)
    return x0, x1, F / np.linalg.norm(F), K
