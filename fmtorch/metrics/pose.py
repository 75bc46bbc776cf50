"""Errors of a relative pose in degrees, and of a homography ``x1 ~ H x0`` in pixels."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from fmtorch.core.checks import checked, expect_sizes
from fmtorch.geometry import homography_points, pose_from_fundamental, poses_from_fundamental
from fmtorch.geometry.arithmetic import component_sum
from fmtorch.geometry.epipolar import inverse_root
from fmtorch.geometry.normalize import Matrices

Rotations = Float[Tensor, "*#batch 3 3"]
Translations = Float[Tensor, "*#batch 3"]


class PoseError(NamedTuple):
    """Angular errors in degrees, each (...)."""

    rotation: Tensor
    translation: Tensor

    @property
    def worst(self) -> Tensor:
        """The larger of the two: the pose error of which recall is taken."""
        return torch.maximum(self.rotation, self.translation)


@checked
def pose_error(
    R_est: Rotations, t_est: Translations, R_gt: Rotations, t_gt: Translations, *, up_to_sign: bool = True
) -> PoseError:
    """Angle of the rotation R_est R_gt^T, and angle between the translation directions, in degrees.

    Both come from the tangent of the half angle (Kahan), accurate near 0.

    Args:
        R_est, t_est: estimated motion, X1 = R X0 + t; the length of t does not count.
        R_gt, t_gt: the true motion.
        up_to_sign: ignore the sign of t, as SuperGlue (Sarlin et al., CVPR 2020) and LoFTR (Sun et al., CVPR 2021).

    Returns:
        `rotation`, at most 180, and `translation`, at most 90, or 180 with its sign. Both are the largest possible
        where the estimate is not finite, the second where t_est is zero. Where t_gt is zero it is 0, as in LoFTR.

    Example:
        >>> import torch
        >>> from fmtorch.metrics import pose_error
        >>> quarter = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # a turn about the vertical
        >>> error = pose_error(quarter, torch.tensor([-1.0, 0, 0]), torch.eye(3), torch.tensor([1.0, 0, 0]))
        >>> round(error.rotation.item(), 3), error.translation.item()
        (90.0, 0.0)
    """
    finite = R_est.isfinite().all(-1).all(-1) & t_est.isfinite().all(-1)
    R_est = torch.where(finite[..., None, None], R_est, 0.0)
    t_est = torch.where(finite[..., None], t_est, 0.0)

    difference = _sum_of_squares((R_est - R_gt).flatten(-2))  # 8 sin^2(angle / 2)
    trace_plus_1 = 1 + _dot(R_est.flatten(-2), R_gt.flatten(-2))  # 4 cos^2(angle / 2)
    rotation = _angle(difference / 2, trace_plus_1.clamp(min=0.0))

    u, v = (t * inverse_root(_sum_of_squares(t))[..., None] for t in (t_est, t_gt))
    minus, plus = _sum_of_squares(u - v), _sum_of_squares(u + v)
    if up_to_sign:
        minus, plus = torch.minimum(minus, plus), torch.maximum(minus, plus)
    translation = _angle(minus, plus)

    translation = torch.where((t_est == 0).all(-1), 90.0 if up_to_sign else 180.0, translation)
    translation = torch.where((t_gt == 0).all(-1) & finite, 0.0, translation)
    return PoseError(torch.where(finite, rotation, 180.0), translation)


@checked
def fundamental_pose_error(
    F: Matrices, K0: Matrices, K1: Matrices, x0: Float[Tensor, "*batch n 2"], x1: Float[Tensor, "*batch n 2"],
    R_gt: Matrices, t_gt: Float[Tensor, "*batch 3"], mask: Bool[Tensor, "*batch n"] | None = None,
    *, up_to_sign: bool = True,
) -> PoseError:  # fmt: skip
    """`pose_error` of the pose that F has with known calibrations: E = K1^T F K0, decomposed, cheirality checked.

    Args:
        F: estimated fundamental matrices, x1^T F x0 = 0 in pixels.
        K0, K1: calibration matrices.
        x0, x1: the matches whose depths must be positive, usually the estimator's inliers, in pixels.
        R_gt, t_gt, up_to_sign: as of `pose_error`.
        mask: which of the matches count; all when not given.

    Returns:
        Angles in degrees. Where there is no pose (F without rank 2, a singular calibration, no point in front of both
        cameras) rotation is 180 and translation 90, or 180 with its sign. Differentiable in F, K0 and K1.
    """
    pose = pose_from_fundamental(F, K0, K1, x0, x1, mask)
    R = torch.where(pose.valid[..., None, None], pose.R, torch.nan)
    return pose_error(R, pose.t, R_gt.to(R.dtype), t_gt.to(R.dtype), up_to_sign=up_to_sign)


@checked
def closest_pose_error(
    F: Matrices, K0: Matrices, K1: Matrices, R_gt: Matrices, t_gt: Float[Tensor, "*batch 3"]
) -> PoseError:
    """Error of the best of the four poses that F has with known calibrations: that of the smallest sum of both angles.

    As PoseBench (github.com/PoseLib/posebench) judges fundamental matrices. The sign of t counts, no match decides.

    Args:
        F, K0, K1, R_gt, t_gt: as of `fundamental_pose_error`.

    Returns:
        Angles in degrees, at most 180 each, and both 180 where there is no pose. Differentiable in F, K0 and K1.
    """
    four = poses_from_fundamental(F, K0, K1)
    R, t = R_gt.to(F.dtype)[..., None, :, :], t_gt.to(F.dtype)[..., None, :]
    errors = pose_error(four.R, four.t, R, t, up_to_sign=False)
    best = (errors.rotation + errors.translation).detach().argmin(-1, keepdim=True)
    rotation, translation = (angle.gather(-1, best)[..., 0] for angle in errors)
    return PoseError(torch.where(four.valid, rotation, 180.0), torch.where(four.valid, translation, 180.0))


@checked
def corner_error(
    H_est: Float[Tensor, "*#batch 3 3"], H_gt: Float[Tensor, "*#batch 3 3"], size0: Real[Tensor, "*#batch 2"]
) -> Float[Tensor, "*#batch"]:
    """Mean distance in image 1 between the corners of image 0 as two homographies map them (DeTone et al., 2018).

    In pixels, float64; infinite where a corner has no finite image.

    Args:
        H_est, H_gt: the estimated and the true homography, x1 ~ H x0 in pixels, of any scale and sign.
        size0: of image 0, (h, w); its corners are the centres of its four corner pixels.

    Raises:
        ValueError: a size is not positive.

    Example:
        >>> import torch
        >>> from fmtorch.metrics import corner_error
        >>> moved = torch.tensor([[1.0, 0, 3], [0, 1, 4], [0, 0, 1]])
        >>> corner_error(moved, torch.eye(3), torch.tensor([480, 640])).item()
        5.0
    """
    expect_sizes(size0=size0)
    h, w = (size0.to(torch.float64) - 1).unbind(-1)
    zero = torch.zeros_like(h)
    corners = torch.stack([torch.stack(c, -1) for c in ((zero, zero), (w, zero), (w, h), (zero, h))], -2)
    a, b = (homography_points(H.to(torch.float64), corners) for H in (H_est, H_gt))
    finite = (torch.isfinite(a) & torch.isfinite(b)).all(-1)
    difference = torch.where(finite[..., None], a - b, 0.0)
    squared = component_sum(difference * difference, -1)
    return torch.where(finite.all(-1), component_sum(squared * inverse_root(squared), -1) / 4, torch.inf)


def _angle(sine: Tensor, cosine: Tensor) -> Tensor:
    """Twice the angle, in degrees, whose squared sine and cosine are in the given proportion; gradient 0 at both ends.
    By `atan`, not `atan2`, whose last bit depends on an element's place in the tensor."""
    opposite = cosine == 0
    squared = sine / torch.where(opposite, 1.0, cosine)
    angle = 2 * torch.atan(squared * inverse_root(squared))
    return torch.rad2deg(torch.where(opposite, torch.pi, angle))


def _dot(u: Tensor, v: Tensor) -> Tensor:
    """Inner product over the last dimension in a fixed order."""
    return sum(a * b for a, b in zip(u.unbind(-1), v.unbind(-1), strict=True))  # type: ignore[return-value]


def _sum_of_squares(u: Tensor) -> Tensor:
    return _dot(u, u)
