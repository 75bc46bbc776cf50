"""Nearest neighbours and one match per location, one match at a time, from their definitions."""

import numpy as np


def two_nearest(descriptors0: np.ndarray, descriptors1: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every descriptor of image 0: index of the nearest (lowest on ties), distance to it and to the second."""
    index, first, second = [], [], []
    for descriptor in descriptors0.astype(np.float64):
        distances = [float(np.linalg.norm(descriptor - other)) for other in descriptors1.astype(np.float64)]
        order = sorted(range(len(distances)), key=lambda j: (distances[j], j))
        index.append(order[0] if order else -1)
        first.append(distances[order[0]] if order else np.inf)
        second.append(distances[order[1]] if len(order) > 1 else np.inf)
    return np.array(index, int), np.array(first), np.array(second)


def ratio_test(descriptors0: np.ndarray, descriptors1: np.ndarray, threshold: float) -> np.ndarray:
    """Which descriptors of image 0 are clearly nearer to their nearest one than to any other."""
    _, first, second = two_nearest(descriptors0, descriptors1)
    return np.array([a < threshold * b for a, b in zip(first, second, strict=True)], bool)


def mutual(descriptors0: np.ndarray, descriptors1: np.ndarray) -> np.ndarray:
    """Which descriptors of image 0 are the nearest ones of their nearest ones."""
    forward, _, _ = two_nearest(descriptors0, descriptors1)
    backward, _, _ = two_nearest(descriptors1, descriptors0)
    return np.array([backward[j] == i for i, j in enumerate(forward)], bool)


def one_to_one(x0: np.ndarray, x1: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """A match is kept unless another at its location in either image is better: lower ratio, then lower index."""
    kept = []
    for i in range(len(x0)):
        rivals = np.flatnonzero((x0 == x0[i]).all(1) | (x1 == x1[i]).all(1))
        kept.append(all((ratio[i], i) <= (ratio[j], j) for j in rivals))
    return np.array(kept, bool)
