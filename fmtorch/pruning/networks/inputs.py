"""Correspondences as the input of a network: normalised coordinates and side information, one column a match."""

import dataclasses
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.pruning.consistency import frame_agreement, usable_frame_maps

COORDINATES = ("size", "K")
MIN_AREA_RATIO = 1e-12  # of two frames; keeps the gradient of the logarithm finite


@dataclasses.dataclass(frozen=True)
class MatchInputs:
    """Turns correspondences into (B, channels, N) float32, zero in masked slots.

    coordinates, the first four channels (x0, y0, x1, y1):
      "size": ``(x - w/2) / max(h, w)``, as Brachmann & Rother, "Neural-guided RANSAC", ICCV 2019. Points have (0, 0) at
      the centre of the first pixel, so this centre is half a pixel off the image's: it is kept as published.
      "K": rays ``K^-1 (x, y, 1)``, as Yi et al., CVPR 2018, for the essential matrix.
    side: names from `SIDE`, in this order after the coordinates. What is not known, of a match or of all, is 0, which
    no channel but "scale" (beside "rotation") and "agreement" otherwise takes:
      "ratio": the ratio, or 1 - score, as it is, [0, 1].
      "mutual": 1 or -1.
      "scale": half the logarithm of the determinant of the map from frame 0 to frame 1.
      "rotation": cosine and sine of that map's rotation (of its polar decomposition), so without a jump at any angle.
      "agreement": ``2 a - 1`` with a of `frame_agreement`, in [-1, 1].

    Raises ValueError for unknown names.
    """

    coordinates: str = "size"
    side: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.coordinates not in COORDINATES:
            raise ValueError(f"coordinates={self.coordinates}; there are: {', '.join(COORDINATES)}")
        object.__setattr__(self, "side", tuple(self.side))
        unknown = [name for name in self.side if name not in SIDE]
        if unknown or len(set(self.side)) < len(self.side):
            raise ValueError(f"side={list(self.side)}: each at most once of {', '.join(SIDE)}")

    @property
    def channels(self) -> int:
        """Numbers for each match."""
        return 4 + sum(SIDE[name][0] for name in self.side)

    def __call__(self, c: Correspondences) -> tuple[Float[Tensor, "b channels n"], Bool[Tensor, "b n"]]:
        """The input and the mask of its columns: matches of `c.mask` whose normalised coordinates are finite.

        Raises ValueError where image sizes or calibration matrices are missing.
        """
        x0, x1 = (torch.where(c.mask[..., None], x, 0) for x in (c.x0, c.x1))
        points = [_by_size(x0, c.size0, "size0"), _by_size(x1, c.size1, "size1")] if self.coordinates == "size" else [
            _by_calibration(x0, c.K0, "K0"), _by_calibration(x1, c.K1, "K1")]  # fmt: skip
        coordinates = torch.cat(points, -1).float()
        mask = c.mask & torch.isfinite(coordinates).all(-1)
        channels = [*torch.where(mask[..., None], coordinates, 0).unbind(-1)]
        for name in self.side:
            channels += [torch.where(mask & torch.isfinite(value), value.float(), 0) for value in SIDE[name][1](c)]
        return torch.stack(channels, 1), mask

    def unit(self, c: Correspondences) -> Float[Tensor, " b"]:
        """How many pixels one unit of the coordinates is, on average over both images; as `x0` in type.

        Raises ValueError where image sizes or calibration matrices are missing.
        """
        if self.coordinates == "size":
            sizes = _known(c.size0, "size0", BY_SIZE), _known(c.size1, "size1", BY_SIZE)
            unit0, unit1 = (size.amax(-1) for size in sizes)
            return (unit0 + unit1).to(c.x0.dtype) / 2
        matrices = _known(c.K0, "K0", BY_CALIBRATION), _known(c.K1, "K1", BY_CALIBRATION)
        unit0, unit1 = ((K[:, 0, 0].abs() + K[:, 1, 1].abs()) / 2 for K in matrices)
        return (unit0 + unit1).to(c.x0.dtype) / 2


BY_SIZE = (
    "coordinates=size needs `{}`, the images' (h, w): give image sizes with the matches, or take a network trained on "
    "calibrated coordinates (coordinates=K)"
)
BY_CALIBRATION = (
    "coordinates=K needs `{}`, the calibration matrices: take a data set that has them, or a network trained on "
    "coordinates by image size (coordinates=size)"
)


def _known(value: Tensor | None, name: str, message: str) -> Tensor:
    if value is None:
        raise ValueError(message.format(name))
    return value


def _by_size(x: Float[Tensor, "b n 2"], size: Tensor | None, name: str) -> Float[Tensor, "b n 2"]:
    size = _known(size, name, BY_SIZE).to(x.dtype)
    longest = size.amax(-1)[:, None, None]
    return (x - size.flip(-1)[:, None] / 2) / longest


def _by_calibration(x: Float[Tensor, "b n 2"], K: Tensor | None, name: str) -> Float[Tensor, "b n 2"]:
    K = _known(K, name, BY_CALIBRATION)
    fx, skew, cx, fy, cy = (K[:, i, j, None].to(x.dtype) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    y = (x[..., 1] - cy) / fy
    return torch.stack([(x[..., 0] - cx - skew * y) / fx, y], -1)


def _ratio(c: Correspondences) -> list[Tensor]:
    return [torch.zeros_like(c.x0[..., 0]) if c.ambiguity is None else torch.where(c.mask, c.ambiguity, 0)]


def _mutual(c: Correspondences) -> list[Tensor]:
    return [torch.zeros_like(c.x0[..., 0]) if c.mutual is None else c.mutual.to(c.x0.dtype) * 2 - 1]


def _frame_map(c: Correspondences) -> Float[Tensor, "b n 2 2"] | None:
    """The linear part of the map from frame 0 to frame 1; the identity's in masked slots and for unusable frames."""
    return None if c.lafs0 is None or c.lafs1 is None else usable_frame_maps(c.lafs0, c.lafs1, c.mask)[0]


def _scale(c: Correspondences) -> list[Tensor]:
    S = _frame_map(c)
    if S is None:
        return [torch.zeros_like(c.x0[..., 0])]
    determinant = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    return [determinant.abs().clamp_min(MIN_AREA_RATIO).log() / 2]


def _rotation(c: Correspondences) -> list[Tensor]:
    S = _frame_map(c)
    if S is None:
        return [torch.zeros_like(c.x0[..., 0])] * 2
    cosine, sine = S[..., 0, 0] + S[..., 1, 1], S[..., 1, 0] - S[..., 0, 1]
    squared = cosine.square() + sine.square()
    inverse = torch.where(squared > 0, torch.where(squared > 0, squared, 1).rsqrt(), 0)
    return [cosine * inverse, sine * inverse]


def _agreement(c: Correspondences) -> list[Tensor]:
    if c.lafs0 is None or c.lafs1 is None:
        return [torch.zeros_like(c.x0[..., 0])]
    return [2 * frame_agreement(c.x0, c.x1, c.lafs0, c.lafs1, c.ambiguity, c.mask) - 1]


SIDE: dict[str, tuple[int, Callable[[Correspondences], list[Tensor]]]] = {
    "ratio": (1, _ratio),
    "mutual": (1, _mutual),
    "scale": (1, _scale),
    "rotation": (2, _rotation),
    "agreement": (1, _agreement),
}  # name: how many channels, and what they hold
