"""What users say of cameras, as fields of `Correspondences`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.arguments import Arrays, as_tensor
from fmtorch.core.types import Correspondences
from fmtorch.geometry.cameras import calibration_problems

Focal = Literal["shared", "unknown"] | float | Arrays | Mapping[str, Any] | None
FORMS = "None, 'unknown', 'shared', (px, deviation) or ((px, deviation), (px, deviation))"
FORMS_WITH_K = "None, 'unknown', 'shared', or the relative deviations of the focal lengths of K: one, two, or (B, 2)"
UNKNOWN = (1.0, math.inf)  # px, relative deviation
MIN_PIXELS = 10.0  # a photograph's points reach farther from its first pixel
MIN_MATCHES = 8  # fewer say nothing of their unit
MAX_OUTSIDE = (
    0.5  # share of points outside an image of the given size, such as points undistorted far beyond its border
)
SWAPPED = 0.05  # share outside from which on a size is taken for (w, h), if all points are inside then


def camera_fields(K0: Arrays | None, K1: Arrays | None, focal: Focal, sizes_known: bool) -> dict[str, Any]:
    """The fields K0, K1, focal, shared_focal of the arguments of `find_fundamental`; none where nothing is said.

    Raises ValueError or TypeError, naming the argument.
    """
    if K0 is None and K1 is None and (focal is None or isinstance(focal, Mapping)):
        return {}
    if not sizes_known and (K0 is None or K1 is None):
        missing = "focal" if K0 is None and K1 is None else "K1 alone" if K0 is None else "K0 alone"
        raise ValueError(f"{missing} needs the image sizes: give size0 and size1")
    fields: dict[str, Any] = {name: _floating(K, name) for name, K in (("K0", K0), ("K1", K1)) if K is not None}
    if isinstance(focal, str):
        return fields | _named(focal)
    return fields | {"focal": _deviations(focal, K0 is not None, K1 is not None) if fields else _measured(focal)}


def expect_calibrations(c: Correspondences) -> None:
    """Raise ValueError naming K0 or K1 where it is no calibration matrix of the image, of a single pair."""
    if len(c) != 1:
        return
    for name, K, size in (("K0", c.K0, c.size0), ("K1", c.K1, c.size1)):
        if K is not None and (problem := calibration_problems(K, size, name)[0]):
            raise ValueError(problem)


def _named(focal: str) -> dict[str, Any]:
    """Fields where no focal length is known."""
    if focal not in ("shared", "unknown"):
        raise ValueError(f"focal is {focal!r}; it must be {FORMS}")
    nothing = torch.tensor([UNKNOWN, UNKNOWN], dtype=torch.float64)
    return {"focal": nothing} if focal == "unknown" else {"focal": nothing, "shared_focal": torch.tensor(True)}


def _measured(focal: Any) -> Tensor:
    """Focal lengths and deviations (2, 2) or (B, 2, 2)."""
    if isinstance(focal, list | tuple):
        focal = [UNKNOWN if entry is None else entry for entry in focal]
    values = _floating(focal, "focal")
    if values.shape == (2,):
        values = values.expand(2, 2)
    if values.dim() not in (2, 3) or values.shape[-2:] != (2, 2):
        raise ValueError(f"focal has shape {tuple(values.shape)}; without K0 and K1 it must be {FORMS}")
    return values


def _deviations(focal: Any, known0: bool, known1: bool) -> Tensor:
    """Deviations of the focal lengths of K, in the place where they stand beside px: (2, 2) or (B, 2, 2)."""
    values = _floating(0.0 if focal is None or isinstance(focal, Mapping) else focal, "focal")
    values = values.expand(2) if values.shape in ((), (1,)) else values
    if values.dim() > 2 or values.shape[-1] != 2:
        raise ValueError(f"focal has shape {tuple(values.shape)}; with K0 or K1 it must be {FORMS_WITH_K}")
    if not bool((values >= 0).all()):
        raise ValueError(f"focal is {values.tolist()}; a relative deviation is not negative")
    known = torch.tensor([known0, known1], device=values.device)
    values = torch.where(known, values, torch.inf)
    return torch.stack([torch.ones_like(values), values], -1)


def _floating(value: Any, name: str) -> Tensor:
    tensor = as_tensor(value, name)
    return tensor if tensor.is_floating_point() else tensor.to(torch.float64)


def expect_pixels(c: Correspondences) -> None:
    """Raise ValueError where the points of all pairs are obviously not in pixels, or contradict the image sizes.

    Of a batch in which some pairs are sound none is refused: no pair can take its batch down. Points of an image with a
    calibration matrix may be in its unit, whatever that is.
    """
    for i, (x, K, size) in enumerate(((c.x0, c.K0, c.size0), (c.x1, c.K1, c.size1))):
        x = x.detach()
        mask = c.mask & torch.isfinite(x).all(-1)
        enough = mask.sum(1) >= MIN_MATCHES
        if not bool(enough.any()):
            continue
        if bool(_normalized(x, mask, K)[enough].all()):
            _refuse(x, mask, i, K is not None)
        if size is not None:
            _expect_inside(x[enough], mask[enough], size.detach()[enough], i)


def _normalized(x: Float[Tensor, "b n 2"], mask: Bool[Tensor, "b n"], K: Tensor | None) -> Bool[Tensor, " b"]:
    """Whether all coordinates of a pair are too small for pixels, and not all are zero."""
    reach = torch.where(mask[..., None], x.abs(), 0).flatten(1).amax(1)
    small = (reach > 0) & (reach < MIN_PIXELS)
    if K is None:
        return small
    focal = K.detach().to(reach.device)[:, (0, 1), (0, 1)].abs().amax(1)
    return small & (focal > 10 * MIN_PIXELS)


def _refuse(x: Tensor, mask: Tensor, i: int, calibrated: bool) -> None:
    """Raise ValueError that says what the points are and what to do."""
    inside = x[mask]
    span = f"from {inside.min():.3g} to {inside.max():.3g}"
    if calibrated:
        raise ValueError(
            f"x{i} runs {span}, as normalised points do, but K{i} is in pixels; give points in pixels, or normalised "
            f"ones with K{i} the identity"
        )
    raise ValueError(
        f"x{i} runs {span}: no pixels, in which thresholds are, so that every match would be an inlier. Give points in "
        "pixels (times the focal length), or normalised ones to find_essential with K0 and K1 the identity"
    )


def _expect_inside(x: Float[Tensor, "b n 2"], mask: Bool[Tensor, "b n"], size: Tensor, i: int) -> None:
    """Raise ValueError where the points of all pairs contradict the image's size (b, 2), h and w."""
    far = _outside(x, mask, size.flip(-1))
    swapped = (far > SWAPPED) & (_outside(x, mask, size) == 0)
    if not bool(((far > MAX_OUTSIDE) | swapped).all()):
        return
    h, w = size[0].tolist()
    hint = "; sizes are (h, w), and it looks like (w, h)" if bool(swapped[0]) else "; sizes are (h, w) in pixels"
    raise ValueError(
        f"size{i} is ({h:g}, {w:g}), but {100 * float(far[0]):.0f} % of x{i} lie outside such an image{hint}"
    )


def _outside(x: Float[Tensor, "b n 2"], mask: Bool[Tensor, "b n"], width_height: Tensor) -> Float[Tensor, " b"]:
    """The share of points beyond the border, of the first pixel's centre and of the last one's, by a pixel."""
    limit = width_height.to(x.device)[:, None]
    beyond = ((x < -1) | (x > limit)).any(-1) & mask
    return beyond.sum(1) / mask.sum(1)
