"""Whether inliers determine a model, by the singular values of their positions."""

import numpy as np


def degenerate_support(points: np.ndarray, minimal: int, rounding: float) -> str:
    """Why matches (n, 4) determine no model; empty where they may. rounding: of a coordinate, absolute."""
    different = np.unique(points, axis=0)
    if len(different) < minimal:
        return f"the best model has {len(different)} different inliers; at least {minimal} are needed"
    flat = [i for i in (0, 1) if on_line(different[:, 2 * i : 2 * i + 2], rounding)]
    if flat:
        return f"the inliers of the best model lie on one line in {' and '.join(f'image {i}' for i in flat)}"
    return ""


def on_line(x: np.ndarray, rounding: float) -> bool:
    """Whether points (n, 2) are no farther from their best line than rounding explains."""
    across, along = np.linalg.svd(x - x.mean(0), compute_uv=False)[::-1]
    return bool(across <= np.sqrt(len(x)) * max(4 * rounding, 2.0**-22 * along))
