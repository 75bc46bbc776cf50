"""Two-view projective geometry as pure, batched, differentiable functions."""

from fmtorch.core.checks import public
from fmtorch.geometry.cameras import cross_matrix as _cross_matrix
from fmtorch.geometry.cameras import fundamental_from_calibration as _fundamental_from_calibration
from fmtorch.geometry.cameras import fundamental_from_projections as _fundamental_from_projections
from fmtorch.geometry.eight_point import eight_point as _eight_point
from fmtorch.geometry.epipolar import algebraic as _algebraic
from fmtorch.geometry.epipolar import epipolar_distances as _epipolar_distances
from fmtorch.geometry.epipolar import epipolar_lines as _epipolar_lines
from fmtorch.geometry.epipolar import point_to_line as _point_to_line
from fmtorch.geometry.epipolar import sampson as _sampson
from fmtorch.geometry.epipolar import sampson_squared as _sampson_squared
from fmtorch.geometry.epipolar import symmetric_max as _symmetric_max
from fmtorch.geometry.epipolar import symmetric_mean as _symmetric_mean
from fmtorch.geometry.epipolar import symmetric_squared as _symmetric_squared
from fmtorch.geometry.epipolar import unit_frobenius as _unit_frobenius
from fmtorch.geometry.irls import Fits
from fmtorch.geometry.irls import irls as _irls
from fmtorch.geometry.irls import reweighted_fits as _reweighted_fits
from fmtorch.geometry.normalize import canonical as _canonical
from fmtorch.geometry.normalize import denormalize_fundamental as _denormalize_fundamental
from fmtorch.geometry.normalize import normalize_pair as _normalize_pair
from fmtorch.geometry.normalize import normalize_points as _normalize_points
from fmtorch.geometry.pose import Pose
from fmtorch.geometry.pose import pose_from_fundamental as _pose_from_fundamental
from fmtorch.geometry.rank2 import nearest_rank2 as _nearest_rank2
from fmtorch.geometry.refine import attached_step as _attached_step
from fmtorch.geometry.refine import refine as _refine
from fmtorch.geometry.robust_kernels import KERNELS
from fmtorch.geometry.seven_point import seven_point as _seven_point
from fmtorch.geometry.significance import significance as _significance

_public = public(__name__)
eight_point = _public(_eight_point)
algebraic = _public(_algebraic)
cross_matrix = _public(_cross_matrix)
epipolar_distances = _public(_epipolar_distances)
epipolar_lines = _public(_epipolar_lines)
fundamental_from_calibration = _public(_fundamental_from_calibration)
fundamental_from_projections = _public(_fundamental_from_projections)
point_to_line = _public(_point_to_line)
sampson = _public(_sampson)
sampson_squared = _public(_sampson_squared)
symmetric_max = _public(_symmetric_max)
symmetric_mean = _public(_symmetric_mean)
symmetric_squared = _public(_symmetric_squared)
unit_frobenius = _public(_unit_frobenius)
irls = _public(_irls)
reweighted_fits = _public(_reweighted_fits)
canonical = _public(_canonical)
denormalize_fundamental = _public(_denormalize_fundamental)
normalize_pair = _public(_normalize_pair)
normalize_points = _public(_normalize_points)
pose_from_fundamental = _public(_pose_from_fundamental)
nearest_rank2 = _public(_nearest_rank2)
attached_step = _public(_attached_step)
refine = _public(_refine)
seven_point = _public(_seven_point)
significance = _public(_significance)

__all__ = [
    "KERNELS",
    "Fits",
    "Pose",
    "algebraic",
    "attached_step",
    "canonical",
    "cross_matrix",
    "denormalize_fundamental",
    "eight_point",
    "epipolar_distances",
    "epipolar_lines",
    "fundamental_from_calibration",
    "fundamental_from_projections",
    "irls",
    "nearest_rank2",
    "normalize_pair",
    "normalize_points",
    "point_to_line",
    "pose_from_fundamental",
    "refine",
    "reweighted_fits",
    "sampson",
    "sampson_squared",
    "seven_point",
    "significance",
    "symmetric_max",
    "symmetric_mean",
    "symmetric_squared",
    "unit_frobenius",
]
