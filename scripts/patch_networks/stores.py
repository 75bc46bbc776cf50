"""Corresponding patches on disk: a memory-mapped array of bytes, which point each patch shows, and its geometry."""

from __future__ import annotations

import collections
import dataclasses
import json
import multiprocessing
import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.data.images import read_image
from fmtorch.jit import random
from fmtorch.jit.random import Stream
from fmtorch.scenes.dataset import Task
from fmtorch.scenes.surfaces import PICTURES, skimage_file
from fmtorch.training.planes import Photograph, PlaneViews
from scripts.patch_networks import patches as patches_module
from scripts.patch_networks.patches import CONTEXT_SIZE, Part, Tolerance, Warps


class Tracks(NamedTuple):
    """The geometry of patches of points, sorted by point.

    first: (n + 1,) where each point's patches begin. view: (m,) the photograph of each patch. rays: (m, 3) unit
    directions from the surface to its camera, in the world. incidence: (m,) degrees between ray and surface normal.
    """

    first: NDArray[np.int64]
    view: NDArray[np.int64]
    rays: NDArray[np.float32]
    incidence: NDArray[np.float32]


@dataclasses.dataclass(frozen=True, eq=False)
class PatchStore:
    """Patches of points seen in two or more views.

    patches: (m, CONTEXT_SIZE, CONTEXT_SIZE) uint8, sorted by point. first: (n + 1,) where each point's patches begin.
    description: how they were made, for the model card. tracks: their geometry, where it is known.
    """

    patches: NDArray[np.uint8]
    first: NDArray[np.int64]
    description: dict[str, Any]
    tracks: Tracks | None = None

    @classmethod
    def open(cls, folder: Path | str) -> PatchStore:
        """A store that `build_store` has written; FileNotFoundError where there is none."""
        folder = Path(folder)
        if not (folder / "store.json").is_file():
            raise FileNotFoundError(f"{folder} holds no patches (store.json is absent)")
        first, description = np.load(folder / "first.npy"), json.loads((folder / "store.json").read_text())
        tracks = None
        if (folder / "rays.npy").is_file():
            tracks = Tracks(first, *(np.load(folder / f"{name}.npy") for name in Tracks._fields[1:]))
        return cls(np.load(folder / "patches.npy", mmap_mode="r"), first, description, tracks)

    def __len__(self) -> int:
        return len(self.first) - 1

    def views(self, points: Int[Tensor, " b"], draws: Float[Tensor, "b 2"]) -> Float[Tensor, "2 b 1 h w"]:
        """Two different patches of each point in [0, 1], chosen by two random numbers in [0, 1)."""
        start = torch.from_numpy(self.first)[points]
        count = torch.from_numpy(self.first)[points + 1] - start
        first = (draws[:, 0] * count).long()
        other = (draws[:, 1] * (count - 1)).long()
        return self.pairs(torch.stack([start + first, start + other + (other >= first)]))

    def pairs(self, index: Int[Tensor, "2 b"]) -> Float[Tensor, "2 b 1 h w"]:
        """Patches by their indices, in [0, 1]."""
        return torch.from_numpy(np.asarray(self.patches[index.numpy()])).unsqueeze(2).float() / 255


def validation_pairs(store: PatchStore, count: int, seed: int = 0) -> Float[Tensor, "2 n 1 h w"]:
    """Two patches each of up to `count` points of a store, in random order: always the same for one seed."""
    key = torch.zeros(1, dtype=torch.int64)
    points = random.bits(seed, key, Stream.TRAINING, 0, len(store), 1).flatten().argsort(stable=True)[:count]
    return store.views(points, random.uniform(seed + 1, key, Stream.TRAINING, 0, len(points), 2)[0])


@dataclasses.dataclass(frozen=True)
class Cutting:
    """How patches are cut: of photographs as warps or as planes, whose geometry is kept.

    points: strongest of each detector. longest_side: pixels, to which larger photographs are reduced.
    """

    views: Warps | PlaneViews
    points: int
    tolerance: Tolerance = dataclasses.field(default_factory=Tolerance)
    longest_side: int = 1024

    def patches_of(self, source: Path | Task, seed: tuple[int, int]) -> Part:
        """The patches of a photograph or of a rendered scene."""
        cv2.setNumThreads(1)
        rng = np.random.default_rng(seed)
        if isinstance(source, Task):
            views = patches_module.views_of_scene(source, rng, self.points)
            patches, point, geometry = patches_module.tracks_of_views(views, self.tolerance)
            return patches, point, geometry if isinstance(self.views, PlaneViews) else {}
        image = read_image(source)
        scale = self.longest_side / max(image.shape[:2])
        if scale < 1:
            image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        if isinstance(self.views, PlaneViews):
            views = patches_module.views_of_plane(image, rng, self.views, self.points)
            return patches_module.tracks_of_views(views, self.tolerance)
        return patches_module.patches_of_warps(image, rng, self.views, self.points, self.tolerance)


def build_store(
    folder: Path | str,
    photographs: Sequence[Photograph],
    cutting: Cutting,
    *,
    seed: int,
    scenes: Sequence[Task] = (),
    workers: int = 1,
) -> PatchStore:
    """Cut corresponding patches from photographs and rendered scenes into `folder`, which appears once it is complete.

    The patches of a photograph or scene depend on the seed and its place in the lists alone.
    Raises FileExistsError if the folder exists.
    """
    folder = Path(folder)
    if folder.exists():
        raise FileExistsError(f"{folder} exists; delete it to cut the patches again")
    sources: list[Path | Task] = [*(photograph.path for photograph in photographs), *scenes]
    description = {
        "photographs": dict(collections.Counter(photograph.source for photograph in photographs)),
        "scenes": dict(collections.Counter(task.family for task in scenes)), "seed": seed,
        "views": cutting.views.views, "limits": dataclasses.asdict(cutting.views),
        "tolerance": dataclasses.asdict(cutting.tolerance),
    }  # fmt: skip
    unfinished = folder.with_name(f"{folder.name}.{os.getpid()}.tmp")
    unfinished.mkdir(parents=True)
    try:
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            jobs = [(cutting, source, (seed, i)) for i, source in enumerate(sources)]
            _write(unfinished, pool.imap(_cut, jobs), description)
        unfinished.rename(folder)
    except BaseException:
        shutil.rmtree(unfinished)
        raise
    return PatchStore.open(folder)


def _cut(job: tuple[Cutting, Path | Task, tuple[int, int]]) -> Part:
    cutting, source, seed = job
    return cutting.patches_of(source, seed)


def _write(folder: Path, parts: Iterable[Part], description: dict[str, Any]) -> None:
    """The files of a store; views are numbered through, the numbers of points and patches told in the description."""
    first, total, views = [np.zeros(1, np.int64)], 0, 0
    columns = collections.defaultdict[str, list[NDArray[Any]]](list)
    with open(folder / "patches.raw", "wb") as raw:
        for patches, point, more in parts:
            raw.write(patches.tobytes())
            first.append(total + np.cumsum(np.bincount(point)) if len(point) else np.zeros(0, np.int64))
            total += len(patches)
            for name, column in more.items():
                columns[name].append(column + views if name == "view" else column)
            views += 1 + more["view"].max(initial=-1) if more else 0
    for name, column_parts in {"first": first, **columns}.items():
        np.save(folder / f"{name}.npy", np.concatenate(column_parts))
    raw_patches = np.memmap(folder / "patches.raw", np.uint8, "r", shape=(total, CONTEXT_SIZE, CONTEXT_SIZE))
    np.save(folder / "patches.npy", raw_patches)
    (folder / "patches.raw").unlink()
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
    train = [p for p in photographs if p.source not in held_out]
    validation = [p for p in photographs if p.source in held_out]
    if not train or not validation:
        raise ValueError("held_out must leave sources on both sides: training and validation")
    return train, validation
