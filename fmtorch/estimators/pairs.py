"""The door of the engine: pairs cleaned, normalised, and grouped by size, so that nothing behind it sees padding.

Everything here depends on a pair's own usable matches only: a pair gets the same numbers in any batch.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.core.checks import reason, wrong_values
from fmtorch.core.types import Correspondences
from fmtorch.geometry import canonical
from fmtorch.geometry.pixel_frame import PixelFrame

SMALLEST_BUCKET = 128
MAX_COORDINATE_PX = 1e100  # a match beyond is none: numbers made of its coordinates would overflow
MIN_NOISE, MAX_NOISE = 0.1, 10.0  # of a match, relative to a usual one; what is beyond is taken for these


@dataclasses.dataclass(frozen=True, eq=False)
class NormalizedPairs:
    """P pairs whose matches come first, padded with zeros to a common bucket of N slots.

    points: (4, P, N) float64, rows x0, y0, x1, y1 in normalised units: ``x = centre + pixels_per_unit * point``.
    mask: (P, N), True for a match; count: how many (P,). pixels_per_unit: (P,), a power of two. centre: (P, 4).
    slot: where each match stood in the caller's tensors (P, N). row: where each pair stood in the caller's batch.
    quality, prior: (P, N), zero in padded slots, None where the caller has none. noise: likewise, between MIN_NOISE
    and MAX_NOISE, one in padded slots. size0, size1: (P, 2) as (h, w), pixels, or None. seed: of every random choice.
    Points, quality, prior and noise stay attached to the caller's graph; the frame is constant.
    """

    points: Float[Tensor, "4 p n"]
    mask: Bool[Tensor, "p n"]
    count: Int[Tensor, " p"]
    pixels_per_unit: Float[Tensor, " p"]
    centre: Float[Tensor, "p 4"]
    slot: Int[Tensor, "p n"]
    row: Int[Tensor, " p"]
    key: Int[Tensor, " p"]
    quality: Float[Tensor, "p n"] | None
    prior: Float[Tensor, "p n"] | None
    seed: int
    size0: Real[Tensor, "p 2"] | None = None
    size1: Real[Tensor, "p 2"] | None = None
    noise: Float[Tensor, "p n"] | None = None
    kept: dict[str, Tensor] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.row)

    @functools.cached_property
    def points32(self) -> Float[Tensor, "4 p n"]:
        """The points as scores take them: float32, on no graph."""
        return self.points.detach().to(torch.float32)

    @property
    def scale(self) -> Float[Tensor, "p slots"]:
        """Pixels in one normalised unit, divided by each match's noise: a column for all (P, 1) where there is none."""
        unit = self.pixels_per_unit[:, None]
        return unit if self.noise is None else unit / self.noise

    @property
    def weight(self) -> Float[Tensor, "p n"]:
        """What each match counts in a fit: its prior divided by the square of its noise; float64, zero if padded."""
        prior = self.mask.to(torch.float64) if self.prior is None else self.prior
        return prior if self.noise is None else prior / self.noise.square()

    @property
    def sizes_known(self) -> bool:
        """Whether the sizes of the images are known."""
        return self.size0 is not None and self.size1 is not None

    @property
    def same_size(self) -> list[bool]:
        """Whether both images of each pair have one size. Of pairs whose sizes are known."""
        assert self.size0 is not None
        assert self.size1 is not None
        same: list[bool] = (self.size0 == self.size1).all(-1).tolist()
        return same

    @property
    def requires_grad(self) -> bool:
        """Whether a gradient can reach points, prior or noise."""
        inputs = (self.points, self.prior, self.noise)
        return torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in inputs)

    @property
    def frame(self) -> PixelFrame:
        """The coordinates of the points."""
        return PixelFrame(self.centre, self.pixels_per_unit, torch.ones_like(self.count, dtype=torch.bool))

    def once(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        """What a part computes of all matches, rows first, and needs again for the same pairs or some of them."""
        if name not in self.kept:
            self.kept[name] = compute()
        return self.kept[name]

    def __getitem__(self, rows: Tensor) -> NormalizedPairs:
        """The selected pairs."""
        changes = {
            field.name: getattr(self, field.name)[rows]
            for field in dataclasses.fields(self)
            if isinstance(getattr(self, field.name), Tensor) and field.name != "points"
        }
        kept = {name: value[rows] for name, value in self.kept.items()}
        return dataclasses.replace(self, points=self.points[:, rows], kept=kept, **changes)

    def only(self, rows: Sequence[int] | Int[Tensor, " q"]) -> NormalizedPairs:
        """The pairs of these rows, in ascending order and each once; itself if these are all."""
        return self if len(rows) == len(self) else self[torch.as_tensor(rows, device=self.row.device)]

    def take(self, index: Int[Tensor, "p k"], wanted: Bool[Tensor, "p n"]) -> NormalizedPairs:
        """The same pairs with the matches of these indices; slots of unwanted ones, which stand last, are empty."""
        mask = wanted.gather(1, index)

        def some(value: Tensor | None, padding: int = 0) -> Tensor | None:
            return None if value is None else torch.where(mask, value.gather(1, index), padding)

        points = torch.where(mask, self.points.gather(2, index.expand(4, -1, -1)), 0)
        return dataclasses.replace(
            self, points=points, mask=mask, count=mask.sum(1), slot=self.slot.gather(1, index), kept={},
            quality=some(self.quality), prior=some(self.prior), noise=some(self.noise, 1),
        )  # fmt: skip

    def to_pixels(self, F: Float[Tensor, "p 3 3"]) -> Float[Tensor, "p 3 3"]:
        """Fundamental matrices of normalised coordinates, in pixels, canonical in scale and sign."""
        return canonical(self.frame.to_pixels(F[:, None])[:, 0])


def bucket(count: int) -> int:
    """The smallest of 128, 192, 256, 384, 512, ... that holds `count` matches."""
    power = max(SMALLEST_BUCKET, 1 << max(count - 1, 0).bit_length())
    return power * 3 // 4 if count <= power * 3 // 4 and power > SMALLEST_BUCKET else power


def finite_matches(c: Correspondences) -> Bool[Tensor, "b n"]:
    """Matches with finite coordinates, whose squares are finite too."""
    return c.mask & (c.x0.abs() < MAX_COORDINATE_PX).all(-1) & (c.x1.abs() < MAX_COORDINATE_PX).all(-1)


def normalized_pairs(c: Correspondences, seed: int, least: int) -> tuple[list[NormalizedPairs], dict[int, str]]:
    """Pairs by bucket, and the reason for each pair that is in none (fewer than `least` matches, say)."""
    mask = finite_matches(c)
    counts, unfit = unfit_pairs(c, mask, least)
    reasons = {i: reason for i, reason in enumerate(unfit) if reason}
    groups: dict[int, list[int]] = {}
    for i, n in enumerate(counts):
        if i not in reasons:
            groups.setdefault(bucket(n), []).append(i)
    made: list[NormalizedPairs] = []
    for n, members in groups.items():
        pairs, spread = _bucket_of(c, mask, torch.tensor(members, device=mask.device), n, seed)
        apart = spread.tolist()
        reasons |= {i: "all matches coincide" for i, differ in zip(members, apart, strict=True) if not differ}
        rows = [i for i, differ in enumerate(apart) if differ]
        if rows:
            made.append(pairs.only(rows))
    return made, reasons


def unfit_pairs(c: Correspondences, mask: Bool[Tensor, "b n"], least: int) -> tuple[list[int], list[str]]:
    """The usable matches of each pair, and why it cannot be estimated: too few of them, or wrong values."""
    wrong = wrong_values(c, mask)
    table = torch.stack([mask.sum(-1), *wrong.values()], 1).tolist()  # all at once: a GPU is asked but once
    counts = [n for n, *_ in table]
    few = [too_few(n, least) for n in counts]
    return counts, [a or reason(dict(zip(wrong, row[1:], strict=True))) for a, row in zip(few, table, strict=True)]


def too_few(count: int, least: int) -> str:
    """Why so few matches cannot be estimated; empty of enough."""
    return f"{count} matches; at least {least} are needed" if count < least else ""


def _bucket_of(c: Correspondences, mask: Tensor, row: Tensor, n: int, seed: int) -> tuple[NormalizedPairs, Tensor]:
    """The pairs of these rows in n slots, and whether the matches of each do not coincide."""
    mask = mask[row]
    slot = torch.argsort((~mask).to(torch.uint8), dim=-1, stable=True)[:, :n]
    slot = torch.nn.functional.pad(slot, (0, n - slot.shape[1]))
    count = mask.sum(-1)
    mask = torch.arange(n, device=mask.device) < count[:, None]

    def take(value: Tensor | None) -> Tensor | None:
        return None if value is None else torch.where(mask, value[row].gather(1, slot), 0).to(torch.float64)

    coordinates = torch.cat([c.x0, c.x1], -1)[row].to(torch.float64)
    pixels = coordinates.gather(1, slot[..., None].expand(-1, -1, 4))
    frame = PixelFrame.around(pixels, mask)
    points = torch.where(mask[..., None], frame.normalized(pixels), 0).permute(2, 0, 1).contiguous()
    prior, noise = take(c.prior), take(c.noise)
    if prior is not None:
        prior = prior.nan_to_num(0).clamp(0, 1)
    if noise is not None:
        noise = torch.where(mask, noise.nan_to_num(1).clamp(MIN_NOISE, MAX_NOISE), 1)
    size0, size1 = (None if size is None else size[row] for size in (c.size0, c.size1))
    pairs = NormalizedPairs(
        points, mask, count, frame.pixels_per_unit, frame.centre, slot, row, c.keys[row], take(c.quality), prior, seed,
        size0, size1, noise,
    )  # fmt: skip
    return pairs, frame.spread
