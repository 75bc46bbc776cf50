"""What travels between the stages: `Features`, `Correspondences`, `Estimate`.

Conventions (the whole project's):
points are (x, y) in pixels with (0, 0) at the centre of the first pixel; sizes are (h, w); image 0 comes first and
``x1^T F x0 = 0``; ``mask`` is True for a real, surviving match, and what stands in a masked slot means nothing."""

import dataclasses
import hashlib
import html
import math
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, TypeVar, cast

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.core.records import Index, Record, Rule, as_index, expect_fields, gathered, padded, slotted

MIN_LENS, MAX_LENS = -0.45, 0.2  # of lenses that leave an image unfolded and its corners in front of the camera
PROBABILITY = Rule(lambda prior: (prior >= 0) & (prior <= 1), "it is P(inlier), within [0, 1]")
DEVIATION = Rule(lambda noise: noise > 0, "it is a standard deviation, positive, or a covariance, positive definite")
SIZE = Rule(lambda size: (size > 0) & (size < torch.inf), "image sizes (h, w) are positive")
MAX_DEVIATION = 2.0  # relative, of a focal length of which anything is known
FOCAL = Rule(
    lambda focal: (
        (focal[..., 1] == torch.inf)
        | ((focal[..., 1] >= 0) & (focal[..., 1] <= MAX_DEVIATION) & (focal[..., 0] > 0) & (focal[..., 0] < torch.inf))
    ),
    "it is a positive focal length in px and a relative deviation: such as 0.05, at most 2, 0 if exact, inf if unknown",
)
LENS = Rule(
    lambda lens: (
        (lens[..., 1] == torch.inf)
        | ((lens[..., 1] >= 0) & (lens[..., 0] >= MIN_LENS) & (lens[..., 0] <= MAX_LENS) & (lens[..., 1] < torch.inf))
    ),
    "it is lambda in half diagonals, from -0.45 to 0.2, and its deviation",
)

MAX_ROWS = 20  # of a table in a notebook
RELATED = 1.0  # the significance from which on two images are called related (docs/concepts/related.md)

PAIR_TYPES = ("general", "planar", "rotation", "identical", "unrelated")
WARNINGS = {  # what each pair type leaves open
    "general": "",
    "planar": "one plane: matches do not determine F or focal lengths, and leave two poses of known cameras",
    "rotation": "the camera only turns: matches determine neither F nor a translation",
    "identical": "one photograph twice: matches determine neither F nor a pose",
    "unrelated": "the images show nothing in common",
}
CONTRADICTED = "far more matches agree without the calibration: it is of other images or of another resolution"

BENT = (
    "a lens bends the images (lambda about {:.2f}), and F is of pinholes: give lens='shared', or undistort the points"
)


def pair_key(identity: str) -> int:
    """The stable signed 64-bit key of a pair's identity (blake2b), which selects its random streams."""
    return int.from_bytes(hashlib.blake2b(identity.encode(), digest_size=8).digest(), "big", signed=True)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Features(Record):
    """The local features of one image, or of a padded batch of images (a leading dimension on every field).
    lafs: local affine frames (N, 2, 3) in kornia's convention, the last column being the centre in pixels. scores:
    detector response (N,). descriptors: (N, D). image_size: (h, w). mask: (N,), True for real ones; all by default."""

    lafs: Float[Tensor, "*batch n 2 3"]
    scores: Float[Tensor, "*batch n"]
    descriptors: Float[Tensor, "*batch n d"]
    image_size: Int[Tensor, "*batch 2"]
    mask: Bool[Tensor, "*batch n"] | None = None

    def __post_init__(self) -> None:
        expect_fields(self)
        if self.mask is None:
            mask = torch.ones(self.lafs.shape[:-2], dtype=torch.bool, device=self.lafs.device)
            object.__setattr__(self, "mask", mask)

    @property
    def keypoints(self) -> Float[Tensor, "*batch n 2"]:
        """The centres of the frames, (x, y) in pixels."""
        return self.lafs[..., 2]

    @property
    def valid(self) -> Bool[Tensor, "*batch n"]:
        """The mask, never None."""
        return cast(Tensor, self.mask)

    def __len__(self) -> int:
        return int(self.lafs.shape[-3])

    def __getitem__(self, index: Index) -> "Features":
        """Of a batch, the selected images (still a batch); of one image, the selected features."""
        i = as_index(index, self.lafs.shape[0])
        size = self.image_size[i] if self.image_size.dim() > 1 else self.image_size
        return Features(self.lafs[i], self.scores[i], self.descriptors[i], size, self.valid[i])


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Correspondences(Record):
    """A batch of B image pairs with their putative matches, padded to N slots.

    x0, x1: matched points (B, N, 2) in pixels. mask: (B, N).
    ratio: the distance of the nearest descriptor over that of the second nearest, in [0, 1], (B, N); smaller is better.
    score: the matcher's own confidence in [0, 1], (B, N); larger is better.
    prior: P(inlier) in [0, 1], (B, N), where something supplies it. noise: standard deviation of each match's distance
    to its epipolar line, relative to that of a usual match, (B, N), where something supplies it. stretch: derivatives
    (B, N, 2, 2, 2) of the points of both images by those of photographs, from which they were undistorted, times the
    root of the covariance there if noise has one; `noise` is then the root of their mean area times that beside it.
    lafs0, lafs1: local affine frames (B, N, 2, 3) where known. size0, size1: image sizes (B, 2) as (h, w).
    K0, K1: calibration matrices (B, 3, 3) where known. key: (B,) int64, see `pair_key`; 0 when not given.
    mutual: (B, N), True where the match is also the best one of its partner, where the matcher knows.
    focal: what estimators may take for known of the focal lengths of both images, (B, 2, 2): px and relative standard
    deviation (0 exact, infinite unknown), for square pixels and central principal points. shared_focal: (B,), whether
    both are one in units of the longer sides. Without these, estimates are of F alone, whatever K0 and K1 are.
    lens: what is known of the lenses of both images, (B, 2, 2): lambda of the division model and its standard deviation
    (0 exact, infinite unknown), see `fmtorch.find_fundamental`. shared_lens: (B,), whether both are one."""

    x0: Float[Tensor, "b n 2"]
    x1: Float[Tensor, "b n 2"]
    mask: Bool[Tensor, "b n"]
    ratio: Float[Tensor, "b n"] | None = None
    prior: Annotated[Float[Tensor, "b n"], PROBABILITY] | None = None
    lafs0: Float[Tensor, "b n 2 3"] | None = None
    lafs1: Float[Tensor, "b n 2 3"] | None = None
    size0: Annotated[Real[Tensor, "b 2"], SIZE] | None = None
    size1: Annotated[Real[Tensor, "b 2"], SIZE] | None = None
    K0: Float[Tensor, "b 3 3"] | None = None
    K1: Float[Tensor, "b 3 3"] | None = None
    key: Int[Tensor, " b"] | None = None
    mutual: Bool[Tensor, "b n"] | None = None
    noise: Annotated[Float[Tensor, "b n"], DEVIATION] | None = None
    focal: Annotated[Float[Tensor, "b 2 2"], FOCAL] | None = None
    shared_focal: Bool[Tensor, " b"] | None = None
    lens: Annotated[Float[Tensor, "b 2 2"], LENS] | None = None
    shared_lens: Bool[Tensor, " b"] | None = None
    score: Annotated[Float[Tensor, "b n"], PROBABILITY] | None = None
    stretch: Float[Tensor, "b n 2 2 2"] | None = None

    def __post_init__(self) -> None:
        expect_fields(self)
        if self.key is None:
            object.__setattr__(self, "key", torch.zeros(len(self), dtype=torch.int64, device=self.x0.device))
        if (self.size0 is None) != (self.size1 is None):
            known, missing = ("size1", "size0") if self.size0 is None else ("size0", "size1")
            raise ValueError(f"{known} is given but {missing} is not; give the sizes of both images, or of neither")

    @property
    def keys(self) -> Int[Tensor, " b"]:
        """The pairs' keys, never None."""
        return cast(Tensor, self.key)

    @property
    def ambiguity(self) -> Float[Tensor, "b n"] | None:
        """What ranks matches, (B, N), smaller is better: the ratio, or 1 - score, or None where neither is known."""
        return self.ratio if self.ratio is not None or self.score is None else 1 - self.score

    @property
    def asks_for_cameras(self) -> bool:
        """Whether estimates have focal lengths."""
        return self.focal is not None or self.shared_focal is not None

    def __len__(self) -> int:
        return int(self.x0.shape[0])

    def __getitem__(self, index: Index) -> "Correspondences":
        i = as_index(index, len(self))
        return self._map(lambda value: value[i])

    def count(self) -> Int[Tensor, " b"]:
        """Number of surviving matches of each pair."""
        return self.mask.sum(-1)

    def keep(self, mask: Bool[Tensor, "b n"]) -> "Correspondences":
        """The same matches, of which only those also in `mask` survive; ValueError for a mask of another kind."""
        if mask.shape != self.mask.shape or mask.dtype != torch.bool:
            shape = tuple(self.mask.shape)
            raise ValueError(f"mask is {mask.dtype} {tuple(mask.shape)}; it must be booleans of shape {shape}")
        return self.replace(mask=self.mask & mask)

    def compact(self, multiple: int = 1) -> "Correspondences":
        """Survivors moved to the front in their order, padding cut to the longest pair (rounded up to `multiple`)."""
        longest = int(self.count().max()) if self.mask.numel() else 0
        n = -(-longest // multiple) * multiple
        order = torch.argsort(self.mask.logical_not().to(torch.uint8), dim=-1, stable=True)[:, :n]
        return self.derived(**{name: padded(gathered(v, order), 1, n) for name, v in slotted(self).items()})


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Estimate(Record):
    """Fundamental matrices, or homographies, of B pairs.

    matrix: (B, 3, 3) with unit Frobenius norm, zero where `ok` is False; `F` or `H` by its name. inliers: (B, N),
    within the mask; none where `ok` is False. ok: (B,). reason: why a pair failed, empty where it did not. samples:
    minimal samples drawn, (B,). significance: (B,), how far the support of the model is beyond chance, see
    `fmtorch.geometry.significance`: -log10 of the number of models with as much support that are expected among images
    that show nothing in common; -inf where `ok` is False, NaN where nobody has computed it; never None. model:
    "fundamental", or "homography" for `x1 ~ H x0`, which is positive where the plane is seen.

    Where cameras are known or asked for, NaN if not determined: focals (B, 2), px; X1 = R X0 + t, t of unit length;
    E = [t]_x R. fit_scale: (B,), the Sampson distance beyond which a match of usual noise did not count in the final
    fit, px. focal_precision: (B, 2, 2), second derivatives of the prior's cost in the logarithms of the focal lengths,
    infinite on the diagonal where these are exact.

    Where the covariance is asked for: covariance (B, 7, 7) of (rotation vector omega of ``exp([omega]x) R``, tau,
    log f0, log f1), radians and logarithms, where t moves to ``t + tangents tau``, (B, 9, 9) with both lambdas where
    lenses are estimated; tangents (B, 3, 2); covariance_F (B, 9, 9), F row by row. See `fmtorch.geometry.covariance`.

    Where the pair type is asked for: pair_type_index (B,), into `PAIR_TYPES`; homography (B, 3, 3), of the
    plane, the rotation or the copy, zero where there is none; other_R, other_t, the second pose that explains a plane,
    NaN where there is none.

    Where image sizes are not given and may be assumed: sizes (B, 2, 2), (h, w) of both images as inferred from
    the points, NaN where they cannot be; sizes_doubtful (B,), whether images of one size and of two were both likely.

    Where lenses are estimated: lens (B, 2), lambda of both, NaN where they are not determined.
    Where pinholes are assumed: lens_suggested (B,), lambda of one lens for both images with which the matches agree
    where they contradict pinholes, NaN where they do not.
    Where anything is known of focal lengths: contradicted (B,), whether F is far more significant without it."""

    matrix: Float[Tensor, "b 3 3"]
    inliers: Bool[Tensor, "b n"]
    ok: Bool[Tensor, " b"]
    reason: tuple[str, ...]
    samples: Int[Tensor, " b"]
    significance: Float[Tensor, " b"] | None = None
    model: str = "fundamental"
    E: Float[Tensor, "b 3 3"] | None = None
    R: Float[Tensor, "b 3 3"] | None = None
    t: Float[Tensor, "b 3"] | None = None
    focals: Float[Tensor, "b 2"] | None = None
    fit_scale: Float[Tensor, " b"] | None = None
    focal_precision: Float[Tensor, "b 2 2"] | None = None
    covariance: Float[Tensor, "b m m"] | None = None
    tangents: Float[Tensor, "b 3 2"] | None = None
    covariance_F: Float[Tensor, "b 9 9"] | None = None
    pair_type_index: Int[Tensor, " b"] | None = None
    homography: Float[Tensor, "b 3 3"] | None = None
    other_R: Float[Tensor, "b 3 3"] | None = None
    other_t: Float[Tensor, "b 3"] | None = None
    sizes: Float[Tensor, "b 2 2"] | None = None
    sizes_doubtful: Bool[Tensor, " b"] | None = None
    lens: Float[Tensor, "b 2"] | None = None
    lens_suggested: Float[Tensor, " b"] | None = None
    contradicted: Bool[Tensor, " b"] | None = None

    def __post_init__(self) -> None:
        expect_fields(self)
        b = len(self)
        if self.significance is None:
            object.__setattr__(self, "significance", self.ok.new_full((b,), torch.nan, dtype=torch.float64))
        if not isinstance(self.reason, tuple | list) or not all(isinstance(entry, str) for entry in self.reason):
            raise TypeError(f"reason is a {type(self.reason).__name__}; it must be a tuple of strings")
        object.__setattr__(self, "reason", tuple(self.reason))
        if len(self.reason) != b:
            raise ValueError(f"reason has {len(self.reason)} entries; it must have one for each of the {b} pairs")

    @property
    def F(self) -> Tensor:
        """The fundamental matrices (B, 3, 3). Raises AttributeError where the estimate is of homographies."""
        if self.model != "fundamental":
            raise AttributeError("these are homographies: take `H`; find_fundamental gives fundamental matrices")
        return self.matrix

    @property
    def H(self) -> Tensor:
        """The homographies (B, 3, 3). Raises AttributeError where the estimate is of fundamental matrices."""
        if self.model != "homography":
            raise AttributeError("these are fundamental matrices: take `F`; find_homography gives homographies")
        return self.matrix

    @property
    def related(self) -> Bool[Tensor, " b"]:
        """Whether the two images are taken to show one scene: ok, with a significance of at least `RELATED`.
        Recall and all other metrics use `ok` alone; this says which estimates to believe."""
        return self.ok & (cast(Tensor, self.significance) >= RELATED)

    @property
    def pair_type(self) -> tuple[str, ...]:
        """The name in `PAIR_TYPES` of each pair. Raises AttributeError where it was not asked for."""
        if self.pair_type_index is None:
            raise AttributeError("the pair type is not known; find_fundamental(..., pair_type=True) gives it")
        return tuple(PAIR_TYPES[i] for i in self.pair_type_index.tolist())

    @property
    def warning(self) -> tuple[str, ...]:
        """What the type of each pair leaves open, whether its matches contradict its calibration matrices or pinholes,
        and which sizes were doubtful. Empty where there is nothing to say."""
        lens, unknown = self.lens_suggested, self.pair_type_index is None
        opens = [""] * len(self) if unknown else [WARNINGS[name] for name in self.pair_type]
        contradicted = [False] * len(self) if self.contradicted is None else self.contradicted.tolist()
        said = [[CONTRADICTED if wrong else "", left] for wrong, left in zip(contradicted, opens, strict=True)]
        if self.sizes is not None and self.sizes_doubtful is not None:
            for i in self.sizes_doubtful.nonzero()[:, 0].tolist():
                sizes = " and ".join(f"({h:.0f}, {w:.0f})" for h, w in self.sizes[i].tolist())
                said[i].append(f"image sizes are not given; {sizes} are assumed: give size0 and size1, or 'unknown'")
        for i in [] if lens is None else lens.isfinite().nonzero()[:, 0].tolist():
            said[i].append(BENT.format(float(cast(Tensor, lens)[i])))
        return tuple("; ".join(filter(None, each)) for each in said)

    @property
    def deviation_degrees(self) -> Float[Tensor, "b 2"]:
        """Root mean squared angles by which the rotation and the direction of translation may be off, under independent
        noise; 132 and 98 degrees where nothing is known. Raises AttributeError where no covariance was asked for."""
        if self.covariance is None:
            raise AttributeError("the covariance is not known; find_fundamental(..., covariance=True) gives it")
        variances = self.covariance.diagonal(dim1=-2, dim2=-1)
        return torch.rad2deg(torch.stack([variances[:, :3].sum(-1), variances[:, 3:5].sum(-1)], -1).sqrt())

    def __len__(self) -> int:
        return int(self.matrix.shape[0])

    def __getitem__(self, index: Index) -> "Estimate":
        i = as_index(index, len(self))
        picked = torch.arange(len(self), device=self.ok.device)[i].tolist()
        return self._map(lambda value: value[i], reason=tuple(self.reason[j] for j in picked))

    def __repr__(self) -> str:
        if len(self) == 1:
            return f"{type(self).__name__}({', '.join(filter(None, self._row(0)[1:]))})"
        inliers = self.inliers.sum(-1).tolist()
        spread = f", {min(inliers)} to {max(inliers)} inliers" if inliers else ""
        ok, related = int(self.ok.sum()), int(self.related.sum())
        return f"{type(self).__name__}({len(self)} pairs: {ok} ok, {related} related{spread})"

    def _repr_html_(self) -> str:
        rows = [_html_row(self._row(i)) for i in range(min(len(self), MAX_ROWS))]
        if len(self) > MAX_ROWS:
            rows.append(f'<tr><td colspan="4">and {len(self) - MAX_ROWS} more</td></tr>')
        header = _html_row(("pair", "found", "inliers", "support"), "th")
        return f"<table><caption>{html.escape(repr(self))}</caption>{header}{''.join(rows)}</table>"

    def _row(self, i: int) -> tuple[str, str, str, str]:
        """A pair's number, what was found, its inliers and its significance."""
        if not self.ok[i]:
            return str(i), f"no {self.model} matrix: {self.reason[i]}", "", ""
        found = self.model
        if self.R is not None and bool(self.R[i].isfinite().all()):
            found += " and pose"
        if self.pair_type_index is not None:
            found += f", {self.pair_type[i]}"
        value = float(cast(Tensor, self.significance)[i])
        support = "" if math.isnan(value) else f"significance {value:.1f}, {'' if self.related[i] else 'not '}related"
        return str(i), found, f"{int(self.inliers[i].sum())} inliers", support


def _html_row(cells: Iterable[str], tag: str = "td") -> str:
    return f"<tr>{''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class PoseEstimate(Estimate):
    """An `Estimate` that has the relative pose and focal lengths of each pair, NaN where they are not determined."""

    E: Float[Tensor, "b 3 3"] = dataclasses.field(kw_only=True)
    R: Float[Tensor, "b 3 3"] = dataclasses.field(kw_only=True)
    t: Float[Tensor, "b 3"] = dataclasses.field(kw_only=True)
    focals: Float[Tensor, "b 2"] = dataclasses.field(kw_only=True)


Item = TypeVar("Item", Features, Correspondences, Estimate)


def collate(items: Sequence[Item]) -> Item:
    """One padded batch from several items: single-image `Features` are stacked, batches are joined.
    Optional fields survive only where every item has them. Raises ValueError for an empty list, TypeError for items of
    several kinds (single images and batches of images are two kinds)."""
    if not items:
        raise ValueError("collate needs at least one item")
    first = items[0]
    if len({(type(item), item.lafs.dim() if isinstance(item, Features) else 0) for item in items}) > 1:
        raise TypeError(f"collate needs items of one kind, not {', '.join(type(item).__name__ for item in items[:5])}")
    single = isinstance(first, Features) and first.image_size.dim() == 1
    axis = 0 if single else 1  # of slots
    n = max(getattr(item, first.per_slot[0]).shape[axis] for item in items)
    merged: dict[str, Any] = {}
    for field in dataclasses.fields(first):
        values = [getattr(item, field.name) for item in items]
        if field.name == "reason":
            merged[field.name] = sum(values, ())
        elif field.name == "model":
            if len(set(values)) > 1:
                raise TypeError(f"collate needs estimates of one model, not {', '.join(sorted(set(values)))}")
            merged[field.name] = values[0]
        elif any(value is None for value in values):
            merged[field.name] = None
        else:
            if field.name in first.per_slot:
                values = [padded(value, axis, n) for value in values]
            merged[field.name] = torch.stack(values) if single else torch.cat(values)
    return type(first)(**merged)
