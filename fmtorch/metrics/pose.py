"""Errors of a relative pose in degrees, and the area under their recall curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.checked import checked
from fmtorch.geometry.epipolar import inverse_root


class PoseError(NamedTuple):
    """Angular errors in degrees, each (...)."""

    rotation: Tensor
    translation: Tensor

    @property
    def worst(self) -> Tensor:
        """The larger of the two: the pose error that `pose_auc` is about."""
        return torch.maximum(self.rotation, self.translation)


@checked
def pose_error(
    R_est: Float[Tensor, "*#batch 3 3"],
    t_est: Float[Tensor, "*#batch 3"],
    R_gt: Float[Tensor, "*#batch 3 3"],
    t_gt: Float[Tensor, "*#batch 3"],
    *,
    up_to_sign: bool = True,
) -> PoseError:
    """Angle of the rotation R_est R_gt^T, and angle between the translation directions, in degrees.

    Without the sign of t, as SuperGlue (Sarlin et al., CVPR 2020) and LoFTR (Sun et al., CVPR 2021) evaluate it, the
    second is at most 90; with `up_to_sign=False` it is at most 180. Where the estimate is not finite both are the
    largest possible, as is the second where t_est is zero; where t_gt is zero there is no direction to miss and the
    second is 0, as in LoFTR. Both come from the tangent of the half angle (Kahan), accurate near 0.
    """
    usable = R_est.isfinite().all(-1).all(-1) & t_est.isfinite().all(-1)
    R_est = torch.where(usable[..., None, None], R_est, 0.0)
    t_est = torch.where(usable[..., None], t_est, 0.0)

    difference = _sum_of_squares((R_est - R_gt).flatten(-2))  # 8 sin^2(angle / 2)
    trace_plus_1 = 1 + _dot(R_est.flatten(-2), R_gt.flatten(-2))  # 4 cos^2(angle / 2)
    rotation = _angle(difference / 2, trace_plus_1.clamp(min=0.0))

    u, v = (t * inverse_root(_sum_of_squares(t))[..., None] for t in (t_est, t_gt))
    minus, plus = _sum_of_squares(u - v), _sum_of_squares(u + v)
    if up_to_sign:
        minus, plus = torch.minimum(minus, plus), torch.maximum(minus, plus)
    translation = _angle(minus, plus)

    largest = 90.0 if up_to_sign else 180.0
    translation = torch.where((t_est == 0).all(-1), largest, translation)
    translation = torch.where((t_gt == 0).all(-1) & usable, 0.0, translation)
    return PoseError(torch.where(usable, rotation, 180.0), translation)


@checked
def pose_auc(
    errors: Float[Tensor, "*batch pairs"], thresholds: Sequence[float | int] = (5, 10, 20)
) -> Float[Tensor, "*batch t"]:
    """Area under the recall curve of pose errors up to each threshold in degrees, divided by the threshold.

    As SuperGlue and LoFTR compute it: the curve rises linearly between sorted errors, from recall 0 at error 0. NaN
    and infinity count as misses. Raises ValueError unless the thresholds are positive.
    """
    if not thresholds or not all(threshold > 0 for threshold in thresholds):
        raise ValueError(f"thresholds are {tuple(thresholds)}; they must be positive, and at least one")
    pairs = errors.shape[-1]
    errors = torch.where(errors.isnan(), torch.inf, errors).sort(dim=-1).values
    step = torch.arange(1, pairs + 1, dtype=errors.dtype, device=errors.device) / pairs
    return torch.stack([_area(errors, step, float(t)) / t for t in thresholds], -1)


def _area(errors: Tensor, step: Tensor, threshold: float) -> Tensor:
    """Trapezoids below the points (error, recall) left of the threshold, level from the last one to the threshold."""
    reached = (errors < threshold).to(errors.dtype).mean(-1, keepdim=True)
    zero = torch.zeros_like(reached)
    e = torch.cat([zero, errors.clamp(max=threshold), zero + threshold], -1)
    r = torch.cat([zero, torch.minimum(step, reached), reached], -1)
    return ((r[..., 1:] + r[..., :-1]) / 2 * e.diff(dim=-1)).sum(-1)


def _angle(sine: Tensor, cosine: Tensor) -> Tensor:
    """Twice the angle, in degrees, whose squared sine and cosine are in the given proportion; gradient 0 at both ends.

    By `atan`, not `atan2`, whose last bit depends on an element's place in the tensor.
    """
    opposite = cosine == 0
    squared = sine / torch.where(opposite, 1.0, cosine)
    angle = 2 * torch.atan(squared * inverse_root(squared))
    return torch.rad2deg(torch.where(opposite, torch.pi, angle))


def _dot(u: Tensor, v: Tensor) -> Tensor:
    """Inner product over the last dimension in a fixed order."""
    total = torch.zeros_like(u[..., 0] * v[..., 0])
    for a, b in zip(u.unbind(-1), v.unbind(-1), strict=True):
        total = total + a * b
    return total


def _sum_of_squares(u: Tensor) -> Tensor:
    return _dot(u, u)
