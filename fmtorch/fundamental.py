"""The two-line replacement for `cv2.findFundamentalMat`."""

from __future__ import annotations

import functools
import json
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch import presets
from fmtorch.stages import Estimator, Pruner
from fmtorch.types import Correspondences, Estimate
from fmtorch.validation import expect_values

Array = Tensor | NDArray[Any]


def find_fundamental(
    x0: Array,
    x1: Array,
    *,
    estimator: str = "fmtorch",
    mask: Array | None = None,
    quality: Array | None = None,
    prior: Array | None = None,
    lafs0: Array | None = None,
    lafs1: Array | None = None,
    noise: Array | None = None,
    size0: Array | None = None,
    size1: Array | None = None,
    key: Array | None = None,
    seed: int = 0,
    **options: Any,
) -> Estimate:
    """Robustly estimate fundamental matrices from matched points, ``x1^T F x0 = 0``.

    x0, x1: matched points in pixels, (N, 2) for one pair or (B, N, 2) for a padded batch, NumPy or torch, on any
    device; gradients reach them through the final fit. mask: (B, N), True for real matches; all when not given.
    quality: (B, N), the matcher's figure, smaller is better (a distance ratio). prior: (B, N), P(inlier) in [0, 1].
    noise: (B, N), each match's standard deviation relative to a usual one's (`fmtorch.pruning.MatchNoise` derives it
    from frames).
    lafs0, lafs1: (B, N, 2, 3) local affine frames. size0, size1: (B, 2) image sizes (h, w). key: (B,) int64, selects
    each pair's random numbers. Where an estimator uses a prior and none is given, it is derived from the frames and the
    quality, if both are given, otherwise from the points and, if given, the quality. One pair's arguments may come
    without the leading B.
    estimator: a preset of conf/estimator; `options` replace values of it (``threshold=0.5``).

    Returns an `Estimate` of B pairs (of one pair for (N, 2) points): F with unit Frobenius norm, inliers, ok, reason.
    Raises ValueError for points of another shape, a prior outside [0, 1], a noise or an image size that is not
    positive, the size of one image only, an unknown preset or an unknown option; a pair that cannot be solved is
    ``ok=False``, never an exception.
    """
    points0, points1 = (x if x.is_floating_point() else x.to(torch.float64) for x in (_tensor(x0), _tensor(x1)))
    for name, points in (("x0", points0), ("x1", points1)):
        if points.dim() not in (2, 3) or points.shape[-1] != 2:
            raise ValueError(f"{name} has shape {tuple(points.shape)}; it must be (N, 2) or (B, N, 2)")
    if points0.shape != points1.shape:
        raise ValueError(f"x0 has shape {tuple(points0.shape)} but x1 {tuple(points1.shape)}; they must be equal")
    single = points0.dim() == 2
    if not single and points0.shape[1] == 1 and len(points0) > 1 and mask is None:
        raise ValueError(
            f"x0 and x1 have shape {tuple(points0.shape)}, as OpenCV stores {len(points0)} points; give x0[:, 0] and "
            f"x1[:, 0] for one pair (with a mask they are {len(points0)} pairs of one match)"
        )

    def batch(value: Array | None, dims: int) -> Tensor | None:
        if value is None:
            return None
        tensor = _tensor(value).to(points0.device)
        return tensor[None] if single and tensor.dim() == dims - 1 else tensor

    x0_batch, x1_batch = (points[None] if single else points for points in (points0, points1))
    live = batch(mask, 2)
    if live is None:
        live = torch.ones(x0_batch.shape[:2], dtype=torch.bool, device=x0_batch.device)
    c = Correspondences(
        x0_batch, x1_batch, live.to(torch.bool), quality=batch(quality, 2), prior=batch(prior, 2),
        lafs0=batch(lafs0, 4), lafs1=batch(lafs1, 4), size0=batch(size0, 2), size1=batch(size1, 2), key=batch(key, 1),
        noise=batch(noise, 2),
    )  # fmt: skip
    expect_values(c)
    chosen = _estimator(estimator, json.dumps(options, sort_keys=True))
    if prior is None and getattr(chosen, "uses_prior", False):
        framed = lafs0 is not None and lafs1 is not None and quality is not None
        c = _consistency("frame_consistency" if framed else "position_consistency")(c)
    return chosen(c, seed)


def _tensor(value: Array) -> Tensor:
    return value if isinstance(value, Tensor) else torch.from_numpy(np.ascontiguousarray(value))


@functools.lru_cache(maxsize=64)
def _estimator(name: str, options: str) -> Estimator:
    built: Estimator = presets.build("estimator", name, **json.loads(options))
    return built


@functools.lru_cache(maxsize=2)
def _consistency(name: str) -> Pruner:
    built: Pruner = presets.build("pruner", name)
    return built
