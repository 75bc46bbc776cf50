"""The door of the engine: pairs cleaned, normalised, and grouped by size, so that nothing behind it sees padding.

Everything here depends on a pair's own live matches only: a pair gets the same numbers in any batch.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.geometry import canonical
from fmtorch.geometry.pixel_frame import PixelFrame
from fmtorch.types import Correspondences
from fmtorch.validation import reason, wrong_values

SMALLEST_BUCKET = 128
FARTHEST = 1e100  # px; a match beyond is none: numbers made of its coordinates would overflow
LEAST_NOISE, MOST_NOISE = 0.1, 10.0  # of a match, relative to a usual one; what is beyond is taken for these


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """P pairs whose live matches come first, padded with zeros to a common bucket of N slots.

    points: (4, P, N) float64, rows x0, y0, x1, y1 in normalised units: ``x = centre + unit * point``.
    count: live matches (P,). unit: pixels in one normalised unit (P,), a power of two. centre: (P, 4).
    slot: where each match stood in the caller's tensors (P, N). pair: index of each pair in the caller's batch.
    quality, prior: (P, N), zero in padded slots, None where the caller has none. noise: likewise, between LEAST_NOISE
    and MOST_NOISE, one in padded slots. size0, size1: (P, 2) as (h, w), pixels, or None. seed: of every random choice.
    Points, quality, prior and noise stay attached to the caller's graph; centre and unit are constants.
    """

    points: Float[Tensor, "4 p n"]
    live: Bool[Tensor, "p n"]
    count: Int[Tensor, " p"]
    unit: Float[Tensor, " p"]
    centre: Float[Tensor, "p 4"]
    slot: Int[Tensor, "p n"]
    pair: Int[Tensor, " p"]
    key: Int[Tensor, " p"]
    quality: Float[Tensor, "p n"] | None
    prior: Float[Tensor, "p n"] | None
    seed: int
    size0: Real[Tensor, "p 2"] | None = None
    size1: Real[Tensor, "p 2"] | None = None
    noise: Float[Tensor, "p n"] | None = None

    @property
    def units(self) -> Float[Tensor, "p slots"]:
        """Pixels in one normalised unit, divided by each match's noise: a column for all (P, 1) where there is none."""
        unit = self.unit[:, None]
        return unit if self.noise is None else unit / self.noise

    def weight(self) -> Float[Tensor, "p n"]:
        """What each match counts in a fit: its prior divided by the square of its noise; float64, zero if padded."""
        prior = self.live.to(torch.float64) if self.prior is None else self.prior
        return prior if self.noise is None else prior / self.noise.square()

    def __getitem__(self, index: Tensor) -> Problem:
        """The selected pairs."""
        changes = {
            field.name: getattr(self, field.name)[index]
            for field in dataclasses.fields(self)
            if isinstance(getattr(self, field.name), Tensor) and field.name != "points"
        }
        return dataclasses.replace(self, points=self.points[:, index], **changes)

    def only(self, index: Int[Tensor, " q"]) -> Problem:
        """The pairs of a sorted index without repetition; itself if these are all."""
        return self if len(index) == len(self.pair) else self[index]

    def take(self, index: Int[Tensor, "p k"], wanted: Bool[Tensor, "p n"]) -> Problem:
        """The same pairs with the matches of these indices; slots of unwanted ones, which stand last, are empty."""
        live = wanted.gather(1, index)

        def some(value: Tensor | None) -> Tensor | None:
            return None if value is None else torch.where(live, value.gather(1, index), 0)

        points = torch.where(live, self.points.gather(2, index.expand(4, -1, -1)), 0)
        return dataclasses.replace(
            self, points=points, live=live, count=live.sum(1), slot=self.slot.gather(1, index),
            quality=some(self.quality), prior=some(self.prior),
            noise=None if self.noise is None else torch.where(live, self.noise.gather(1, index), 1),
        )  # fmt: skip

    @property
    def frame(self) -> PixelFrame:
        """The coordinates of the points."""
        return PixelFrame(self.centre, self.unit, torch.ones_like(self.unit, dtype=torch.bool))

    def to_pixels(self, F: Float[Tensor, "p 3 3"]) -> Float[Tensor, "p 3 3"]:
        """Fundamental matrices of normalised coordinates, in pixels, canonical in scale and sign."""
        return canonical(self.frame.to_pixels(F[:, None])[:, 0])


def bucket(count: int) -> int:
    """The smallest of 128, 192, 256, 384, 512, ... that holds `count` matches."""
    power = max(SMALLEST_BUCKET, 1 << max(count - 1, 0).bit_length())
    return power * 3 // 4 if count <= power * 3 // 4 and power > SMALLEST_BUCKET else power


def usable(c: Correspondences) -> Bool[Tensor, "b n"]:
    """Live matches with finite coordinates, whose squares are finite too."""
    return c.mask & (c.x0.abs() < FARTHEST).all(-1) & (c.x1.abs() < FARTHEST).all(-1)


def problems(c: Correspondences, seed: int, least: int) -> tuple[list[Problem], dict[int, str]]:
    """Problems of equal bucket, and the reason for each pair that cannot be one (fewer than `least` matches, say)."""
    live = usable(c)
    counts, unfit = unfit_pairs(c, live, least)
    reasons = {i: reason for i, reason in enumerate(unfit) if reason}
    groups: dict[int, list[int]] = {}
    for i, n in enumerate(counts):
        if i not in reasons:
            groups.setdefault(bucket(n), []).append(i)
    made: list[Problem] = []
    for n, members in groups.items():
        problem, spread = _problem(c, live, torch.tensor(members, device=live.device), n, seed)
        for i in problem.pair[~spread].tolist():
            reasons[i] = "all matches coincide"
        if bool(spread.any()):
            made.append(problem if bool(spread.all()) else problem[spread.nonzero()[:, 0]])
    return made, reasons


def unfit_pairs(c: Correspondences, live: Bool[Tensor, "b n"], least: int) -> tuple[list[int], list[str]]:
    """The live matches of each pair, and why it cannot be estimated: too few of them, or wrong values."""
    wrong = wrong_values(c, live)
    table = torch.stack([live.sum(-1), *wrong.values()], 1).tolist()  # all at once: a GPU is asked but once
    counts = [n for n, *_ in table]
    few = [f"{n} matches; at least {least} are needed" if n < least else "" for n in counts]
    return counts, [a or reason(dict(zip(wrong, row[1:], strict=True))) for a, row in zip(few, table, strict=True)]


def _problem(c: Correspondences, live: Tensor, pair: Tensor, n: int, seed: int) -> tuple[Problem, Tensor]:
    live = live[pair]
    order = torch.argsort((~live).to(torch.uint8), dim=-1, stable=True)[:, :n]
    order = torch.nn.functional.pad(order, (0, n - order.shape[1]))
    count = live.sum(-1)
    live = torch.arange(n, device=live.device) < count[:, None]

    def take(value: Tensor | None) -> Tensor | None:
        return None if value is None else torch.where(live, value[pair].gather(1, order), 0).to(torch.float64)

    coordinates = torch.cat([c.x0, c.x1], -1)[pair].to(torch.float64)
    pixels = coordinates.gather(1, order[..., None].expand(-1, -1, 4))
    frame = PixelFrame.around(pixels, live)
    points = torch.where(live[..., None], frame.normalized(pixels), 0)
    prior, noise = take(c.prior), take(c.noise)
    if noise is not None:
        noise = torch.where(live, noise.nan_to_num(1).clamp(LEAST_NOISE, MOST_NOISE), 1)
    problem = Problem(
        points.permute(2, 0, 1).contiguous(), live, count, frame.pixels_per_unit, frame.centre, order, pair,
        c.keys[pair],
        take(None if c.quality is None else c.quality),
        None if prior is None else prior.nan_to_num(0).clamp(0, 1), seed,
        None if c.size0 is None else c.size0[pair], None if c.size1 is None else c.size1[pair],
        noise,
    )  # fmt: skip
    return problem, frame.spread
