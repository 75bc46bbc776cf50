"""Corresponding patches: cut of views of photographs as planes, kept on disk, drawn for training.

The same points are found independently in several views; where a point of one view is in another is known from the
cameras. The viewing angles of its patches say how hard it is to match two of them (Luo et al., GeoDesc, ECCV 2018).
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import json
import multiprocessing
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor, from_numpy

from fmtorch.data.images import read_image
from fmtorch.features import FRAME_SIGMAS, SIFT, DominantGradient, HessianDetector, ImagePyramid
from fmtorch.jit.random import Stream, bits, uniform
from fmtorch.pipeline.photographs import reduced_image
from fmtorch.scenes import PICTURES, Camera, skimage_file
from fmtorch.training import planes
from fmtorch.training.planes import Grey, Matrix, Photograph, PlaneViews

MAX_SIMILARITY = 0.85  # of the photographs of a pair: GeoDesc's authors leave out those that are more alike
CONTEXT_SIZE = 64  # pixels of a stored patch's side: the middle 32 are the frame, of half side `FRAME_SIGMAS` sigma
INTERSECTION_SIGMA, INCIDENCE_SIGMA = 15.0, 20.0  # degrees, sigma_1 and sigma_2 of GeoDesc, section 3.3

Indices = NDArray[np.int64]
Keypoints = Matrix  # (n, 4): x, y, sigma in pixels, angle in radians, x axis towards y axis


class Part(NamedTuple):
    """Patches of points that two or more views of a photograph show, point after point.
    patches: (m, CONTEXT_SIZE, CONTEXT_SIZE). point, view: (m,) the point that each shows, and in which view. rays: (m,
    3) unit directions from the plane to the camera, in the world. incidence: (m,) degrees between ray and normal."""

    patches: NDArray[np.uint8]
    point: Indices
    view: Indices
    rays: NDArray[np.float32]
    incidence: NDArray[np.float32]


class Tolerance(NamedTuple):
    """When keypoints of two views are the same point: distance in sigmas, ratio of scales, angle in degrees.
    Within these bounds a detector's error in position, scale and orientation stays in the patches."""

    distance: float = 0.6
    scale: float = 1.35
    angle: float = 25.0


SAME_PLACE = Tolerance(distance=1.0, scale=1.6, angle=45.0)  # within it two points would be false negatives


class View(NamedTuple):
    """A view, its camera, its keypoints, and where they are in the photograph, with scale and orientation there."""

    image: Grey
    camera: Camera
    keypoints: Keypoints
    there: Keypoints


def detect(image: Grey, count: int) -> Keypoints:
    """The strongest keypoints of DoG and of the determinant of the Hessian, `count` of each, with orientations."""
    dog, _ = SIFT(max_features=count, contrast_threshold=0.02).detect(image)
    blobs, _ = HessianDetector(max_features=count).detect(image)
    lafs = torch.cat([dog, DominantGradient()(ImagePyramid(image), blobs)]).double().numpy()
    sigma = np.hypot(lafs[:, 0, 0], lafs[:, 1, 0]) / FRAME_SIGMAS
    keypoints: Keypoints = np.c_[lafs[..., 2], sigma, np.arctan2(lafs[:, 1, 0], lafs[:, 0, 0])]
    return keypoints


def cut(image: Grey, keypoints: Keypoints) -> NDArray[np.uint8]:
    """Patches (n, CONTEXT_SIZE, CONTEXT_SIZE) of keypoints, turned to their orientation, without aliasing."""
    x, y, half, angle = keypoints.T * np.array([1, 1, FRAME_SIGMAS * CONTEXT_SIZE / 32, 1])[:, None]
    c, s = half * np.cos(angle), half * np.sin(angle)
    lafs = torch.from_numpy(np.stack([c, -s, x, s, c, y], -1).reshape(-1, 2, 3)).float()
    patches = 255 * ImagePyramid(image).extract(lafs, CONTEXT_SIZE)[:, 0]
    return patches.round().clamp(0, 255).to(torch.uint8).numpy()


def near(a: Keypoints, b: Keypoints, tolerance: Tolerance) -> tuple[Indices, Indices, Matrix]:
    """Pairs (indices of a and of b) within the tolerance, and each one's cost, 0 to 2; sigmas are those of `a`."""
    x, y = (np.asarray(a[:, None, k] - b[None, :, k], np.float32) for k in (0, 1))
    i, j = np.nonzero(x * x + y * y <= (tolerance.distance * a[:, 2, None]).astype(np.float32) ** 2)
    distance = np.hypot(a[i, 0] - b[j, 0], a[i, 1] - b[j, 1]) / a[i, 2]
    scale = np.abs(np.log(a[i, 2] / b[j, 2]))
    angle = np.degrees(np.abs((a[i, 3] - b[j, 3] + np.pi) % (2 * np.pi) - np.pi))
    fits = (scale <= np.log(tolerance.scale)) & (angle <= tolerance.angle)
    cost = distance / tolerance.distance + scale / np.log(tolerance.scale)
    return i[fits], j[fits], cost[fits]


def same_point(anchors: Keypoints, detected: Keypoints, tolerance: Tolerance) -> Indices:
    """For each detected keypoint its anchor or -1; pairs are taken in the order of their cost, each keypoint once."""
    owner, taken = np.full(len(detected), -1), np.zeros(len(anchors), bool)
    i, j, cost = near(anchors, detected, tolerance)
    for k in np.argsort(cost, kind="stable"):
        if not taken[i[k]] and owner[j[k]] < 0:
            owner[j[k]], taken[i[k]] = i[k], True
    return owner


def in_photograph(keypoints: Keypoints, H: Matrix) -> Keypoints:
    """Keypoints of a view at their places in the photograph, of which H is the homography to the view."""
    back: Matrix = np.asarray(np.linalg.inv(H), np.float64)
    place = np.c_[keypoints[:, :2], np.ones(len(keypoints))] @ back.T
    A = planes.local_affine(back, keypoints[:, :2])
    direction = A @ np.stack([np.cos(keypoints[:, 3]), np.sin(keypoints[:, 3])], -1)[..., None]
    sigma = keypoints[:, 2] * np.sqrt(np.abs(np.linalg.det(A)))
    there: Keypoints = np.c_[place[:, :2] / place[:, 2:], sigma, np.arctan2(direction[:, 1, 0], direction[:, 0, 0])]
    return there


def views_of(image: NDArray[np.uint8], rng: np.random.Generator, limits: PlaneViews, points: int) -> list[View]:
    """Views of an RGB or grey photograph as a plane, in changed light, with the strongest `points` of each detector.
    Keypoints where the plane shows the mirror image of the photograph, beyond its edges, are left out."""
    grey = planes.grey_of(rng, image)
    sides = np.array(grey.shape[::-1])
    views = []
    for _ in range(limits.views):
        camera = planes.random_camera(rng, grey.shape[:2], limits)
        H = planes.plane_homography(camera, grey.shape[:2])
        picture = planes.change_camera(rng, planes.warp(planes.change_light(rng, grey), H, camera.size))
        keypoints = detect(picture, points)
        there = in_photograph(keypoints, H)
        inside = ((there[:, :2] >= 0) & (there[:, :2] <= sides - 1)).all(1)
        views.append(View(picture, camera, keypoints[inside], there[inside]))
    return views


def tracks(views: Sequence[View], tolerance: Tolerance) -> Part:
    parts = []
    for i, (view, owner) in enumerate(zip(views, linked([view.there for view in views], tolerance), strict=True)):
        shown = np.flatnonzero(owner >= 0)
        keypoints = view.keypoints[shown]
        rays, incidence = (angles.astype(np.float32) for angles in rays_and_incidence(keypoints, view.camera))
        parts.append(Part(cut(view.image, keypoints), owner[shown], np.full(len(shown), i), rays, incidence))
    every = Part(*map(np.concatenate, zip(*parts, strict=True)))
    several = np.bincount(every.point) >= 2
    kept = np.flatnonzero(several[every.point])
    order = kept[np.argsort(every.point[kept], kind="stable")]
    every = Part._make(column[order] for column in every)
    return every._replace(point=(np.cumsum(several) - 1)[every.point])


def linked(views: Sequence[Keypoints], tolerance: Tolerance) -> list[Indices]:
    """For every keypoint of every view, at its place in the photograph, the point that it shows, -1 for none.
    A keypoint shows a point of the views before, or where none is near becomes one; those that nearly repeat an earlier
    one of the same view are left out, since they would be false negatives."""
    owners, points = [], np.zeros((0, 4))
    for keypoints in views:
        owner = same_point(points, keypoints, tolerance)
        free = owner < 0
        free[near(points, keypoints, SAME_PLACE)[1]] = False
        for earlier, later in zip(*near(keypoints, keypoints, SAME_PLACE)[:2], strict=True):
            if earlier < later and free[earlier]:
                free[later] = False
        owner[free] = len(points) + np.arange(free.sum())
        owners.append(owner)
        points = np.r_[points, keypoints[free]]
    return owners


def rays_and_incidence(keypoints: Keypoints, camera: Camera) -> tuple[Matrix, Matrix]:
    """Unit directions (n, 3) from the plane z = 0 to its camera at z < 0, and degrees (n,) to its normal."""
    rays = np.c_[keypoints[:, :2], np.ones(len(keypoints))] @ np.linalg.inv(camera.K).T @ camera.R
    rays /= -np.linalg.norm(rays, axis=1, keepdims=True)
    return rays, np.degrees(np.arccos(np.clip(-rays[:, 2], 0.0, 1.0)))


def patch_similarity(rays0: Matrix, rays1: Matrix, incidence0: Matrix, incidence1: Matrix) -> Matrix:
    """S_patch (section 3.3): g(intersection angle, 15 degrees) g(difference of incidence angles, 20 degrees).
    g(a, s) = exp(-a^2 / (2 s^2)). The intersection angle is that between the two viewing rays at the point, unit
    directions (n, 3) to each camera; incidence: degrees (n,) between ray and surface normal. 1: one viewpoint."""
    cross = np.linalg.norm(np.cross(rays0, rays1), axis=1)
    intersection = np.degrees(np.arctan2(cross, (rays0 * rays1).sum(1))).astype(np.float64)
    difference = (incidence0 - incidence1).astype(np.float64)
    similarity: Matrix = np.exp(-((intersection / INTERSECTION_SIGMA) ** 2 + (difference / INCIDENCE_SIGMA) ** 2) / 2)
    return similarity


@dataclasses.dataclass(frozen=True, eq=False)
class PatchStore:
    """Patches of points seen in two or more views, sorted by point.
    patches: (m, CONTEXT_SIZE, CONTEXT_SIZE) uint8. first: (n + 1,) where each point's patches begin. view, rays,
    incidence: as of a `Part`, views numbered through. description: how they were made, for the model card."""

    patches: NDArray[np.uint8]
    first: NDArray[np.int64]
    view: NDArray[np.int64]
    rays: NDArray[np.float32]
    incidence: NDArray[np.float32]
    description: dict[str, Any]

    @classmethod
    def open(cls, folder: Path | str) -> PatchStore:
        """A store that `build_store` has written; FileNotFoundError where there is none."""
        folder = Path(folder)
        if not (folder / "store.json").is_file():
            raise FileNotFoundError(f"{folder} holds no patches (store.json is absent)")
        stored = np.memmap(folder / "patches.raw", np.uint8, "r").reshape(-1, CONTEXT_SIZE, CONTEXT_SIZE)
        with np.load(folder / "geometry.npz") as geometry:
            return cls(stored, **geometry, description=json.loads((folder / "store.json").read_text()))

    def __len__(self) -> int:
        return len(self.first) - 1

    def views(self, points: Int[Tensor, " b"], draws: Float[Tensor, "b 2"]) -> Float[Tensor, "2 b 1 h w"]:
        """Two different patches of each point in [0, 1], chosen by two random numbers in [0, 1)."""
        start = from_numpy(self.first)[points]
        count = from_numpy(self.first)[points + 1] - start
        first = (draws[:, 0] * count).long()
        other = (draws[:, 1] * (count - 1)).long()
        return self.pairs(torch.stack([start + first, start + other + (other >= first)]))

    def pairs(self, index: Int[Tensor, "2 b"]) -> Float[Tensor, "2 b 1 h w"]:
        return from_numpy(np.asarray(self.patches[index.numpy()])).unsqueeze(2).float() / 255


@functools.lru_cache(maxsize=32)
def order(seed: int, key: int, total: int) -> Int[Tensor, " n"]:
    """The numbers below `total` in a random order of this seed and key."""
    return bits(seed, torch.tensor([key]), Stream.TRAINING, 0, total, 1).flatten().argsort(stable=True)


def validation_pairs(store: PatchStore, count: int, seed: int = 0) -> Float[Tensor, "2 n 1 h w"]:
    """Two patches each of up to `count` points of a store, in random order: always the same for one seed."""
    points = order(seed, 0, len(store))[:count]
    return store.views(points, uniform(seed + 1, torch.tensor([0]), Stream.TRAINING, 0, len(points), 2)[0])


@dataclasses.dataclass(frozen=True, eq=False)
class MatchSets:
    """The matches of pairs of photographs, set after set (Luo et al., GeoDesc, ECCV 2018, section 3.4).
    A loss then compares patches of one pair of photographs, as when a descriptor is used. patches: (2, k) indices of
    the two patches of each match. similarity: (k,) its S_patch. first: (s + 1,) where each set begins."""

    patches: NDArray[np.int64]
    similarity: NDArray[np.float64]
    first: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.first) - 1


def match_sets(store: PatchStore, matches: int, max_similarity: float = MAX_SIMILARITY) -> MatchSets:
    """The sets of pairs of photographs that share at least `matches` points and are not more alike than allowed.
    S_image, the similarity of two photographs, is the mean S_patch of their shared points (section 3.3). In the order
    of the photographs, then of the points. Raises ValueError where no pair is left."""
    pairs = _pairs_of_points(store.first)
    pairs = np.where(store.view[pairs[0]] > store.view[pairs[1]], pairs[::-1], pairs)
    a, b = pairs = pairs[:, np.lexsort((pairs[0], *store.view[pairs][::-1]))]
    similarity = patch_similarity(store.rays[a], store.rays[b], store.incidence[a], store.incidence[b])
    begins = np.flatnonzero(np.r_[True, (np.diff(store.view[pairs]) != 0).any(0)][: len(a)])
    counts = np.diff(np.r_[begins, len(a)])
    image = np.add.reduceat(similarity, begins) / counts if len(begins) else np.zeros(0)
    kept = (counts >= matches) & (image <= max_similarity)
    if not kept.any():
        lacking = f"no pair of photographs shares {matches} points and has a similarity of at most {max_similarity}"
        raise ValueError(f"{lacking}: lower match_sets.matches, or cut more points")
    of_kept = np.repeat(kept, counts)
    return MatchSets(pairs[:, of_kept], similarity[of_kept], np.r_[0, np.cumsum(counts[kept])])


def _pairs_of_points(first: NDArray[np.int64]) -> NDArray[np.int64]:
    counts = np.diff(first)
    parts = [np.zeros((2, 0), np.int64)]
    for length in np.unique(counts[counts >= 2]):
        i, j = np.triu_indices(length, 1)
        start = first[:-1][counts == length][:, None]
        parts.append(np.stack([(start + i).ravel(), (start + j).ravel()]))
    return np.concatenate(parts, axis=1)


class Cutting(NamedTuple):
    """How patches are cut of photographs as planes.
    points: strongest of each detector. longest_side: pixels, to which larger photographs are reduced."""

    planes: PlaneViews
    points: int
    tolerance: Tolerance = Tolerance()
    longest_side: int = 1024

    def patches_of(self, job: tuple[Photograph, tuple[int, int]]) -> Part:
        """The patches of a photograph, by a seed."""
        photograph, seed = job
        cv2.setNumThreads(1)
        image, _ = reduced_image(read_image(photograph.path), self.longest_side)
        views = views_of(image, np.random.default_rng(seed), self.planes, self.points)
        return tracks(views, self.tolerance)


def build_store(
    folder: Path, photographs: Sequence[Photograph], cutting: Cutting, seed: int, workers: int = 1
) -> PatchStore:
    """Cut corresponding patches from photographs into `folder`, which appears once it is complete.
    Those of a photograph depend on the seed and its place in the list alone. Raises FileExistsError."""
    if folder.exists():
        raise FileExistsError(f"{folder} exists; delete it to cut the patches again")
    description = {
        "photographs": dict(collections.Counter(each.source for each in photographs)), "seed": seed,
        "views": cutting.planes.views, "limits": dataclasses.asdict(cutting.planes),
        "tolerance": cutting.tolerance._asdict(),
    }  # fmt: skip
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}") as temporary:
        unfinished = Path(temporary) / folder.name
        unfinished.mkdir()
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            jobs = [(photograph, (seed, i)) for i, photograph in enumerate(photographs)]
            _write(unfinished, pool.imap(cutting.patches_of, jobs), description)
        unfinished.rename(folder)
    return PatchStore.open(folder)


def _write(folder: Path, parts: Iterable[Part], description: dict[str, Any]) -> None:
    """The files of a store; the numbers of points and patches are told in the description."""
    first, total, views = [np.zeros(1, np.int64)], 0, 0
    columns = collections.defaultdict[str, list[NDArray[Any]]](list)
    with open(folder / "patches.raw", "wb") as raw:
        for part in parts:
            raw.write(part.patches.tobytes())
            first.append(total + np.cumsum(np.bincount(part.point)))
            for name, column in (("view", part.view + views), ("rays", part.rays), ("incidence", part.incidence)):
                columns[name].append(column)
            total, views = total + len(part.patches), views + 1 + int(part.view.max(initial=-1))
    geometry: Any = {name: np.concatenate(arrays) for name, arrays in columns.items()}
    np.savez(folder / "geometry.npz", first=np.concatenate(first), **geometry)
    counts = {"points": sum(map(len, first)) - 1, "patches": total}
    (folder / "store.json").write_text(json.dumps({**counts, **description}, indent=1))


def package_photographs() -> list[Photograph]:
    """Those that the scikit-image package brings, of the side that rendered training scenes use."""
    return [Photograph(skimage_file(name), "scikit-image") for name in PICTURES["train"]]


def split(photographs: Sequence[Photograph], held_out: Sequence[str]) -> tuple[list[Photograph], list[Photograph]]:
    """Training and validation photographs; ValueError where a held-out source does not exist or nothing is left."""
    known = {photograph.source for photograph in photographs}
    if unknown := sorted(set(held_out) - known):
        raise ValueError(f"held_out names {', '.join(unknown)}; the sources are {', '.join(sorted(known))}")
    train, validation = ([p for p in photographs if (p.source in held_out) is side] for side in (False, True))
    if not train or not validation:
        raise ValueError("held_out must leave sources on both sides: training and validation")
    return train, validation
