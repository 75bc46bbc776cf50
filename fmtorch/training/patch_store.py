"""Corresponding patches on disk: a memory-mapped array of bytes, and which point each patch shows."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import json
import multiprocessing
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.data.images import read_image
from fmtorch.scenes.generate import Task
from fmtorch.training.correspondences import CONTEXT_SIZE, Tolerance, corresponding_patches
from fmtorch.training.photographs import Photograph
from fmtorch.training.scenes import draw_patches
from fmtorch.training.warps import ViewRange


@dataclasses.dataclass(frozen=True)
class PatchStore:
    """Patches of points seen in two or more views.

    patches: (m, CONTEXT_SIZE, CONTEXT_SIZE) uint8, sorted by point. first: (n + 1,) where each point's patches begin.
    description: how they were made, for the model card.
    """

    patches: NDArray[np.uint8]
    first: NDArray[np.int64]
    description: dict[str, Any]

    @classmethod
    def open(cls, folder: Path | str) -> PatchStore:
        """A store that `build_store` has written; FileNotFoundError where there is none."""
        folder = Path(folder)
        if not (folder / "store.json").is_file():
            raise FileNotFoundError(f"{folder} holds no patches (store.json is absent)")
        return cls(
            np.load(folder / "patches.npy", mmap_mode="r"),
            np.load(folder / "first.npy"),
            json.loads((folder / "store.json").read_text()),
        )

    def __len__(self) -> int:
        return len(self.first) - 1

    def views(self, points: Int[Tensor, " b"], draws: Float[Tensor, "b 2"]) -> Float[Tensor, "2 b 1 h w"]:
        """Two different patches of each point in [0, 1], chosen by two random numbers in [0, 1)."""
        start = torch.from_numpy(self.first)[points]
        count = torch.from_numpy(self.first)[points + 1] - start
        first = (draws[:, 0] * count).long()
        other = (draws[:, 1] * (count - 1)).long()
        other = other + (other >= first)
        index = torch.stack([start + first, start + other]).numpy()
        return torch.from_numpy(self.patches[index]).unsqueeze(2).float() / 255


def build_store(
    folder: Path | str,
    photographs: Sequence[Photograph],
    *,
    seed: int,
    views: int,
    points: int,
    limits: ViewRange | None = None,
    tolerance: Tolerance | None = None,
    longest_side: int = 1024,
    scenes: Sequence[Task] = (),
    workers: int = 1,
) -> PatchStore:
    """Cut corresponding patches from photographs and rendered scenes into `folder`, which appears once it is complete.

    A photograph's patches depend on the seed and its place in the list alone, a scene's on the seed and the scene.
    Raises FileExistsError if the folder exists.
    """
    folder = Path(folder)
    if folder.exists():
        raise FileExistsError(f"{folder} exists; delete it to cut the patches again")
    limits, tolerance = limits or ViewRange(), tolerance or Tolerance()
    options = {"views": views, "points": points, "limits": limits, "tolerance": tolerance}
    photograph_jobs = [(photograph.path, (seed, i), longest_side, options) for i, photograph in enumerate(photographs)]
    scene_jobs = [(task, (seed, len(photographs) + i), points, tolerance) for i, task in enumerate(scenes)]
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        cutting = itertools.chain(pool.imap(_patches_of, photograph_jobs), pool.imap(draw_patches, scene_jobs))
        description = {
            "photographs": count_by(photograph.source for photograph in photographs),
            "scenes": count_by(task.family for task in scenes), "seed": seed, "views": views,
            "limits": dataclasses.asdict(limits), "tolerance": dataclasses.asdict(tolerance),
        }  # fmt: skip
        write_store(folder, ((patches, point, {}) for patches, point in cutting), description)
    return PatchStore.open(folder)


def write_store(
    folder: Path,
    parts: Iterable[tuple[NDArray[np.uint8], NDArray[np.int64], Mapping[str, NDArray[Any]]]],
    description: Mapping[str, Any],
) -> None:
    """Write a store into `folder`, which appears once it is complete.

    parts: patches, the point that each shows (ascending, each twice or more), and further arrays of one row a patch,
    which become files of their names. The numbers of points and of patches are added to the description.
    """
    unfinished = folder.with_name(f"{folder.name}.{os.getpid()}.tmp")
    unfinished.mkdir(parents=True)
    try:
        first, total = [np.zeros(1, np.int64)], 0
        columns: dict[str, list[NDArray[Any]]] = {}
        with open(unfinished / "patches.raw", "wb") as raw:
            for patches, point, more in parts:
                raw.write(patches.tobytes())
                first.append(total + np.cumsum(np.bincount(point)) if len(point) else np.zeros(0, np.int64))
                total += len(patches)
                for name, column in more.items():
                    columns.setdefault(name, []).append(column)
        np.save(unfinished / "first.npy", np.concatenate(first))
        for name, column_parts in columns.items():
            np.save(unfinished / f"{name}.npy", np.concatenate(column_parts))
        raw_patches = np.memmap(unfinished / "patches.raw", np.uint8, "r", shape=(total, CONTEXT_SIZE, CONTEXT_SIZE))
        np.save(unfinished / "patches.npy", raw_patches)
        (unfinished / "patches.raw").unlink()
        counts = {"points": sum(len(f) for f in first) - 1, "patches": total}
        (unfinished / "store.json").write_text(json.dumps({**counts, **description}, indent=1))
        unfinished.rename(folder)
    except BaseException:
        shutil.rmtree(unfinished)
        raise


def count_by(names: Iterable[str]) -> dict[str, int]:
    """How often each name occurs, in the order of first occurrence."""
    return dict(collections.Counter(names))


def _patches_of(
    job: tuple[Path, tuple[int, int], int, dict[str, Any]],
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """What a worker does: one photograph's patches."""
    path, seed, longest_side, options = job
    cv2.setNumThreads(1)
    image = read_image(path)
    scale = min(1.0, longest_side / max(image.shape[:2]))
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return corresponding_patches(image, np.random.default_rng(seed), **options)
