"""The five-point algorithm for one sample, by the eigenvectors of an action matrix.

Stewenius, Engels & Nister, "Recent developments on direct relative orientation" (ISPRS 2006): eliminate the ten cubic
monomials, then multiplication by x maps the ten others to combinations of themselves.
"""

import itertools

import numpy as np

_CUBICS = [(3, 0, 0), (2, 1, 0), (2, 0, 1), (1, 2, 0), (1, 1, 1), (1, 0, 2), (0, 3, 0), (0, 2, 1), (0, 1, 2), (0, 0, 3)]
_OTHERS = [(2, 0, 0), (1, 1, 0), (1, 0, 1), (0, 2, 0), (0, 1, 1), (0, 0, 2), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)]


def five_point(x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    """All real essential matrices (m, 3, 3) of unit norm of five matches of rays (x, y, 1), each (5, 2)."""
    h0, h1 = (np.concatenate([x, np.ones((5, 1))], 1) for x in (x0, x1))
    A = (h1[:, :, None] * h0[:, None]).reshape(5, 9)
    basis: np.ndarray = np.linalg.svd(A)[2][5:].reshape(4, 3, 3)
    place = {m: i for i, m in enumerate(_CUBICS + _OTHERS)}
    equations: np.ndarray = np.zeros((10, 20))
    for a, b, c in itertools.product(range(4), repeat=3):
        X, Y, Z = basis[a], basis[b], basis[c]
        exponents = ((a, b, c).count(0), (a, b, c).count(1), (a, b, c).count(2))
        trace = X @ Y.T @ Z - np.trace(X @ Y.T) * Z / 2
        determinant = X[0] @ np.cross(Y[1], Z[2])
        equations[:, place[exponents]] += np.append(trace.ravel(), determinant)
    reduced = -np.linalg.solve(equations[:, :10], equations[:, 10:])
    action = np.zeros((10, 10))
    for i, (p, q, r) in enumerate(_OTHERS):
        target = (p + 1, q, r)
        if target in _CUBICS:
            action[i] = reduced[_CUBICS.index(target)]
        else:
            action[i, _OTHERS.index(target)] = 1
    values, vectors = np.linalg.eig(action)
    real = np.abs(values.imag) < 1e-8 * (1 + np.abs(values))
    v = vectors[:, real].real
    E = np.einsum("ks,kij->sij", np.concatenate([v[6:9], v[9:]]) / v[9:], basis)
    return E / np.linalg.norm(E, axis=(1, 2))[:, None, None]
