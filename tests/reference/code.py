"""The two regressions of CODE from their definitions, in NumPy and float64, one match and one centre at a time."""

import math
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import huber


def normalised(x: np.ndarray) -> tuple[np.ndarray, float]:
    centred = x - x.mean(0)
    spread = math.sqrt((centred**2).mean())
    return centred / spread, spread


def shape(S: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(S) / math.sqrt(2)
    return np.append(S.ravel() / size, math.log(size))


def predictive_gaussian(match: tuple[Any, ...], centre: tuple[Any, ...], widths: dict[str, float]) -> float:
    """match, centre: (p0, p1, S)."""
    (a0, a1, A), (b0, b1, B) = match, centre
    difference = shape(A) - shape(B)
    return math.exp(
        -(
            ((a0 - b0) ** 2).sum() / widths["position"] ** 2
            + ((a1 - b1 - B @ (a0 - b0)) ** 2).sum() / widths["displacement"] ** 2
            + (difference[:4] ** 2).sum() / widths["rotation"] ** 2
            + difference[4] ** 2 / widths["scale"] ** 2
        )
        / 2
    )


def spread_centres(kernel: np.ndarray, count: int) -> list[int]:
    chosen: list[int] = []
    for _ in range(min(count, len(kernel))):
        merits = []
        for j in range(len(kernel)):
            covered = max((kernel[j, c] for c in chosen), default=0.0)
            merits.append(sum(kernel[i, j] for i in range(len(kernel))) * (1 - covered))
        chosen.append(int(np.argmax(merits)))
    return chosen


def huber_regression(basis: np.ndarray, target: np.ndarray, ridge: np.ndarray, scale: float) -> np.ndarray:
    """The minimiser by a general optimiser; the objective is convex, so there is one."""
    m, k = basis.shape[1], target.shape[1]

    def objective(flat: np.ndarray) -> tuple[float, np.ndarray]:
        C = flat.reshape(m, k)
        value, gradient = float(np.trace(C.T @ ridge @ C)), 2 * ridge @ C
        for row, wanted in zip(basis, target, strict=True):
            residual = wanted - row @ C
            r = float(np.linalg.norm(residual))
            value += 2 * huber(scale, r)  # r^2 up to the scale
            gradient -= 2 * np.outer(row, residual) * min(1.0, scale / r if r > 0 else 1.0)
        return value, gradient.ravel()

    result = minimize(objective, np.zeros(m * k), jac=True, method="L-BFGS-B", options={"maxiter": 5000, "ftol": 1e-15})
    return result.x.reshape(m, k)


def likelihood(matches: list[Any], widths: dict[str, float], centres: int, ridge: float, scale: float) -> np.ndarray:
    """Likelihood of every match, all of them distinctive."""
    kernel = np.array([[predictive_gaussian(a, b, widths) for b in matches] for a in matches])
    basis = kernel[:, spread_centres(kernel, centres)]
    penalty = ridge * len(matches) * np.eye(basis.shape[1])
    return (basis @ huber_regression(basis, np.ones((len(matches), 1)), penalty, scale))[:, 0]
