"""Corresponding patches on disk: a memory-mapped array of bytes, which point each patch shows, and its geometry."""

from __future__ import annotations

import collections
import dataclasses
import functools
import json
import multiprocessing
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor, from_numpy

from fmtorch.data.images import read_image
from fmtorch.jit import random
from fmtorch.jit.random import Stream
from fmtorch.scenes.surfaces import PICTURES, skimage_file
from fmtorch.training.planes import Photograph, PlaneViews
from scripts.patch_networks import patches
from scripts.patch_networks.patches import CONTEXT_SIZE, Part, Tolerance, patch_similarity

MAX_SIMILARITY = 0.85  # of the photographs of a pair: GeoDesc's authors leave out those that are more alike


@dataclasses.dataclass(frozen=True, eq=False)
class PatchStore:
    """Patches of points seen in two or more views, sorted by point.
    patches: (m, CONTEXT_SIZE, CONTEXT_SIZE) uint8. first: (n + 1,) where each point's patches begin. view, rays,
    incidence: (m,), (m, 3), (m,), as of a `Part`, views numbered through. description: how they were made, for the
    model card."""

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
    return random.bits(seed, torch.tensor([key]), Stream.TRAINING, 0, total, 1).flatten().argsort(stable=True)


def validation_pairs(store: PatchStore, count: int, seed: int = 0) -> Float[Tensor, "2 n 1 h w"]:
    """Two patches each of up to `count` points of a store, in random order: always the same for one seed."""
    points = order(seed, 0, len(store))[:count]
    return store.views(points, random.uniform(seed + 1, torch.tensor([0]), Stream.TRAINING, 0, len(points), 2)[0])


@dataclasses.dataclass(frozen=True, eq=False)
class MatchSets:
    """The matches of pairs of photographs, set after set (Luo et al., GeoDesc, ECCV 2018, section 3.4).
    The patches that a loss compares with each other then come from one pair of photographs, as when a descriptor is
    used; pairs whose photographs are nearly alike are left out, since they teach little. patches: (2, k) indices of the
    two patches of each match. similarity: (k,) its S_patch. first: (s + 1,) where each set begins. image_similarity:
    (s,) the mean of a set's S_patch."""

    patches: NDArray[np.int64]
    similarity: NDArray[np.float64]
    first: NDArray[np.int64]
    image_similarity: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.first) - 1


def match_sets(store: PatchStore, matches: int, max_similarity: float = MAX_SIMILARITY) -> MatchSets:
    """The sets of pairs of photographs that share at least `matches` points and are not more alike than allowed.
    S_image, the similarity of two photographs, is the mean S_patch of their shared points (section 3.3). In the order
    of the first photograph and then of the second; matches in the order of their points. Raises ValueError where no
    pair is left."""
    pairs = _pairs_of_points(store.first)
    pairs = np.where(store.view[pairs[0]] > store.view[pairs[1]], pairs[::-1], pairs)
    a, b = pairs = pairs[:, np.lexsort((pairs[0], *store.view[pairs][::-1]))]
    similarity = patch_similarity(store.rays[a], store.rays[b], store.incidence[a], store.incidence[b])
    begins = np.flatnonzero(np.r_[True, (np.diff(store.view[pairs]) != 0).any(0)][: len(a)])
    counts = np.diff(np.r_[begins, len(a)])
    image = np.add.reduceat(similarity, begins) / counts if len(begins) else np.zeros(0)
    kept = (counts >= matches) & (image <= max_similarity)
    if not kept.any():
        raise ValueError(
            f"no pair of photographs shares {matches} points and has a similarity of at most {max_similarity}: "
            "lower match_sets.matches, or cut more points"
        )
    of_kept = np.repeat(kept, counts)
    return MatchSets(pairs[:, of_kept], similarity[of_kept], np.r_[0, np.cumsum(counts[kept])], image[kept])


def _pairs_of_points(first: NDArray[np.int64]) -> NDArray[np.int64]:
    """All pairs (2, k) of patches of the same point."""
    counts = np.diff(first)
    parts = [np.zeros((2, 0), np.int64)]
    for length in np.unique(counts[counts >= 2]):
        i, j = np.triu_indices(length, 1)
        start = first[:-1][counts == length][:, None]
        parts.append(np.stack([(start + i).ravel(), (start + j).ravel()]))
    return np.concatenate(parts, axis=1)


@dataclasses.dataclass(frozen=True)
class Cutting:
    """How patches are cut of photographs as planes.
    points: strongest of each detector. longest_side: pixels, to which larger photographs are reduced."""

    planes: PlaneViews
    points: int
    tolerance: Tolerance = dataclasses.field(default_factory=Tolerance)
    longest_side: int = 1024

    def patches_of(self, job: tuple[Photograph, tuple[int, int]]) -> Part:
        """The patches of a photograph, by a seed."""
        photograph, seed = job
        cv2.setNumThreads(1)
        image = read_image(photograph.path)
        if (scale := self.longest_side / max(image.shape[:2])) < 1:
            image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        return patches.tracks(
            patches.views_of(image, np.random.default_rng(seed), self.planes, self.points), self.tolerance
        )


def build_store(
    folder: Path, photographs: Sequence[Photograph], cutting: Cutting, seed: int, workers: int = 1
) -> PatchStore:
    """Cut corresponding patches from photographs into `folder`, which appears once it is complete.
    The patches of a photograph depend on the seed and its place in the list alone. Raises FileExistsError if the folder
    exists."""
    if folder.exists():
        raise FileExistsError(f"{folder} exists; delete it to cut the patches again")
    description = {
        "photographs": dict(collections.Counter(each.source for each in photographs)), "seed": seed,
        "views": cutting.planes.views, "limits": dataclasses.asdict(cutting.planes),
        "tolerance": dataclasses.asdict(cutting.tolerance),
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
    np.savez(folder / "geometry.npz", first=np.concatenate(first), **{k: np.concatenate(v) for k, v in columns.items()})
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
