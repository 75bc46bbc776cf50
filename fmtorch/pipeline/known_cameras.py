"""Estimates of pairs whose cameras are known, exactly or roughly, by any estimator of fundamental matrices."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.stages import Estimator
from fmtorch.core.threads import one_thread
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.geometry.arithmetic import matmul3, sqrt
from fmtorch.geometry.cameras import cross_matrix
from fmtorch.geometry.normalize import canonical
from fmtorch.geometry.pose import pose_from_fundamental
from fmtorch.geometry.square_pixels import SquarePixels, calibration_problems, mapped, square_pixels
from fmtorch.geometry.verdict import judged


class Camera(NamedTuple):
    """What is known of one image of each pair, after its points are mapped to square pixels.

    map: None where they are as they were. focal, deviation: the measured focal length, px, and its relative deviation,
    infinite where unknown. size: (h, w); None where unknown. K: as given, the identity where that is wrong. problems:
    what is wrong, empty where nothing is.
    """

    map: Float[Tensor, "b 3 3"] | None
    focal: Float[Tensor, " b"]
    deviation: Float[Tensor, " b"]
    size: Tensor | None
    K: Float[Tensor, "b 3 3"] | None
    problems: tuple[str, ...]


class KnownCameras:
    """An estimator that takes `K0`, `K1`, `focal` and `shared_focal` of its correspondences into account.

    Points are mapped by K to square pixels about the image centre before the estimator, and F back; E, R, t and the
    focal lengths follow from the focal lengths that the estimator finds, or from the measured ones where it finds none.
    The focal length of K stands for that in `focal`, with the deviation there, or 0 where `focal` is not given.
    """

    model = "fundamental"

    def __init__(self, estimator: Estimator) -> None:
        """estimator: of fundamental matrices."""
        self.estimator = estimator

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate the cameras of a batch of pairs; one whose K is wrong is `ok=False` with a reason."""
        camera0, camera1 = cameras = _camera(c, 0), _camera(c, 1)
        square = _square(c, *cameras)
        estimate = judged(self.estimator(square, seed), square)
        with one_thread(c.mask.device):
            return _with_reasons(_unmapped(estimate, square, *cameras), camera0.problems, camera1.problems)


def _camera(c: Correspondences, i: int) -> Camera:
    """What is known of an image, with `K`, `focal` and `size` of its number."""
    K, size = (c.K0, c.K1)[i], (c.size0, c.size1)[i]
    unknown = torch.full((len(c),), torch.inf, dtype=torch.float64, device=c.mask.device)
    focal, deviation = (unknown, unknown) if c.focal is None else c.focal[:, i].detach().double().unbind(-1)
    if K is None:
        return Camera(None, focal, deviation, size, None, ("",) * len(c))
    problems = calibration_problems(K, size, f"K{i}")
    valid = torch.tensor([not problem for problem in problems], dtype=torch.bool, device=K.device)
    K = torch.where(valid[:, None, None], K, torch.eye(3, dtype=K.dtype, device=K.device))
    square: SquarePixels = square_pixels(K, size, valid)
    deviation = torch.zeros_like(unknown) if c.focal is None else deviation
    return Camera(square.map, square.focal, deviation, square.size, K, problems)


def _square(c: Correspondences, camera0: Camera, camera1: Camera) -> Correspondences:
    """The same pairs in images of square pixels; those of a wrong K without matches."""
    problems = zip(camera0.problems, camera1.problems, strict=True)
    valid = torch.tensor([not any(pair) for pair in problems], dtype=torch.bool, device=c.mask.device)
    mask = c.mask & c.x0.isfinite().all(-1) & c.x1.isfinite().all(-1) & valid[:, None]
    fields = {"x0": c.x0, "x1": c.x1, "lafs0": c.lafs0, "lafs1": c.lafs1}
    for i, A in enumerate((camera0.map, camera1.map)):
        if A is not None:
            fields[f"x{i}"] = mapped(torch.where(mask[..., None], (c.x0, c.x1)[i], 0), A)
            fields[f"lafs{i}"] = _mapped_frames((c.lafs0, c.lafs1)[i], A)
    focal = torch.stack([torch.stack([each.focal, each.deviation], -1) for each in (camera0, camera1)], 1)
    return c.derived(mask=mask, size0=camera0.size, size1=camera1.size, K0=None, K1=None, focal=focal, **fields)


def _mapped_frames(lafs: Tensor | None, A: Tensor) -> Tensor | None:
    """Local affine frames (B, N, 2, 3) by affine maps (B, 3, 3)."""
    if lafs is None:
        return None
    columns = (A[:, None, :2, 0, None] * lafs[..., :1, :] + A[:, None, :2, 1, None] * lafs[..., 1:, :]).unbind(-1)
    return torch.stack([*columns[:2], columns[2] + A[:, None, :2, 2]], -1).to(lafs.dtype)


def _unmapped(estimate: Estimate, square: Correspondences, camera0: Camera, camera1: Camera) -> Estimate:
    """The estimate for the points as they were, with the pose of its cameras."""
    cameras, ok = (camera0, camera1), estimate.ok
    measured = torch.stack([torch.where(each.deviation < torch.inf, each.focal, torch.nan) for each in cameras], 1)
    focals = measured if estimate.focals is None else torch.where(estimate.focals.isnan(), measured, estimate.focals)
    focals = torch.where(ok[:, None], focals, torch.nan)
    R, t = _pose(estimate, square, focals)
    F = estimate.F
    if camera0.map is not None or camera1.map is not None:
        identity = torch.eye(3, dtype=F.dtype, device=F.device).expand_as(F)
        A0, A1 = (identity if each.map is None else each.map.to(F) for each in cameras)
        F = torch.where(ok[:, None, None], canonical(matmul3(matmul3(A1.mT, F), A0)), 0)
    scale = torch.stack([_scale(each) for each in cameras], 1)
    return estimate.derived(F=F, E=matmul3(cross_matrix(t), R), R=R, t=t, focals=focals * scale)


def _pose(estimate: Estimate, square: Correspondences, focals: Tensor) -> tuple[Tensor, Tensor]:
    """R (B, 3, 3) and t (B, 3) by the estimated focal lengths (B, 2), NaN where these or the pose are not known."""
    known = estimate.ok & focals.isfinite().all(1)
    K0, K1 = (
        _calibration(torch.where(known, focals[:, i], 1), size) for i, size in enumerate((square.size0, square.size1))
    )
    weight = None if square.prior is None else square.prior.detach().nan_to_num(0)
    x0, x1 = square.x0.detach(), square.x1.detach()
    pose = pose_from_fundamental(estimate.F.double(), K0, K1, x0, x1, estimate.inliers, weight)
    valid = known & pose.valid
    return torch.where(valid[:, None, None], pose.R, torch.nan), torch.where(valid[:, None], pose.t, torch.nan)


def _calibration(focal: Tensor, size: Tensor | None) -> Tensor:
    """K (B, 3, 3) of square pixels and central principal points; about the origin where the size is not known."""
    zero, one = torch.zeros_like(focal), torch.ones_like(focal)
    x, y = (zero, zero) if size is None else ((size[:, 1].to(focal) - 1) / 2, (size[:, 0].to(focal) - 1) / 2)
    return torch.stack([focal, zero, x, zero, focal, y, zero, zero, one], -1).reshape(-1, 3, 3)


def _scale(camera: Camera) -> Tensor:
    """Pixels as they were in one of the square ones, attached to K."""
    if camera.K is None:
        return torch.ones_like(camera.focal)
    K = camera.K.double() / camera.K[:, 2:, 2:]
    return sqrt(K[:, 0, 0] * K[:, 1, 1]) / camera.focal


def _with_reasons(estimate: Estimate, *problems: tuple[str, ...]) -> Estimate:
    """The estimate with what is wrong with K as its reasons."""
    first = [next(filter(None, each), "") for each in zip(*problems, strict=True)]
    reasons = tuple(problem or reason for problem, reason in zip(first, estimate.reason, strict=True))
    return estimate.derived(reason=reasons)
