"""`LabelledMatches`: correspondences of a batch of pairs, which of them are right, the true geometry; `Augmentation`.

A match is right by where the true depth puts its point in the other image: an inlier where the point is carried to
within `INLIER_PX` of its partner, and an outlier where it is carried farther than `OUTLIER_PX` away, be it along the
epipolar line, where no estimator could tell. Between the two it is ignored: localisation of coarse keypoints is no
better. With a depth on both sides both directions must agree. Where no depth is known the distance to the epipolar
lines decides with the same two thresholds; it takes a wrong match that is near its line by chance for a right one (a
band of 6 px in an image 500 px high: about one in eighty).

Random changes are a function of (seed, pair key, epoch) alone and leave the truth true, ``x1^T F x0 = 0`` before and
after. Images are transformed without being seen: an affine map T of pixels takes points x to T x, local frames with
them, the calibration K to T K (a rotation of the pixels becomes one of the camera, so that K stays upper triangular)
and the fundamental matrix to ``T1^-T F T0^-1``. Labels and the matcher's figures stay as they are. Matches that fall
away are masked; `LabelledMatches.compact` takes them out."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core import Correspondences, records, types
from fmtorch.data.pairs import DepthDataset, ImagePair, ImageSource, PairDataset, line_distance
from fmtorch.geometry.epipolar import unit_frobenius
from fmtorch.io import oanet
from fmtorch.jit.random import Stream, bits, uniform
from fmtorch.training.options import AugmentationOptions, Range

INLIER, OUTLIER, IGNORED = 1, 0, -1
INLIER_PX = 3.0  # largest error of an inlier, pixels
OUTLIER_PX = 6.0  # smallest error of an outlier, pixels
EDGE_PX = 1.0  # a keypoint on an edge of depth may belong to what is so many pixels beside it
VERSION = 1  # of these rules, part of a store's identity

Rule = Literal["pixels", "geodesic"]  # labels by errors in pixels, or by OANet's geodesic distance
Points = NDArray[np.float64]
Labels = NDArray[np.int8]
_AROUND = EDGE_PX * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


@dataclasses.dataclass(frozen=True, eq=False)
class LabelledMatches(records.Record):
    """A batch of B pairs with N matches each (padded), labels and the true fundamental matrices.
    correspondences: the matches. label: (B, N) int8, 1 inlier, 0 outlier, -1 ignored, always -1 in masked slots. F: (B,
    3, 3) float64 of unit Frobenius norm, ``x1^T F x0 = 0``; zero where none is known or determined."""

    correspondences: Correspondences
    label: Int8[Tensor, "b n"]
    F: Float[Tensor, "b 3 3"]

    def __post_init__(self) -> None:
        b, n = self.correspondences.x0.shape[:2]
        records.expect_fields(self, b=b, n=n)
        object.__setattr__(self, "label", torch.where(self.correspondences.mask, self.label, IGNORED))

    @property
    def labelled(self) -> Bool[Tensor, "b n"]:
        return self.label >= 0

    @property
    def inlier(self) -> Bool[Tensor, "b n"]:
        return self.label == INLIER

    def __len__(self) -> int:
        return len(self.correspondences)

    def __getitem__(self, index: records.Index) -> "LabelledMatches":
        i = records.as_index(index, len(self))
        return self._map(lambda value: value[i])

    def keep(self, mask: Bool[Tensor, "b n"]) -> "LabelledMatches":
        return self.replace(correspondences=self.correspondences.keep(mask))

    def compact(self, multiple: int = 1) -> "LabelledMatches":
        """Matches moved to the front in their order, padding cut to the longest pair (rounded up to `multiple`)."""
        c, mask = self.correspondences.compact(multiple), self.correspondences.mask
        n = c.x0.shape[1]
        order = torch.argsort(mask.logical_not().to(torch.uint8), dim=-1, stable=True)[:, :n]
        return LabelledMatches(c, _padded(records.gathered(self.label, order), n), self.F)

    def reorder(self, order: Int[Tensor, "b m"]) -> "LabelledMatches":
        """The matches in the slots `order` of each pair, in that order."""
        moved = {name: records.gathered(value, order) for name, value in records.slotted(self.correspondences).items()}
        return LabelledMatches(self.correspondences.replace(**moved), records.gathered(self.label, order), self.F)

    def first(self, count: int) -> "LabelledMatches":
        cut = {name: value[:, :count] for name, value in records.slotted(self.correspondences).items()}
        return LabelledMatches(self.correspondences.replace(**cut), self.label[:, :count], self.F)


def collate(items: Sequence[LabelledMatches]) -> LabelledMatches:
    """One padded batch from several, with the optional fields that all have. Raises ValueError for an empty list."""
    c = types.collate([item.correspondences for item in items])
    label = torch.cat([_padded(item.label, c.x0.shape[1]) for item in items])
    return LabelledMatches(c, label, torch.cat([item.F for item in items]))


def _padded(label: Tensor, n: int) -> Tensor:
    return torch.nn.functional.pad(label, (0, max(n - label.shape[1], 0)), value=IGNORED)[:, :n]


def label(dataset: PairDataset, pair: ImagePair, x0: Points, x1: Points, rule: Rule = "pixels") -> Labels:
    """Labels (n,) of the matches x0, x1 (n, 2) of a pair: by depth where the data set offers it and the pair's cameras
    are known, else by the epipolar lines. Raises ValueError for geodesic labels where the cameras are unknown."""
    cameras = (pair.K0, pair.K1, pair.R, pair.t)
    known = all(value is not None for value in cameras)
    K0, K1, R, t = (np.asarray(value) for value in cameras)
    if rule == "geodesic":
        if not known:
            raise ValueError(f"labels=geodesic needs K, R and t, which pair {pair.identity} does not have")
        return by_geodesic(oanet.geodesic(R, t, K0, K1, x0, x1))
    line = line_distance(pair.F, x0, x1)
    if not isinstance(dataset, DepthDataset) or not known:
        return by_line(line)
    depth0, depth1 = (depths(dataset, image, x) for image, x in ((pair.image0, x0), (pair.image1, x1)))
    forward = transfer_error(x0, depth0, x1, K0, K1, R, t)
    return by_transfer(forward, transfer_error(x1, depth1, x0, K1, K0, R.T, -R.T @ t), line)


def by_line(line: NDArray[np.float64]) -> Labels:
    """Labels of matches whose larger distance (n,) to the epipolar lines, or other error, is given in pixels."""
    return np.select([line <= INLIER_PX, line > OUTLIER_PX], [INLIER, OUTLIER], IGNORED).astype(np.int8)


def by_geodesic(distance: NDArray[np.float64]) -> Labels:
    """Labels by OANet's geodesic distance (n,): no match is ignored."""
    return (distance < oanet.GEODESIC).astype(np.int8)


def by_transfer(forward: NDArray[np.float64], backward: NDArray[np.float64], line: NDArray[np.float64]) -> Labels:
    """Labels from the transfer errors (n,) in pixels either way, NaN where the depth is unknown, and `line`.
    Where neither depth is known (the sky) a match far from its line is an outlier, and one near it is ignored."""
    unknown = np.isnan(forward) & np.isnan(backward)
    labels = by_line(np.fmax(forward, backward))
    return np.where(unknown, np.where(line > OUTLIER_PX, OUTLIER, IGNORED), labels).astype(np.int8)


def depths(dataset: DepthDataset, image: ImageSource, x: Points) -> NDArray[np.float64]:
    """The depths (k, n) at points (n, 2) of an image and `EDGE_PX` beside them."""
    return dataset.depth(image, (x[None] + _AROUND[:, None]).reshape(-1, 2)).reshape(len(_AROUND), -1)


def transfer_error(
    x: Points, depth: Points, partner: Points, K: Points, K_other: Points, R: Points, t: Points
) -> NDArray[np.float64]:
    """How far (n,), in pixels, points are carried past their partners in the other image, at the kindest of k depths.
    NaN where no depth is known, infinity where a point would be behind the other camera. x, partner: matched points (n,
    2) in pixels. depth: candidates (k, n), NaN where unknown. K, K_other: calibrations. R, t: ``X_other = R X + t``."""
    rays = np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(K).T
    there = (depth[..., None] * rays @ R.T + t) @ K_other.T
    ahead = there[..., 2] > 0
    at = there[..., :2] / np.where(ahead, there[..., 2], 1.0)[..., None]
    error = np.where(ahead, np.hypot(*np.moveaxis(at - partner, -1, 0)), np.inf)
    return np.where(np.isnan(depth).all(0), np.nan, np.where(np.isnan(depth), np.inf, error).min(0))


MIN_INLIERS = 16  # no crop or ratio threshold that would leave fewer; twice what the eight-point algorithm needs
MIN_MATCHES = 50  # no thinning of outliers below so many matches
_COLUMNS = 32  # random numbers of a pair in an epoch; the last three are keys of numbers for each match
_PER_IMAGE = 7
_ROUNDING = 1e-6  # pixels that a rotated side may exceed a whole number by


class Augmentation(AugmentationOptions):
    """Random changes of a pair's labelled matches, after which the truth is still true.
    The same (seed, key, epoch) gives the same matches, so a training that is resumed sees what it would have seen.
    Matches come out in random order, so the first ones of them are a random subset. None turns a change off."""

    @classmethod
    def none(cls) -> "Augmentation":
        return cls(swap=0, quarter_turn=0, turn=0, crop=0, ratio=None, thin=0, noise=None, matches=None)

    def __call__(
        self, matches: LabelledMatches, *, seed: int, epoch: int = 0, count: int | None = None
    ) -> LabelledMatches:
        """The matches of one pair, a batch of one, changed; at most `count` of them, in place of a random number. seed,
        epoch: with the pair's key select the random numbers. Raises ValueError for a batch of several pairs."""
        if len(matches) != 1:
            raise ValueError(f"an augmentation changes one pair at a time, not a batch of {len(matches)}")
        key = matches.correspondences.keys.cpu()
        draw = _Draw(self, bits(seed, key, Stream.AUGMENTATION, epoch, 1, _COLUMNS)[0, 0])
        out = swap(matches) if draw.swap else matches
        for image in (0, 1):
            if angle := draw.angle(image):
                out = rotate(out, image, angle)
            if sides := draw.crop(image):
                size = out.correspondences.size1 if image else out.correspondences.size0
                if size is None:
                    raise ValueError(f"to crop image {image} its size must be known; this matcher does not give it")
                out = _unless_poor(crop(out, image, _box(size[0].tolist(), *sides)), out)
        if draw.ratio is not None:
            out = _unless_poor(keep_ratio(out, draw.ratio), out)
        out = out.compact()
        n, device = out.label.shape[1], out.label.device
        if draw.share is not None:
            out = out.keep(_thinned(out, draw.share, _order(seed, draw.thinning_key, n).to(device)))
        if draw.sigma > 0:
            step = draw.sigma * torch.special.ndtri(_numbers(seed, draw.noise_key, n, 4)).to(device)
            out = move(out, step[None, :, :2], step[None, :, 2:])
        out = out.reorder(_order(seed, draw.order_key, n).to(device)[None]).compact()
        wanted = draw.count if count is None else count
        return out if wanted is None else out.first(wanted)

    def expected(
        self, ratio: Float[Tensor, " n"] | None, label: Int[Tensor, " n"], *, key: int, seed: int, epoch: int
    ) -> float:
        """About how many matches of a pair are left, for batches of similar length; the effect of crops is a guess.
        ratio, label: of its matches. key, seed, epoch: as of the call. The size of the random subset is left out."""
        draw = _Draw(self, bits(seed, torch.tensor([key]), Stream.AUGMENTATION, epoch, 1, _COLUMNS)[0, 0])
        if draw.ratio is not None and ratio is not None:
            kept = ratio < draw.ratio
            if int((label[kept] == 1).sum()) >= min(MIN_INLIERS, int((label == 1).sum())):
                label = label[kept]
        inliers, outliers = int((label == 1).sum()), int((label == 0).sum())
        ignored: float = len(label) - inliers - outliers
        if draw.share is not None and inliers and outliers:
            before = inliers
            inliers, outliers = thinned_counts(inliers, outliers, draw.share)
            ignored *= inliers / before
        area = math.prod(w * h for w, h, *_ in filter(None, (draw.crop(0), draw.crop(1))))
        return float(area * (inliers + outliers + ignored))


def thinned_counts(inliers: int, outliers: int, share: float) -> tuple[int, int]:
    """How many inliers and outliers to keep so that `share` are inliers, dropping only the one or the other.
    At least `MIN_INLIERS` inliers are kept, and `MIN_MATCHES` matches, where there are so many."""
    if share * (inliers + outliers) < inliers:
        return min(inliers, max(round(outliers * share / (1 - share)), MIN_INLIERS)), outliers
    wanted = round(inliers * (1 - share) / share) if share > 0 else outliers
    return inliers, min(outliers, max(wanted, MIN_MATCHES - inliers))


class _Draw:
    """What an augmentation draws for a pair in an epoch, from 63-bit integers."""

    def __init__(self, a: Augmentation, raw: Int[Tensor, " columns"]) -> None:
        self._a = a
        u = self._u = ((raw >> 10).to(torch.float64) * 2.0**-53).tolist()
        self.thinning_key, self.noise_key, self.order_key = raw[-3:].tolist()
        self.swap = u[0] < a.swap
        self.ratio = None if a.ratio is None else _within(a.ratio, u[1])
        self.share = _within(a.inlier_share, u[3]) if u[2] < a.thin else None
        self.sigma = 0.0 if a.noise is None else _within(a.noise, u[4])
        self.count = None if a.matches is None else subset_size(a.matches, u[5])

    def angle(self, image: int) -> float:
        """The turn of an image in degrees, 0 for none."""
        kind, size = self._of(image)[:2]
        if kind < self._a.quarter_turn:
            return 90.0 * (1 + int(3 * size))
        return self._a.angle * (2 * size - 1) if kind < self._a.quarter_turn + self._a.turn else 0.0

    def crop(self, image: int) -> tuple[float, float, float, float] | None:
        """Width and height of a crop and where it lies, as shares of the image's sides and of what is left of them."""
        u = self._of(image)[2:]
        if u[0] >= self._a.crop:
            return None
        return _within(self._a.crop_side, u[1]), _within(self._a.crop_side, u[2]), u[3], u[4]

    def _of(self, image: int) -> list[float]:
        start = 6 + _PER_IMAGE * image
        return self._u[start : start + _PER_IMAGE]


def subset_size(range_: Sequence[int], u: float) -> int:
    """A whole number in the range, uniform in its logarithm for u uniform in [0, 1)."""
    low, high = range_
    return min(int(low * ((high + 1) / low) ** u), high)


def _within(range_: Range, u: float) -> float:
    return range_[0] + u * (range_[1] - range_[0])


def _box(size: list[int], width: float, height: float, x: float, y: float) -> tuple[int, int, int, int]:
    h, w = size
    wide, high = max(round(width * w), 1), max(round(height * h), 1)
    left, top = round(x * (w - wide)), round(y * (h - high))
    return left, top, left + wide, top + high


def _unless_poor(changed: LabelledMatches, before: LabelledMatches) -> LabelledMatches:
    """`changed`, unless it leaves too few inliers, or no match at all."""
    needed = min(MIN_INLIERS, int(before.inlier.sum()))
    enough = int(changed.inlier.sum()) >= needed and bool(changed.correspondences.mask.any())
    return changed if enough else before


def _thinned(matches: LabelledMatches, share: float, order: Int[Tensor, " n"]) -> Bool[Tensor, "1 n"]:
    label = matches.label[0]
    counts = {value: int((label == value).sum()) for value in (1, 0, -1)}
    if not counts[1] or not counts[0]:
        return torch.ones_like(matches.label, dtype=torch.bool)
    inliers, outliers = thinned_counts(counts[1], counts[0], share)
    wanted = {1: inliers, 0: outliers, -1: round(counts[-1] * inliers / counts[1])}
    shuffled = label[order]
    kept = torch.zeros_like(label, dtype=torch.bool)
    for value, number in wanted.items():
        kept[order[shuffled == value][:number]] = True
    return kept[None]


def _numbers(seed: int, key: int, n: int, columns: int) -> Float[Tensor, "n columns"]:
    return uniform(seed, torch.tensor([key]), Stream.AUGMENTATION, 0, n, columns)[0].clamp(min=2.0**-53)


def _order(seed: int, key: int, n: int) -> Int[Tensor, " n"]:
    return torch.argsort(_numbers(seed, key, n, 1)[:, 0])


def swap(matches: LabelledMatches) -> LabelledMatches:
    """The same matches from image 1 to image 0. `ratio` and `mutual` stay those of the direction that was matched."""
    c = matches.correspondences
    pairs = (("x0", "x1"), ("lafs0", "lafs1"), ("size0", "size1"), ("K0", "K1"))
    swapped = {name: getattr(c, other) for a, b in pairs for name, other in ((a, b), (b, a))}
    return matches.replace(correspondences=c.replace(**swapped), F=matches.F.mT.contiguous())


def rotate(matches: LabelledMatches, image: int, degrees: float | int) -> LabelledMatches:
    """One of the images turned in its plane, from its x axis to its y axis; multiples of 90 degrees are exact.
    The new image is the bounding box of the turned one, its sides rounded up, with the same middle. Raises ValueError
    where the size of the image is not known."""
    size = matches.correspondences.size1 if image else matches.correspondences.size0
    if size is None:
        raise ValueError(f"to turn image {image} its size must be known: size{image}, which this matcher does not give")
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
    box: first column, first row, and past the last ones, in pixels. Raises ValueError for an empty box."""
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
    """The matches whose `ratio` is below `threshold`; 1 keeps all. Raises ValueError for matches without `ratio`."""
    ratio = matches.correspondences.ratio
    if ratio is None:
        raise ValueError("a ratio threshold needs `ratio`: the nearest-neighbour distance ratio of each match")
    return matches if threshold >= 1 else matches.keep(ratio < threshold)


def move(matches: LabelledMatches, step0: Float[Tensor, "b n 2"], step1: Float[Tensor, "b n 2"]) -> LabelledMatches:
    """Points, and their frames with them, moved by so many pixels: the error of a detector."""
    c = matches.correspondences
    changes: dict[str, Tensor] = {"x0": c.x0 + step0.to(c.x0), "x1": c.x1 + step1.to(c.x1)}
    for name, lafs, x in (("lafs0", c.lafs0, changes["x0"]), ("lafs1", c.lafs1, changes["x1"])):
        if lafs is not None:
            changes[name] = torch.cat([lafs[..., :2], x.to(lafs)[..., None]], -1)
    return matches.replace(correspondences=c.replace(**changes))


def transform(matches: LabelledMatches, image: int, T: Float[Tensor, "b 3 3"], size: Tensor) -> LabelledMatches:
    """One of the images mapped by ``x -> T x``, an affine map of pixels that keeps the orientation.
    matches: labelled matches. image: 0 or 1. T: last row (0, 0, 1), float64. size: the new size (h, w), (B, 2)."""
    c = matches.correspondences
    names = {name: f"{name}{image}" for name in ("x", "lafs", "size", "K")}
    x = _mapped(T, getattr(c, names["x"])[..., None])[..., 0]
    changes: dict[str, Tensor] = {names["x"]: x, names["size"]: size}
    lafs, K = getattr(c, names["lafs"]), getattr(c, names["K"])
    if lafs is not None:
        axes = (T[:, None, :2, :2] @ lafs[..., :2].to(T)).to(lafs)
        changes[names["lafs"]] = torch.cat([axes, _mapped(T, lafs[..., 2:])], -1)
    if K is not None:
        changes[names["K"]] = _upper_triangular(T.to(K) @ K)
    inverse = torch.linalg.inv(T).to(matches.F)
    F = inverse.mT @ matches.F if image else matches.F @ inverse
    return matches.replace(correspondences=c.replace(**changes), F=unit_frobenius(F))


def _direction(degrees: float | int) -> tuple[float, float]:
    """Cosine and sine, exact for multiples of 90 degrees."""
    quarters, rest = divmod(degrees, 90.0)
    if rest == 0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))


def _mapped(T: Tensor, points: Tensor) -> Tensor:
    """T applied to points as columns (b, n, 2, 1), computed in float64."""
    return (T[:, None, :2, :2] @ points.to(T) + T[:, None, :2, 2:]).to(points)


def _upper_triangular(K: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 3"]:
    """The calibration of the camera that sees as K does after a rotation about its axis: K = result @ rotation.
    The RQ decomposition of the upper left 2 x 2 part (Golub and Van Loan, section 5.1.8), positive on the diagonal."""
    a, b = K[:, 1, 0], K[:, 1, 1]
    r = torch.hypot(a, b)
    undo = torch.zeros_like(K)
    undo[:, 0, 0] = undo[:, 1, 1] = b / r
    undo[:, 0, 1], undo[:, 1, 0] = a / r, -a / r
    undo[:, 2, 2] = 1
    upper = K @ undo
    upper[:, 1, 0] = 0
    return upper
