"""The matches that the stress test starts from: each pair's own, the right and the wrong told by its true F."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor

from fmtorch import presets
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import ImagePair
from fmtorch.evaluation.run import select
from fmtorch.geometry.epipolar import symmetric_max
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.pruning.filters import one_to_one
from scripts.benchmark.matched import console, sets_of

Array = NDArray[Any]
RATIO = 0.8
RIGHT_PX, WRONG_PX = 3.0, 10.0  # from the true epipolar lines in both images, and in one of them
MIN_RIGHT = 15
PLANE_PX = 3.0
UNIT_PX = 300.0  # in which homographies are computed
IMAGES = 256  # whose features are kept, some 5 MB each


@dataclasses.dataclass(frozen=True)
class Case:
    """A pair with its matches.

    c: a batch of one, no slot masked. right: (n,), True within RIGHT_PX of the true epipolar lines in both images.
    wrong: (n,), True beyond WRONG_PX in one of them. spare: wrong nearest neighbours that the ratio test took away.
    """

    pair: ImagePair
    c: Correspondences
    right: Bool[Tensor, " n"]
    wrong: Bool[Tensor, " n"]
    spare: Correspondences

    def subset(self, index: Tensor) -> Case:
        """Some of the matches: a mask or indices."""
        return dataclasses.replace(self, c=taken(self.c, index), right=self.right[index], wrong=self.wrong[index])

    def rng(self, *names: float | str) -> np.random.Generator:
        """Random numbers that depend on the pair and on what they are for."""
        words = [byte for name in names for byte in str(name).encode()]
        return np.random.default_rng([self.pair.key % 2**63, *words])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `load`."""
    parser.add_argument("--root", action="append", default=[], help="a set in the FM-Bench layout; may be repeated")
    parser.add_argument("--rendered", choices=["small", "full"], help="also the embedded data set, of this size")
    parser.add_argument("--split", default="test", help="of --rendered: test or train")
    parser.add_argument("--limit", type=int, default=20, help="pairs of each real family at most, chosen by hash")
    parser.add_argument("--rendered-limit", type=int, default=10, help="pairs of each rendered family at most")


def load(arguments: argparse.Namespace) -> Iterator[Case]:
    """The pairs that are asked for, with the SIFT matches that pass the ratio test, one at each keypoint location."""
    families: dict[str, list[ImagePair]] = {}
    for dataset in sets_of(arguments):
        limit = arguments.rendered_limit if dataset.name == "rendered" else arguments.limit
        for pair in select([dataset[i] for i in range(len(dataset))], limit):
            families.setdefault(pair.family, []).append(pair)
    turns = itertools.zip_longest(*families.values())  # an interrupted run has some of each family
    pairs = [pair for turn in turns for pair in turn if pair is not None]
    sift, nearest = presets.build("features", "sift"), presets.build("matcher", "nearest")
    front = Pipeline(sift, nearest, {}, _no_estimator, memory=IMAGES)
    for pair in track(pairs, "pairs", console=console):
        matches = front.correspondences([pair])[0].correspondences
        if matches is not None:
            case = case_of(pair, matches)
            if int(case.right.sum()) >= MIN_RIGHT:
                yield case


def case_of(pair: ImagePair, c: Correspondences) -> Case:
    """A case of all nearest neighbours of a pair, a batch of one."""
    assert c.quality is not None
    passed = c.mask & (c.quality < RATIO)
    kept = one_to_one(c.x0, c.x1, c.quality, passed)
    spare = one_to_one(c.x0, c.x1, c.quality, c.mask & ~passed)
    distance = distances(pair.F, c)
    matches, apart = taken(c, kept[0]), distance[kept[0]]
    return Case(pair, matches, apart < RIGHT_PX, apart > WRONG_PX, taken(c, spare[0] & (distance > WRONG_PX)))


def taken(c: Correspondences, index: Tensor) -> Correspondences:
    """Some matches of a batch of one: a mask or indices."""
    slots = {name: getattr(c, name) for name in c.per_slot if getattr(c, name) is not None}
    return c.replace(**{name: value[:, index] for name, value in slots.items()})


def distances(F: NDArray[np.float64], c: Correspondences) -> Float[Tensor, " n"]:
    """The greater distance of each match to its true epipolar lines, in pixels."""
    matrix = torch.from_numpy(F)[None]
    return symmetric_max(matrix, c.x0.double(), c.x1.double())[0]


def rotated(case: Case) -> Float[Tensor, "n 2"] | None:
    """Where the matches' points of image 0 would be in image 1 if the camera had only turned; None without cameras."""
    pair = case.pair
    if pair.K0 is None or pair.K1 is None or pair.R is None:
        return None
    turn = torch.from_numpy(pair.K1 @ pair.R @ np.linalg.inv(pair.K0))
    x = torch.cat([case.c.x0[0].double(), torch.ones(len(case.right), 1, dtype=torch.float64)], -1) @ turn.T
    return x[:, :2] / x[:, 2:]


def parallax(case: Case) -> float:
    """Median distance in image 1 of right matches from where rotation alone has them, in pixels; NaN: unknown."""
    predicted = rotated(case)
    if predicted is None:
        return float("nan")
    return float((predicted - case.c.x1[0].double()).norm(dim=-1)[case.right].median())


def on_plane(case: Case, samples: int = 500) -> Bool[Tensor, " n"]:
    """The right matches within PLANE_PX of the homography that holds for most of them, (n,)."""
    index = case.right.nonzero()[:, 0]
    points = torch.cat([case.c.x0[0, index], case.c.x1[0, index]], -1).double().numpy()
    drawn = case.rng("plane").random((samples, len(index))).argsort(-1)[:, :4]
    near = transfer_squared(homographies(points[drawn]), points) < PLANE_PX**2
    inside = near[near.sum(-1).argmax()]
    for _ in range(3):
        refined = transfer_squared(homographies(points[inside][None]), points)[0] < PLANE_PX**2
        if refined.sum() < inside.sum():
            break
        inside = refined
    mask = torch.zeros_like(case.right)
    mask[index[torch.from_numpy(inside)]] = True
    return mask


def homographies(points: Array) -> Array:
    """Of least algebraic error, of k sets of n matches (k, n, 4): the normalised DLT (Hartley & Zisserman, 4.2)."""
    centre = points.mean(1, keepdims=True)
    h0, h1 = (np.insert(x, 2, 1.0, axis=-1) for x in np.split((points - centre) / UNIT_PX, 2, axis=-1))
    zero = np.zeros_like(h0)
    rows = [np.concatenate([zero, -h0, h1[..., 1:2] * h0], -1), np.concatenate([h0, zero, -h1[..., :1] * h0], -1)]
    H = np.linalg.svd(np.concatenate(rows, 1))[2][:, -1].reshape(-1, 3, 3)
    T0, T1 = (np.broadcast_to(np.eye(3), H.shape).copy() for _ in range(2))
    T0[:, :2, 2], T1[:, :2, 2] = -centre[:, 0, :2], -centre[:, 0, 2:]
    unit = np.diag([1 / UNIT_PX, 1 / UNIT_PX, 1])
    result: Array = np.linalg.inv(unit @ T1) @ H @ (unit @ T0)
    return result


def transfer_squared(H: Array, points: Array) -> Array:
    """The greater of the squared distances from H x0 to x1 and from H^-1 x1 to x0: (k, n), of points (n, 4)."""

    def distance(H: Array, x: Array, y: Array) -> Array:
        mapped = np.insert(x, 2, 1.0, axis=-1) @ H.transpose(0, 2, 1)
        squared: Array = np.square(mapped[..., :2] / mapped[..., 2:] - y).sum(-1)
        return squared

    with np.errstate(all="ignore"):
        there, back = (
            distance(H, points[:, :2], points[:, 2:]),
            distance(np.linalg.pinv(H).astype(np.float64), points[:, 2:], points[:, :2]),
        )
    greater: Array = np.maximum(there, back)
    return greater


def _no_estimator(c: Correspondences, seed: int = 0) -> Estimate:
    raise NotImplementedError("matches alone are asked for")
