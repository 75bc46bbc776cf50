"""Patches whose points have known geometry: from rendered scenes, and from photographs seen as planes."""

from __future__ import annotations

import dataclasses
import itertools
import multiprocessing
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.data.images import read_image
from fmtorch.scenes.generate import Task
from fmtorch.training.correspondences import Tolerance, cut_context, detect, in_order_of_points
from fmtorch.training.match_sets import Tracks
from fmtorch.training.patch_store import PatchStore, count_by, write_store
from fmtorch.training.photographs import Photograph
from fmtorch.training.planes import PlaneViews, plane_homography, random_camera
from fmtorch.training.scenes import View, linked, views_of_scene
from fmtorch.training.track_geometry import rays_and_incidence
from fmtorch.training.warps import change_camera, change_light, grey_of, warp

Part = tuple[NDArray[np.uint8], NDArray[np.int64], dict[str, NDArray[Any]]]


@dataclasses.dataclass(frozen=True)
class TrackStore(PatchStore):
    """A `PatchStore` with the geometry of each patch."""

    tracks: Tracks

    @classmethod
    def open(cls, folder: Path | str) -> TrackStore:
        """A store that `build_track_store` has written; FileNotFoundError where there is none or without geometry."""
        store = PatchStore.open(folder)
        files = [Path(folder) / f"{name}.npy" for name in Tracks._fields[1:]]
        missing = [file.name for file in files if not file.is_file()]
        if missing:
            raise FileNotFoundError(f"{folder} holds patches without geometry ({', '.join(missing)} is absent)")
        tracks = Tracks(store.first, *(np.load(file) for file in files))
        return cls(store.patches, store.first, store.description, tracks)


def build_track_store(
    folder: Path | str,
    photographs: Sequence[Photograph],
    *,
    seed: int,
    points: int,
    planes: PlaneViews,
    tolerance: Tolerance,
    longest_side: int = 1024,
    scenes: Sequence[Task] = (),
    workers: int = 1,
) -> TrackStore:
    """Cut the tracks of rendered scenes and of photographs seen as planes into `folder`.

    points: strongest keypoints of each detector in each view. The rest as `patch_store.build_store`; a photograph's
    tracks depend on the seed and its place in the list alone, a scene's on the seed and the scene.
    Raises FileExistsError if the folder exists.
    """
    folder = Path(folder)
    if folder.exists():
        raise FileExistsError(f"{folder} exists; delete it to cut the patches again")
    common = {"points": points, "tolerance": tolerance}
    plane_jobs = [
        (photograph.path, (seed, i), {"longest_side": longest_side, "planes": planes, **common})
        for i, photograph in enumerate(photographs)
    ]
    scene_jobs = [(task, (seed, len(photographs) + i), common) for i, task in enumerate(scenes)]
    description = {
        "photographs": count_by(photograph.source for photograph in photographs),
        "scenes": count_by(task.family for task in scenes), "seed": seed, "views": planes.views,
        "limits": dataclasses.asdict(planes), "tolerance": dataclasses.asdict(tolerance),
    }  # fmt: skip
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        cutting = itertools.chain(pool.imap(_tracks_of_plane, plane_jobs), pool.imap(_tracks_of_scene, scene_jobs))
        write_store(folder, _renumbered(cutting), description)
    return TrackStore.open(folder)


def tracks_of_views(views: Sequence[View], tolerance: Tolerance) -> Part:
    """The patches of the points that two or more views show, the point of each, and the columns of `Tracks`."""
    owners = linked(views, tolerance)
    shown = [np.flatnonzero(owner >= 0) for owner in owners]
    order, point = in_order_of_points(np.concatenate([o[i] for o, i in zip(owners, shown, strict=True)]))
    patches, rays, incidence = [], [], []
    for view, mine in zip(views, shown, strict=True):
        patches.append(cut_context(view.image, view.keypoints[mine]))
        ray, angle = rays_and_incidence(view.keypoints[mine], view)
        rays.append(ray.astype(np.float32))
        incidence.append(angle.astype(np.float32))
    number = np.repeat(np.arange(len(views)), [len(mine) for mine in shown])
    columns: dict[str, NDArray[Any]] = {
        "view": number[order], "rays": np.concatenate(rays)[order], "incidence": np.concatenate(incidence)[order],
    }  # fmt: skip
    return np.concatenate(patches)[order], point, columns


def views_of_plane(
    image: NDArray[np.uint8], rng: np.random.Generator, *, planes: PlaneViews, points: int
) -> list[View]:
    """Views of an RGB or grey photograph as a plane, in changed light, with their inverse depth and keypoints."""
    grey = grey_of(rng, image)
    h, w = grey.shape
    views = []
    for _ in range(planes.views):
        camera = random_camera(rng, (h, w), planes)
        picture = warp(change_light(rng, grey), plane_homography(camera, (h, w)), camera.size)
        picture = change_camera(rng, picture)
        y, x = np.mgrid[: camera.size[0], : camera.size[1]].astype(np.float64)
        to_plane = np.linalg.inv(camera.K).T @ camera.R[:, 2] / -camera.centre[2]  # inverse depth of the plane z = 0
        inverse_depth = np.maximum(0.0, to_plane[0] * x + to_plane[1] * y + to_plane[2])
        views.append(View(picture, camera, inverse_depth, detect(picture, points)))
    return views


def _tracks_of_plane(job: tuple[Path, tuple[int, int], dict[str, Any]]) -> tuple[Part, int]:
    """What a worker does: one photograph's tracks, and the number of views."""
    path, seed, options = job
    cv2.setNumThreads(1)
    image = read_image(path)
    scale = min(1.0, options["longest_side"] / max(image.shape[:2]))
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    views = views_of_plane(image, np.random.default_rng(seed), planes=options["planes"], points=options["points"])
    return tracks_of_views(views, options["tolerance"]), len(views)


def _tracks_of_scene(job: tuple[Task, tuple[int, int], dict[str, Any]]) -> tuple[Part, int]:
    """What a worker does: one scene's tracks, and the number of views."""
    task, seed, options = job
    cv2.setNumThreads(1)
    views = views_of_scene(task, np.random.default_rng(seed), points=options["points"])
    return tracks_of_views(views, options["tolerance"]), len(views)


def _renumbered(parts: Iterable[tuple[Part, int]]) -> Iterator[Part]:
    """Parts whose views are numbered through."""
    before = 0
    for (patches, point, columns), views in parts:
        yield patches, point, {**columns, "view": columns["view"] + before}
        before += views
