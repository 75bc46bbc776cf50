"""What travels between the stages: `Features`, `Correspondences`, `Estimate`.

Conventions (the whole project's):
points are (x, y) in pixels with (0, 0) at the centre of the first pixel; sizes are (h, w); image 0 comes first and
``x1^T F x0 = 0``; ``mask`` is True for a real, surviving match, and what stands in a masked slot means nothing.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

Index = int | slice | Sequence[int] | Sequence[bool] | Tensor
Record = TypeVar("Record", bound="_Record")

FLOATING, WHOLE, REAL, BOOLEAN = "floating-point numbers", "whole numbers", "real numbers", "booleans"
NUMBERS = {
    **dict.fromkeys(("mask", "mutual", "inliers", "ok"), BOOLEAN),
    **dict.fromkeys(("key", "draws", "image_size", "label"), WHOLE),
    **dict.fromkeys(("size0", "size1"), REAL),
}
"""What the elements of a field are, where not floating-point numbers."""

RELATED = 1.0
"""The significance from which on two images are called related; chosen on tuning pairs (docs/related.md)."""


def pair_key(identity: str) -> int:
    """The stable signed 64-bit key of a pair's identity (blake2b), which selects its random streams."""
    return int.from_bytes(hashlib.blake2b(identity.encode(), digest_size=8).digest(), "big", signed=True)


class _Record:
    """Tensors with a common leading batch dimension, moved, indexed and replaced together."""

    def to(self: Record, device: torch.device | str) -> Record:
        """The same record with every tensor on `device`."""
        return self._map(lambda value: value.to(device))

    def detach(self: Record) -> Record:
        """The same record cut off from the graph."""
        return self._map(lambda value: value.detach())

    @property
    def requires_grad(self) -> bool:
        """Whether a gradient can reach any of the tensors."""
        values = [getattr(self, f.name) for f in dataclasses.fields(cast(Any, self))]
        return torch.is_grad_enabled() and any(isinstance(v, Tensor) and v.requires_grad for v in values)

    def replace(self: Record, **changes: Any) -> Record:
        """A copy with some fields changed (shapes are checked again)."""
        return cast(Record, dataclasses.replace(cast(Any, self), **changes))

    def _map(self: Record, function: Any, **changes: Any) -> Record:
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(cast(Any, self))}
        mapped = {name: function(v) for name, v in values.items() if isinstance(v, Tensor)}
        return self.replace(**mapped, **changes)


def ungraphed(inputs: _Record, compute: Callable[[], Record]) -> Record:
    """compute(), without autograd's bookkeeping unless a gradient can reach the inputs.

    That takes a fifth of the time of small tensors. The result's tensors are ordinary ones, free to use in a graph.
    """
    if inputs.requires_grad or torch.is_inference_mode_enabled():
        return compute()
    with torch.inference_mode():
        result = compute()
    return result._map(lambda value: value.clone() if value.is_inference() else value)


def _as_index(index: Index, length: int) -> slice | Tensor:
    """An index that keeps the batch dimension: the integer i selects the batch of one that holds element i.

    A list of booleans is a mask. Raises IndexError for an integer that is out of range, which also ends iteration.
    """
    if isinstance(index, slice):
        return index
    if isinstance(index, Tensor) and index.dim() > 0:
        return index
    if isinstance(index, int | Tensor):
        i = int(index)
        if not -length <= i < length:
            raise IndexError(f"index {i} is out of range for {length} elements")
        return slice(i, i + 1 or None)
    chosen = list(index)
    is_mask = bool(chosen) and all(isinstance(i, bool) for i in chosen)
    return torch.as_tensor(chosen, dtype=torch.bool if is_mask else torch.int64)


def _expect(name: str, value: Tensor | None, shape: tuple[int, ...], device: torch.device | None = None) -> None:
    """Raises TypeError or ValueError for what is no tensor of this shape, of the field's numbers, on the device."""
    if value is None:
        return
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} is a {type(value).__name__}; it must be a tensor")
    if tuple(value.shape) != shape:
        raise ValueError(f"{name} has shape {tuple(value.shape)}; it must be {shape}")
    if device is not None and value.device != device:
        raise ValueError(f"{name} is on {value.device} and another field on {device}; all must be on one device")
    wanted, kind = NUMBERS.get(name, FLOATING), _numbers(value)
    if kind != wanted and not (wanted == REAL and kind in (FLOATING, WHOLE)):
        raise ValueError(f"{name} is of {value.dtype}; it must hold {wanted}")


def _numbers(value: Tensor) -> str:
    """What a tensor's elements are."""
    if value.dtype == torch.bool:
        return BOOLEAN
    return FLOATING if value.is_floating_point() else "complex numbers" if value.is_complex() else WHOLE


def _expect_dimensions(name: str, value: Tensor, *numbers: int, shape: str) -> None:
    """Raises TypeError or ValueError unless the value is a tensor of one of these numbers of dimensions."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} is a {type(value).__name__}; it must be a tensor")
    if value.dim() not in numbers:
        raise ValueError(f"{name} has shape {tuple(value.shape)}; it must be {shape}")


@dataclasses.dataclass(frozen=True, eq=False)
class Features(_Record):
    """The local features of one image, or of a padded batch of images (a leading dimension on every field).

    lafs: local affine frames (N, 2, 3) in kornia's convention, the last column being the centre in pixels.
    scores: detector response (N,). descriptors: (N, D). image_size: (h, w).
    mask: (N,), True for a real feature; all True when not given.
    """

    lafs: Float[Tensor, "*batch n 2 3"]
    scores: Float[Tensor, "*batch n"]
    descriptors: Float[Tensor, "*batch n d"]
    image_size: Int[Tensor, "*batch 2"]
    mask: Bool[Tensor, "*batch n"] | None = None

    def __post_init__(self) -> None:
        _expect_dimensions("lafs", self.lafs, 3, 4, shape="(N, 2, 3), or (B, N, 2, 3) of a batch")
        _expect_dimensions("descriptors", self.descriptors, 2, 3, shape="(N, D), or (B, N, D) of a batch")
        _expect_dimensions("scores", self.scores, 1, 2, shape="(N,), or (B, N) of a batch")
        _expect_dimensions("image_size", self.image_size, 1, 2, shape="(2,), or (B, 2) of a batch")
        batch_n = tuple(self.lafs.shape[:-2])
        _expect("lafs", self.lafs, (*batch_n, 2, 3))
        device = self.lafs.device
        _expect("scores", self.scores, batch_n, device)
        _expect("descriptors", self.descriptors, (*batch_n, self.descriptors.shape[-1]), device)
        _expect("image_size", self.image_size, (*batch_n[:-1], 2), device)
        if self.mask is None:
            object.__setattr__(self, "mask", torch.ones(batch_n, dtype=torch.bool, device=device))
        _expect("mask", self.mask, batch_n, device)

    @property
    def keypoints(self) -> Float[Tensor, "*batch n 2"]:
        """The centres of the frames, (x, y) in pixels."""
        return self.lafs[..., 2]

    @property
    def valid(self) -> Bool[Tensor, "*batch n"]:
        """The mask, never None."""
        return cast(Tensor, self.mask)

    def __len__(self) -> int:
        """Number of feature slots, padding included."""
        return int(self.lafs.shape[-3])

    def __getitem__(self, index: Index) -> Features:
        """Of a batch, the selected images (still a batch); of one image, the selected features."""
        i = _as_index(index, self.lafs.shape[0])
        size = self.image_size[i] if self.image_size.dim() > 1 else self.image_size
        return Features(self.lafs[i], self.scores[i], self.descriptors[i], size, self.valid[i])


@dataclasses.dataclass(frozen=True, eq=False)
class Correspondences(_Record):
    """A batch of B image pairs with their putative matches, padded to N slots.

    x0, x1: matched points (B, N, 2) in pixels. mask: (B, N).
    quality: the matcher's own figure (B, N), for nearest neighbours the distance ratio; smaller is better.
    prior: P(inlier) in [0, 1], (B, N), where something supplies it.
    noise: standard deviation of each match's distance to its epipolar line, relative to that of a usual match, (B, N),
    where something supplies it.
    lafs0, lafs1: local affine frames (B, N, 2, 3) where known. size0, size1: image sizes (B, 2) as (h, w).
    K0, K1: calibration matrices (B, 3, 3) where known. key: (B,) int64, see `pair_key`; 0 when not given.
    mutual: (B, N), True where the match is also the best one of its partner, where the matcher knows.
    """

    x0: Float[Tensor, "b n 2"]
    x1: Float[Tensor, "b n 2"]
    mask: Bool[Tensor, "b n"]
    quality: Float[Tensor, "b n"] | None = None
    prior: Float[Tensor, "b n"] | None = None
    lafs0: Float[Tensor, "b n 2 3"] | None = None
    lafs1: Float[Tensor, "b n 2 3"] | None = None
    size0: Real[Tensor, "b 2"] | None = None
    size1: Real[Tensor, "b 2"] | None = None
    K0: Float[Tensor, "b 3 3"] | None = None
    K1: Float[Tensor, "b 3 3"] | None = None
    key: Int[Tensor, " b"] | None = None
    mutual: Bool[Tensor, "b n"] | None = None
    noise: Float[Tensor, "b n"] | None = None

    def __post_init__(self) -> None:
        _expect_dimensions("x0", self.x0, 3, shape="(B, N, 2)")
        _expect_dimensions("x1", self.x1, 3, shape="(B, N, 2)")
        _expect_dimensions("mask", self.mask, 2, shape="(B, N)")
        b, n = self.x0.shape[:2]
        if self.key is None:
            object.__setattr__(self, "key", torch.zeros(b, dtype=torch.int64, device=self.x0.device))
        shapes = {
            "x0": (b, n, 2), "x1": (b, n, 2), "mask": (b, n), "quality": (b, n), "prior": (b, n),
            "lafs0": (b, n, 2, 3), "lafs1": (b, n, 2, 3), "size0": (b, 2), "size1": (b, 2),
            "K0": (b, 3, 3), "K1": (b, 3, 3), "key": (b,), "mutual": (b, n),
            "noise": (b, n),
        }  # fmt: skip
        for name, shape in shapes.items():
            _expect(name, getattr(self, name), shape, self.x0.device)
        if (self.size0 is None) != (self.size1 is None):
            known, missing = ("size1", "size0") if self.size0 is None else ("size0", "size1")
            raise ValueError(f"{known} is given but {missing} is not; give the sizes of both images, or of neither")

    @property
    def keys(self) -> Int[Tensor, " b"]:
        """The pairs' keys, never None."""
        return cast(Tensor, self.key)

    def __len__(self) -> int:
        """Number of pairs."""
        return int(self.x0.shape[0])

    def __getitem__(self, index: Index) -> Correspondences:
        """The selected pairs, always as a batch."""
        i = _as_index(index, len(self))
        return self._map(lambda value: value[i])

    def count(self) -> Int[Tensor, " b"]:
        """Number of surviving matches of each pair."""
        return self.mask.sum(-1)

    def keep(self, mask: Bool[Tensor, "b n"]) -> Correspondences:
        """The same matches, of which only those also in `mask` survive."""
        return self.replace(mask=self.mask & mask)

    def compact(self, multiple: int = 1) -> Correspondences:
        """Survivors moved to the front in their order, padding cut to the longest pair (rounded up to `multiple`)."""
        longest = int(self.count().max()) if self.mask.numel() else 0
        n = -(-longest // multiple) * multiple
        order = torch.argsort(self.mask.logical_not().to(torch.uint8), dim=-1, stable=True)[:, :n]
        short = n - order.shape[1]

        def take(value: Tensor) -> Tensor:
            index = order.reshape(*order.shape, *[1] * (value.dim() - 2)).expand(-1, -1, *value.shape[2:])
            return _pad(torch.gather(value, 1, index), 1, order.shape[1] + short)

        per_match = ("x0", "x1", "mask", "quality", "prior", "lafs0", "lafs1", "mutual", "noise")
        return self.replace(**{f: take(getattr(self, f)) for f in per_match if getattr(self, f) is not None})


@dataclasses.dataclass(frozen=True, eq=False)
class Estimate(_Record):
    """Fundamental matrices of B pairs.

    F: (B, 3, 3) with unit Frobenius norm, zero where `ok` is False. inliers: (B, N), within the mask; none where `ok`
    is False. ok: (B,). reason: why a pair failed, empty where it did not. draws: minimal samples drawn, (B,).
    significance: (B,), how far the support of F is beyond chance, see `fmtorch.geometry.significance`: -log10 of the
    number of models with as much support that are expected among images that show nothing in common; -inf where `ok`
    is False, NaN where nobody has computed it; never None.
    """

    F: Float[Tensor, "b 3 3"]
    inliers: Bool[Tensor, "b n"]
    ok: Bool[Tensor, " b"]
    reason: tuple[str, ...]
    draws: Int[Tensor, " b"]
    significance: Float[Tensor, " b"] | None = None

    def __post_init__(self) -> None:
        _expect_dimensions("F", self.F, 3, shape="(B, 3, 3)")
        _expect_dimensions("inliers", self.inliers, 2, shape="(B, N)")
        _expect_dimensions("ok", self.ok, 1, shape="(B,)")
        _expect_dimensions("draws", self.draws, 1, shape="(B,)")
        b = self.F.shape[0]
        if self.significance is None:
            unknown = torch.full((b,), torch.nan, dtype=torch.float64, device=self.F.device)
            object.__setattr__(self, "significance", unknown)
        _expect("F", self.F, (b, 3, 3))
        _expect("inliers", self.inliers, (b, self.inliers.shape[-1]))
        _expect("ok", self.ok, (b,))
        _expect("draws", self.draws, (b,))
        if not isinstance(self.reason, tuple | list) or not all(isinstance(entry, str) for entry in self.reason):
            raise TypeError(f"reason is a {type(self.reason).__name__}; it must be a tuple of strings")
        object.__setattr__(self, "reason", tuple(self.reason))
        _expect("significance", self.significance, (b,))
        if len(self.reason) != b:
            raise ValueError(f"reason has {len(self.reason)} entries; it must have one for each of the {b} pairs")

    @property
    def related(self) -> Bool[Tensor, " b"]:
        """Whether the two images are taken to show one scene: ok, with a significance of at least `RELATED`.

        Recall and all other figures are of `ok` alone; this tells whom to believe.
        """
        return self.ok & (cast(Tensor, self.significance) >= RELATED)

    def __len__(self) -> int:
        """Number of pairs."""
        return int(self.F.shape[0])

    def __getitem__(self, index: Index) -> Estimate:
        """The selected pairs, always as a batch."""
        i = _as_index(index, len(self))
        picked = torch.arange(len(self), device=self.ok.device)[i].tolist()
        return self._map(lambda value: value[i], reason=tuple(self.reason[j] for j in picked))


def _pad(value: Tensor, dim: int, length: int) -> Tensor:
    """`value` filled with zeros (False) along `dim` up to `length`."""
    missing = length - value.shape[dim]
    if missing <= 0:
        return value
    shape = list(value.shape)
    shape[dim] = missing
    return torch.cat([value, value.new_zeros(shape)], dim)


Item = TypeVar("Item", Features, Correspondences, Estimate)


def collate(items: Sequence[Item]) -> Item:
    """One padded batch from several items: single-image `Features` are stacked, batches are joined.

    Optional fields survive only where every item has them. Raises ValueError for an empty list, TypeError for items of
    several kinds (single images and batches of images are two kinds).
    """
    if not items:
        raise ValueError("collate needs at least one item")
    first = items[0]
    if len({(type(item), item.lafs.dim() if isinstance(item, Features) else 0) for item in items}) > 1:
        raise TypeError(f"collate needs items of one kind, not {', '.join(type(item).__name__ for item in items[:5])}")
    n = max(_slots(item) for item in items)
    merged: dict[str, Any] = {}
    for field in dataclasses.fields(first):
        values = [getattr(item, field.name) for item in items]
        if field.name == "reason":
            merged[field.name] = sum(values, ())
        elif any(value is None for value in values):
            merged[field.name] = None
        elif isinstance(first, Features) and first.image_size.dim() == 1:
            stacked = [_pad(value, 0, n) if field.name != "image_size" else value for value in values]
            merged[field.name] = torch.stack(stacked)
        else:
            padded = field.name in _PER_SLOT
            merged[field.name] = torch.cat([_pad(value, 1, n) if padded else value for value in values])
    return type(first)(**merged)


_PER_SLOT = frozenset(
    (
        *("lafs", "scores", "descriptors", "inliers"),
        *("x0", "x1", "mask", "quality", "prior", "lafs0", "lafs1", "mutual", "noise"),
    )
)


def _slots(item: Features | Correspondences | Estimate) -> int:
    if isinstance(item, Features):
        return len(item)
    return int((item.x0 if isinstance(item, Correspondences) else item.inliers).shape[1])
