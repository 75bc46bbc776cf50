"""Two-view projective geometry as pure, batched, differentiable functions."""

from fmtorch.geometry.epipolar import (
    algebraic,
    cross_matrix,
    epipolar_distances,
    epipolar_lines,
    fundamental_from_calibration,
    fundamental_from_projections,
    point_to_line,
    sampson,
    sampson_squared,
    symmetric_max,
    symmetric_mean,
    symmetric_squared,
    unit_frobenius,
)

__all__ = [
    "algebraic",
    "cross_matrix",
    "epipolar_distances",
    "epipolar_lines",
    "fundamental_from_calibration",
    "fundamental_from_projections",
    "point_to_line",
    "sampson",
    "sampson_squared",
    "symmetric_max",
    "symmetric_mean",
    "symmetric_squared",
    "unit_frobenius",
]
