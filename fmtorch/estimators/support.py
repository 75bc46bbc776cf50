"""Whether the inliers of a model could determine it: enough of them, and not all on one line."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.geometry.arithmetic import sqrt

ROUNDINGS = 4.0  # of coordinates, that exact points of a line may lie off it
EXTENT_ROUNDING = 2.0**-23  # the same in units of the points' extent: nobody knows pixels better than a float32 holds
FIRST_LOOK = 256  # matches that mostly suffice to see that there is support
DIRECTION = (0.3819660112501051, 0.7236067977499790, 0.8541019662496845, 0.5278640450004206)
"""Along which different matches are told apart; no simple ratios, so that hardly any two project to one number."""


def relative_rounding(dtype: torch.dtype) -> float:
    """The rounding error of a number of 1 of this type; 0 of integers."""
    return float(torch.finfo(dtype).eps) if dtype.is_floating_point else 0.0


def lack_of_support(
    points: Float[Tensor, "4 p n"], inliers: Bool[Tensor, "p n"], minimal: int, rounding: Float[Tensor, " p"]
) -> list[str]:
    """For each pair why its inliers determine no fundamental matrix; empty where they may.

    Args:
        points: x0, y0, x1, y1, in any unit and from any origin, float64.
        inliers: of the model of each pair. Several at one place in both images count once.
        minimal: the size of a minimal sample; fewer inliers support a model no more than any other.
        rounding: how exact the coordinates are, in the unit of the points.

    Returns:
        The reasons. They depend on a pair's own inliers alone, in any batch.
    """
    first = _lack(points[..., :FIRST_LOOK], inliers[:, :FIRST_LOOK], minimal, rounding)
    if inliers.shape[1] <= FIRST_LOOK or not any(first):
        return first
    everything = _lack(points, inliers, minimal, rounding)
    return [second if lack else "" for lack, second in zip(first, everything, strict=True)]


def _lack(points: Tensor, inliers: Tensor, minimal: int, rounding: Tensor) -> list[str]:
    on_line = [_collinear(image, inliers, rounding) for image in (points[:2], points[2:])]
    table = torch.stack([_different(points, inliers), *on_line], 1).tolist()
    return [reason(count, [bool(line0), bool(line1)], minimal) for count, line0, line1 in table]


def _different(points: Float[Tensor, "4 p n"], inliers: Bool[Tensor, "p n"]) -> Int[Tensor, " p"]:
    """How many inliers there are, those at one place counted once."""
    a, b, c, d = (x * along for x, along in zip(points, DIRECTION, strict=True))
    ordered = torch.where(inliers, a + b + c + d, torch.inf).sort(1).values
    changes = ordered[:, 1:] != ordered[:, :-1]
    return (changes & torch.isfinite(ordered[:, :-1])).sum(1) + torch.isfinite(ordered[:, -1])


def reason(count: int, on_line: list[bool], minimal: int) -> str:
    """What is said of a model of so many different inliers; on_line: whether they are, in each image."""
    if count < minimal:
        return f"the best model has {count} different inliers; at least {minimal} are needed"
    if any(on_line):
        images = " and ".join(f"image {i}" for i in (0, 1) if on_line[i])
        return f"the inliers of the best model lie on one line in {images}"
    return ""


def _collinear(
    x: Float[Tensor, "2 p n"], inliers: Bool[Tensor, "p n"], rounding: Float[Tensor, " p"]
) -> Bool[Tensor, " p"]:
    """Whether points lie on one line, up to rounding: that through the first one and the one farthest from it."""
    n = inliers.shape[1]
    place = torch.arange(n, device=x.device)

    def first(condition: Tensor) -> Tensor:
        index = torch.where(condition, place, n - 1).amin(1)
        return x.gather(2, index[None, :, None].expand(2, -1, 1))

    x = torch.where(inliers, x, 0)
    dx, dy = torch.where(inliers, x - first(inliers), 0)
    squared = dx * dx + dy * dy
    length = squared.amax(1, keepdim=True)
    ux, uy = (first(inliers & (squared == length)) - first(inliers))[..., 0]
    across = (dx * uy[:, None] - dy * ux[:, None]).abs().amax(1)
    extent = sqrt(length[:, 0])
    tolerance = torch.maximum(ROUNDINGS * rounding, EXTENT_ROUNDING * extent)
    on_line: Tensor = across <= tolerance * extent
    return on_line
