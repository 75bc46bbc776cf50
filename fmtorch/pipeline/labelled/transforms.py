"""Changes of labelled matches that leave the truth true: pure functions, `x1^T F x0 = 0` before and after.

Images are transformed without being seen: an affine map T of pixels takes points x to T x, local frames with them, the
calibration K to T K (a rotation of the pixels becomes one of the camera, so that K stays upper triangular) and the
fundamental matrix to ``T1^-T F T0^-1``. Labels and the matcher's figures stay as they are. Matches that fall away are
masked; `LabelledMatches.compact` takes them out.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.epipolar import unit_frobenius
from fmtorch.pipeline.labelled.record import LabelledMatches

_ROUNDING = 1e-6  # pixels that a rotated side may exceed a whole number by


def swap(matches: LabelledMatches) -> LabelledMatches:
    """The same matches from image 1 to image 0. `quality` and `mutual` stay those of the direction that was matched."""
    c = matches.correspondences
    pairs = (("x0", "x1"), ("lafs0", "lafs1"), ("size0", "size1"), ("K0", "K1"))
    swapped = {name: getattr(c, other) for a, b in pairs for name, other in ((a, b), (b, a))}
    return matches.replace(correspondences=c.replace(**swapped), F=matches.F.mT.contiguous())


def rotate(matches: LabelledMatches, image: int, degrees: float | int) -> LabelledMatches:
    """One of the images turned in its plane, from its x axis to its y axis; multiples of 90 degrees are exact.

    The new image is the bounding box of the turned one, its sides rounded up, with the same middle.

    Args:
        matches: labelled matches with the image's size. image: 0 or 1. degrees: the angle.

    Raises ValueError where the size is not known.
    """
    size = _size(matches, image)
    cos, sin = _direction(degrees)
    turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64, device=size.device)
    sides = size.flip(-1).to(torch.float64)  # (w, h)
    turned = torch.ceil(sides @ turn.abs().T - _ROUNDING)
    shift = (turned - 1) / 2 - (sides - 1) / 2 @ turn.T
    T = torch.eye(3, dtype=torch.float64, device=size.device).repeat(len(matches), 1, 1)
    T[:, :2, :2], T[:, :2, 2] = turn, shift
    return transform(matches, image, T, turned.flip(-1).to(size.dtype))


def crop(matches: LabelledMatches, image: int, box: tuple[int, int, int, int]) -> LabelledMatches:
    """A part of one of the images; matches outside fall away, and the principal point is no longer in the middle.

    Args:
        matches: labelled matches. image: 0 or 1. box: first column, first row, and past the last ones, in pixels.

    Raises ValueError for an empty box.
    """
    left, top, right, bottom = box
    if left >= right or top >= bottom:
        raise ValueError(f"the box {box} is empty; it must be (left, top, right, bottom) in pixels")
    c = matches.correspondences
    x = c.x1 if image else c.x0
    low = torch.tensor([left, top], dtype=x.dtype, device=x.device) - 0.5
    high = torch.tensor([right, bottom], dtype=x.dtype, device=x.device) - 0.5
    inside = ((x >= low) & (x < high)).all(-1)
    T = torch.eye(3, dtype=torch.float64, device=x.device).repeat(len(matches), 1, 1)
    T[:, 0, 2], T[:, 1, 2] = -left, -top
    size = torch.tensor([bottom - top, right - left], device=x.device).expand(len(matches), 2).clone()
    return transform(matches.keep(inside), image, T, size)


def keep_ratio(matches: LabelledMatches, threshold: float | int) -> LabelledMatches:
    """The matches whose `quality`, the ratio of the distances to the two nearest descriptors, is below `threshold`.

    A threshold of 1 keeps all. Raises ValueError for matches without `quality`.
    """
    quality = matches.correspondences.quality
    if quality is None:
        raise ValueError("a ratio threshold needs `quality`: the nearest-neighbour distance ratio of each match")
    return matches if threshold >= 1 else matches.keep(quality < threshold)


def move(matches: LabelledMatches, step0: Float[Tensor, "b n 2"], step1: Float[Tensor, "b n 2"]) -> LabelledMatches:
    """Points, and their frames with them, moved by so many pixels: the error of a detector."""
    c = matches.correspondences
    changes: dict[str, Tensor] = {"x0": c.x0 + step0.to(c.x0), "x1": c.x1 + step1.to(c.x1)}
    for name, lafs, x in (("lafs0", c.lafs0, changes["x0"]), ("lafs1", c.lafs1, changes["x1"])):
        if lafs is not None:
            changes[name] = torch.cat([lafs[..., :2], x.to(lafs)[..., None]], -1)
    return matches.replace(correspondences=c.replace(**changes))


def transform(
    matches: LabelledMatches, image: int, T: Float[Tensor, "b 3 3"], size: Tensor | None = None
) -> LabelledMatches:
    """One of the images mapped by ``x -> T x``, an affine map of pixels that keeps the orientation.

    Args:
        matches: labelled matches. image: 0 or 1. T: last row (0, 0, 1), float64. size: the new size (h, w), (B, 2).
    """
    c = matches.correspondences
    names = {name: f"{name}{image}" for name in ("x", "lafs", "size", "K")}
    changes: dict[str, Tensor] = {names["x"]: _mapped(T, getattr(c, names["x"])[..., None])[..., 0]}
    lafs, K = getattr(c, names["lafs"]), getattr(c, names["K"])
    if lafs is not None:
        changes[names["lafs"]] = torch.cat([_linear(T, lafs[..., :2]), _mapped(T, lafs[..., 2:])], -1)
    if K is not None:
        changes[names["K"]] = _upper_triangular(T.to(K) @ K)
    if size is not None:
        changes[names["size"]] = size
    inverse = torch.linalg.inv(T).to(matches.F)
    F = inverse.mT @ matches.F if image else matches.F @ inverse
    return matches.replace(correspondences=c.replace(**changes), F=unit_frobenius(F))


def _size(matches: LabelledMatches, image: int) -> Tensor:
    size = matches.correspondences.size1 if image else matches.correspondences.size0
    if size is None:
        raise ValueError(f"to turn image {image} its size must be known: size{image}, which this matcher does not give")
    return size


def _direction(degrees: float | int) -> tuple[float, float]:
    """Cosine and sine, exact for multiples of 90 degrees."""
    quarters, rest = divmod(degrees, 90.0)
    if rest == 0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))


def _linear(T: Tensor, columns: Tensor) -> Tensor:
    """The linear part of T applied to columns (b, n, 2, k), computed in float64."""
    return (T[:, None, :2, :2] @ columns.to(T)).to(columns)


def _mapped(T: Tensor, points: Tensor) -> Tensor:
    """T applied to points as columns (b, n, 2, 1), computed in float64."""
    return (T[:, None, :2, :2] @ points.to(T) + T[:, None, :2, 2:]).to(points)


def _upper_triangular(K: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 3"]:
    """The calibration of the camera that sees as K does after a rotation about its axis: K = result @ rotation.

    The RQ decomposition of the upper left 2 x 2 part (Golub and Van Loan, section 5.1.8), positive on the diagonal.
    """
    a, b = K[:, 1, 0], K[:, 1, 1]
    r = torch.hypot(a, b)
    undo = torch.zeros_like(K)
    undo[:, 0, 0] = undo[:, 1, 1] = b / r
    undo[:, 0, 1], undo[:, 1, 0] = a / r, -a / r
    undo[:, 2, 2] = 1
    upper = K @ undo
    upper[:, 1, 0] = 0
    return upper
