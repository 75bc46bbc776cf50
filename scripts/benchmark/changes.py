"""What is done to a pair's matches: windows and lenses; sweeps of one quantity, and conditions that hurt.

Images are not drawn again: the matches of the whole photographs are thinned out, moved or seen through a window. Each
change of the stress test takes a `Case` and gives another, or None where too few right matches would be left.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.spatial
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from fmtorch import find_homography
from fmtorch.core import Correspondences, slotted
from fmtorch.core.lenses import division_lens
from fmtorch.data import ImagePair
from fmtorch.geometry import symmetric_max
from fmtorch.pruning import one_to_one
from fmtorch.training.labelled import LabelledMatches, move, transform

RATIO = 0.8
RIGHT_PX, WRONG_PX = 3.0, 10.0  # from the true epipolar lines in both images, and in one of them
MIN_RIGHT = 15
PLANE_PX = 3.0
INLIER_RATIOS = (0.05, 0.1, 0.2, 0.4, 0.7, 0.95)
MAX_RIGHT = 150  # in the sweep of inlier ratios
NOISES = (0.0, 0.5, 1.0, 2.0, 4.0)  # px
MAX_MATCHES = 500  # in the sweep of noise
COUNTS = (20, 50, 100, 300, 1000, 4000)
DENSE, DENSE_NOISE, PATCH = (500, 2000, 5000, 20_000, 50_000), 0.5, 6.0  # px; of a Gaussian whose pixels err alike
REGIONS, WRONG_REGIONS, WRONG_MOVE = 40, 8, 40.0  # px
VISIBLE = 0.02  # relative difference of depths up to which a point is seen in both images
OFF_PLANE = 0.1  # share of right matches that are left off the plane
WINDOW = 0.6  # of width and height
ZOOM = 2.5


class Case(NamedTuple):
    """A pair with its matches, the right and the wrong told by its true F.
    c: a batch of one, no slot masked. right: (n,), True within RIGHT_PX of the true epipolar lines in both images.
    wrong: (n,), True beyond WRONG_PX in one of them. spare: wrong nearest neighbours that the ratio test took away.
    depth: of points of an image, where the data set knows it."""

    pair: ImagePair
    c: Correspondences
    right: Bool[Tensor, " n"]
    wrong: Bool[Tensor, " n"]
    spare: Correspondences
    depth: Callable[..., NDArray[np.float64]] | None = None

    def subset(self, index: Tensor) -> Case:
        return self._replace(c=taken(self.c, index), right=self.right[index], wrong=self.wrong[index])

    def rng(self, *names: float | str) -> np.random.Generator:
        """Random numbers that depend on the pair and on what they are for."""
        words = [byte for name in names for byte in str(name).encode()]
        return np.random.default_rng([self.pair.key % 2**63, *words])

    def sizes(self) -> list[NDArray[np.float64]]:
        return [np.array(size, np.float64) for size in sizes_of(self.c)]


def case_of(pair: ImagePair, c: Correspondences) -> Case:
    """A case of all nearest neighbours of a pair, a batch of one."""
    assert c.ratio is not None
    passed = c.mask & (c.ratio < RATIO)
    kept = one_to_one(c.x0, c.x1, c.ratio, passed)
    spare = one_to_one(c.x0, c.x1, c.ratio, c.mask & ~passed)
    distance = symmetric_max(torch.from_numpy(pair.F)[None], c.x0.double(), c.x1.double())[0]  # the greater, px
    matches, apart = taken(c, kept[0]), distance[kept[0]]
    return Case(pair, matches, apart < RIGHT_PX, apart > WRONG_PX, taken(c, spare[0] & (distance > WRONG_PX)))


def taken(c: Correspondences, index: Tensor) -> Correspondences:
    """Some matches of a batch of one: a mask or indices."""
    return c.replace(**{name: value[:, index] for name, value in slotted(c).items()})


def parallax(case: Case) -> float:
    """Median distance in image 1 of right matches from where rotation alone has them, in pixels; NaN: unknown."""
    pair = case.pair
    if pair.K0 is None or pair.K1 is None or pair.R is None:
        return float("nan")
    turn = torch.from_numpy(pair.K1 @ pair.R @ np.linalg.inv(pair.K0))
    x = torch.cat([case.c.x0[0].double(), torch.ones(len(case.right), 1, dtype=torch.float64)], -1) @ turn.T
    return float((x[:, :2] / x[:, 2:] - case.c.x1[0].double()).norm(dim=-1)[case.right].median())


def on_plane(case: Case) -> Bool[Tensor, " n"]:
    ends = (x[0, case.right].double() for x in (case.c.x0, case.c.x1))
    estimate = find_homography(*ends, inlier_threshold=PLANE_PX, key=case.pair.key)
    return torch.zeros_like(case.right).masked_scatter(case.right, estimate.inliers[0])


def inlier_ratio(case: Case, ratio: float) -> Case | None:
    """The right matches with as many wrong ones as make this share of inliers; matches that are neither are left out.
    Right ones are as many at every ratio, at most MAX_RIGHT. Wrong ones are first the pair's own, then wrong nearest
    neighbours that the ratio test took away, with distance ratios drawn from those of the pair's own wrong matches."""
    rng, min_ratio = case.rng("inlier ratio"), min(INLIER_RATIOS)
    right, wrong = (rng.permutation(np.flatnonzero(mask.numpy())) for mask in (case.right, case.wrong))
    spare = rng.permutation(case.spare.mask.shape[1])
    most = int((len(wrong) + len(spare)) * min_ratio / (1 - min_ratio))
    right = right[: min(MAX_RIGHT, most)]
    if len(right) < MIN_RIGHT or len(wrong) < 2:
        return None
    count = round(len(right) * (1 - ratio) / ratio)
    own, added = wrong[:count], spare[: max(0, count - len(wrong))]
    kept = case.subset(torch.from_numpy(np.concatenate([right, own])))
    assert case.c.ratio is not None
    drawn = case.c.ratio[:, torch.from_numpy(rng.choice(wrong, len(added)))]
    more = taken(case.spare, torch.from_numpy(added)).replace(ratio=drawn)
    away = torch.zeros(len(added), dtype=torch.bool)
    both = {name: torch.cat([getattr(kept.c, name), value], 1) for name, value in slotted(more).items()}
    labels = torch.cat([kept.right, away]), torch.cat([kept.wrong, ~away])
    return Case(kept.pair, kept.c.replace(**both), *labels, kept.spare)


def noise(case: Case, sigma: float) -> Case | None:
    """Gaussian noise of so many pixels added to every coordinate of the matches, of which at most MAX_MATCHES."""
    rng, n = case.rng("noise"), len(case.right)
    case = case.subset(torch.from_numpy(np.sort(rng.permutation(n)[:MAX_MATCHES])))
    steps = [torch.from_numpy(rng.normal(0, 1, tuple(case.c.x0.shape)) * sigma) for _ in range(2)]
    return case._replace(c=move(labelled(case.pair, case.c), *steps).correspondences)


def match_count(case: Case, count: float) -> Case | None:
    """So many of the matches, chosen at random; a smaller choice is part of a larger one."""
    order = case.rng("count").permutation(len(case.right))
    return case.subset(torch.from_numpy(order[: int(count)])) if len(order) >= count else None


def dense(case: Case, count: int) -> Case | None:
    """So many pixels of image 0 that image 1 sees, by their depth, as a dense matcher gives them; as `match_count`.
    Neighbours err alike; whole regions are wrong and move as one. The score of most wrong ones is below that of most
    right ones."""
    pair, rng = case.pair, case.rng("dense")
    if case.depth is None:
        return None
    K0, K1, R, t = (np.asarray(each) for each in (pair.K0, pair.K1, pair.R, pair.t))
    (h, w), size1 = (size.astype(np.int64) for size in case.sizes())
    errors = scipy.ndimage.gaussian_filter(rng.normal(size=(h, w, 2)), (PATCH, PATCH, 0), mode="wrap").reshape(-1, 2)
    x0 = np.mgrid[:h, :w][::-1].reshape(2, -1).T.astype(np.float64)
    region = scipy.spatial.cKDTree(rng.uniform([0, 0], [w, h], (REGIONS, 2))).query(x0)[1]
    X = np.c_[x0, np.ones(h * w)] @ np.linalg.inv(K0).T * case.depth(pair.image0, x0)[:, None] @ R.T + t
    x1 = (X @ K1.T)[:, :2] / X[:, 2:]
    seen = (np.abs(case.depth(pair.image1, x1) / X[:, 2] - 1) < VISIBLE) & (X[:, 2] > 0)
    moves = rng.normal(0, WRONG_MOVE, (REGIONS, 2)) * (np.arange(REGIONS) < WRONG_REGIONS)[:, None]
    x1 += errors * (DENSE_NOISE / errors.std()) + moves[region]
    kept = rng.permutation(np.flatnonzero(seen & (x1 > 0).all(1) & (x1 < size1[::-1] - 1).all(1)))[:count]
    right = region[kept] >= WRONG_REGIONS
    score = 1 / (1 + np.exp(-rng.normal(np.where(right, 1.5, -1.5), 1.0)))
    fields = {name: torch.from_numpy(v[None]) for name, v in (("x0", x0[kept]), ("x1", x1[kept]), ("score", score))}
    fields |= {name: getattr(case.c, name) for name in ("size0", "size1", "key")}
    c = Correspondences(**fields, mask=torch.ones(1, len(kept), dtype=torch.bool))
    return Case(pair, c, torch.from_numpy(right), torch.from_numpy(~right), case.spare) if len(kept) == count else None


def plane(case: Case) -> Case | None:
    """Right matches off the dominant plane thinned out until they are a tenth of all right ones."""
    inside = on_plane(case)
    off = (case.right & ~inside).nonzero()[:, 0].numpy()
    most = int(inside.sum()) * OFF_PLANE / (1 - OFF_PLANE)
    if int(inside.sum()) < MIN_RIGHT:
        return None
    gone = case.rng("plane off").permutation(off)[round(most) :]
    return case.subset(torch.from_numpy(np.delete(np.arange(len(case.right)), gone)))


Window = tuple[NDArray[np.float64], NDArray[np.float64], float]
"""Of one image: upper left corner (x, y) and new size (h, w), in pixels, and the scale of the new image."""


def crops(case: Case) -> Case | None:
    """Both images cropped to windows of 0.6 of width and height, anywhere."""
    rng = case.rng("crop")
    corners = [np.floor(rng.random(2) * (1 - WINDOW) * size[::-1]) for size in case.sizes()]
    return seen(case, *((at, np.floor(WINDOW * size), 1.0) for at, size in zip(corners, case.sizes(), strict=True)))


def zoomed(case: Case, reduced: bool) -> Case | None:
    """Image 1 cropped at its centre to 1 / ZOOM of its sides; image 0 reduced as much, so that both have one size."""
    size0, size1 = case.sizes()
    first = (np.zeros(2), np.floor(size0 / ZOOM), 1 / ZOOM) if reduced else (np.zeros(2), size0, 1.0)
    return seen(case, first, central(size1, np.floor(size1 / ZOOM)))


def focal_length(case: Case, f: float) -> Case | None:
    """Both images cropped or padded about their centres until their focal lengths are f of the longer sides."""
    pair = case.pair
    if pair.K0 is None or pair.K1 is None:
        return None
    windows = []
    for size, K in zip(case.sizes(), (pair.K0, pair.K1), strict=True):
        now = float(np.sqrt(K[0, 0] * K[1, 1])) / float(size.max())
        windows.append(central(size, np.floor(size * now / f)))
    return seen(case, *windows)


def central(size: NDArray[np.float64], new: NDArray[np.float64]) -> Window:
    """The window of a new size (h, w) about the centre of an image; larger than the image: a border is added."""
    return (size - new)[::-1] / 2, new, 1.0


def seen(case: Case, window0: Window, window1: Window) -> Case | None:
    """The matches inside both windows, in the windows' pixels, with F of these; None: fewer than MIN_RIGHT right."""
    pair, c, inside = windowed(case.pair, case.c, (window0, window1))
    enough = int((case.right & inside).sum()) >= MIN_RIGHT
    return case._replace(pair=pair, c=c).subset(inside) if enough else None


def windowed(
    pair: ImagePair, c: Correspondences, windows: tuple[Window, Window]
) -> tuple[ImagePair, Correspondences, Bool[Tensor, " n"]]:
    """The pair and its matches in the windows' pixels, and which matches are inside both; without cameras."""
    matches, inside = labelled(pair, c.replace(K0=None, K1=None)), c.mask[0]
    for image, (corner, new, scale) in enumerate(windows):
        T = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64))
        T[:2, 2] = torch.from_numpy(scale * (0.5 - corner) - 0.5)  # pixel (0, 0) has its corner at -0.5
        size = torch.from_numpy(new.astype(np.int64))
        matches = transform(matches, image, T[None], size[None])
        x = getattr(matches.correspondences, f"x{image}")[0]
        inside = inside & ((x > -0.5) & (x < size.flip(0) - 0.5)).all(-1)
    pair = dataclasses.replace(pair, F=matches.F[0].numpy(), K0=None, K1=None)
    return pair, matches.correspondences, inside


def labelled(pair: ImagePair, c: Correspondences) -> LabelledMatches:
    """The matches with the true F, in the form that the package changes."""
    return LabelledMatches(c, torch.zeros(c.mask.shape, dtype=torch.int8), torch.from_numpy(pair.F)[None])


def part(
    pair: ImagePair, c: Correspondences, left: float = 0.0, top: float = 0.0, right: float = 1.0, bottom: float = 1.0
) -> tuple[ImagePair, Correspondences]:
    """Both images cropped to a part, in fractions of width and height, with F of the parts."""
    windows = []
    for h, w in sizes_of(c):
        edges = np.round([left * w, top * h, right * w, bottom * h])
        windows.append((edges[:2], (edges[2:] - edges[:2])[::-1], 1.0))
    pair, c, inside = windowed(pair, c, (windows[0], windows[1]))
    return pair, taken(c, inside)


def bent(pair: ImagePair, c: Correspondences, lens: float) -> tuple[ImagePair, Correspondences]:
    """The matches as two lenses of this lambda bend them (`find_fundamental`); F stays that of the pinholes' pixels."""
    moved, inside = {}, c.mask[0]
    for i, (h, w) in enumerate(sizes_of(c)):
        model = division_lens(lens, (h, w))
        x = getattr(c, f"x{i}")[0].double().numpy()
        photographed = torch.from_numpy(model.distort(x))  # NaN beyond what the lens sees
        inside = inside & ((photographed > -0.5) & (photographed < torch.tensor([w, h]) - 0.5)).all(-1)
        moved[f"x{i}"] = photographed[None].to(c.x0)
        if (lafs := getattr(c, f"lafs{i}")) is not None:
            axes = torch.from_numpy(model.derivatives(x) @ lafs[0, ..., :2].double().numpy())
            moved[f"lafs{i}"] = torch.cat([axes, photographed[..., None]], -1)[None].to(lafs)
    return pair, taken(c.replace(**moved), inside)


def sizes_of(c: Correspondences) -> list[list[float]]:
    assert c.size0 is not None
    assert c.size1 is not None
    return [c.size0[0].tolist(), c.size1[0].tolist()]


Change = Callable[[Case], Case | None]
Level = float | str
CONDITIONED = "conditions"
CONDITIONS: dict[Level, Change] = {"as they are": lambda case: case, "one plane": plane, "crops": crops}
CONDITIONS["f 1 : 2.5, one size"] = functools.partial(zoomed, reduced=True)
CONDITIONS["f 1 : 2.5, two sizes"] = functools.partial(zoomed, reduced=False)
CONDITIONS |= {f"f = {f:g}": functools.partial(focal_length, f=f) for f in (0.4, 2.0, 4.0)}
SWEEPS: dict[str, dict[Level, Change]] = {
    "inlier ratio": {ratio: functools.partial(inlier_ratio, ratio=ratio) for ratio in INLIER_RATIOS},
    "noise": {sigma: functools.partial(noise, sigma=sigma) for sigma in NOISES},
    "match count": {float(count): functools.partial(match_count, count=count) for count in COUNTS},
    "dense": {float(count): functools.partial(dense, count=count) for count in DENSE},
    CONDITIONED: CONDITIONS,
}
