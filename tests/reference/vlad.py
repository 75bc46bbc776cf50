"""VLAD from its definition, one descriptor and one centre at a time."""

import numpy as np


def vlad(descriptors: np.ndarray, mean: np.ndarray, basis: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Residual sums of the nearest centres, each of unit length; signed square roots; unit length."""
    sums = np.zeros_like(centers)
    for descriptor in descriptors:
        x = (descriptor - mean) @ basis
        k = min(range(len(centers)), key=lambda k: float(np.sum((x - centers[k]) ** 2)))
        sums[k] += x - centers[k]
    for k in range(len(sums)):
        if np.any(sums[k]):
            sums[k] /= np.linalg.norm(sums[k])
    entries = np.array([np.sign(v) * np.sqrt(abs(v)) for v in sums.ravel()])
    norm = np.linalg.norm(entries)
    return entries / norm if norm else entries
