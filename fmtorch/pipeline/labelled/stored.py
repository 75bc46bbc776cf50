"""`StoredMatches`: labelled matches that lie on disk, as a torch Dataset."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import Dataset

from fmtorch.core.types import Correspondences
from fmtorch.pipeline.labelled.augmentation import Augmentation
from fmtorch.pipeline.labelled.batches import Draw
from fmtorch.pipeline.labelled.record import LabelledMatches
from fmtorch.pipeline.labelled.shards import Shard

PATTERN = "shard-*.arrow"


class StoredMatches(Dataset[LabelledMatches]):
    """The labelled matches in a folder that `MatchedPairs` has filled; each item is a batch of one pair.

    Files are mapped into memory and opened by each process for itself, so the data set can be handed to the workers of
    a DataLoader, forked or spawned. Pairs that failed are left out, with a warning; `failures` holds their identities
    and reasons. `pairs` says of each item what its key, identity, family and scene are, and how many matches, inliers
    and outliers it has on disk.

    Args:
        folder: holds ``shard-*.arrow``.
        augmentation: random changes of each item, selected by `seed`, the pair's key and the epoch (`set_epoch`, or an
            index that is a `Draw`).

    Raises ValueError where the folder has no such files or every pair failed, ShardError for a damaged file.
    """

    def __init__(self, folder: str | Path, *, augmentation: Augmentation | None = None, seed: int = 0) -> None:
        self.folder = Path(folder)
        self.augmentation, self.seed, self.epoch = augmentation, seed, 0
        self._paths = sorted(self.folder.glob(PATTERN))
        self._open: dict[int, Shard] = {}
        if not self._paths:
            raise ValueError(f"{folder} holds no labelled matches ({PATTERN}); MatchedPairs computes them")
        self.pairs: list[dict[str, Any]] = []
        self.failures: list[tuple[str, str]] = []
        self._rows: list[tuple[int, int]] = []
        for number in range(len(self._paths)):
            index = self._shard(number).index()
            for row in range(len(self._shard(number))):
                about = {name: column[row] for name, column in index.items()}
                if about["reason"]:
                    self.failures.append((about["identity"], about["reason"]))
                else:
                    self._rows.append((number, row))
                    self.pairs.append(about)
        self._tell_failures()

    def __len__(self) -> int:
        """Number of pairs that have matches."""
        return len(self._rows)

    def __getitem__(self, index: int | Draw) -> LabelledMatches:
        """The matches of a pair, augmented where that is asked for; of a `Draw`, at most so many of them."""
        draw = index if isinstance(index, Draw) else Draw(int(index), self.epoch)
        matches = self.stored(draw.pair)
        if self.augmentation is None and draw.matches is None:
            return matches
        change = self.augmentation or Augmentation.none()
        return change(matches, seed=self.seed, epoch=draw.epoch, count=draw.matches)

    def stored(self, index: int) -> LabelledMatches:
        """The matches of a pair as they are on disk."""
        number, row = self._rows[index]
        tensors = {name: torch.from_numpy(array.copy())[None] for name, array in self._shard(number).read(row).items()}
        label, F = tensors.pop("label"), tensors.pop("F")
        if "mutual" in tensors:
            tensors["mutual"] = tensors["mutual"].to(torch.bool)
        key = torch.tensor([self.pairs[index]["key"]], dtype=torch.int64)
        mask = torch.ones_like(label, dtype=torch.bool)
        return LabelledMatches(Correspondences(mask=mask, key=key, **tensors), label, F)

    def set_epoch(self, epoch: int) -> None:
        """Choose the random numbers of items that are asked for by a plain index."""
        self.epoch = epoch

    def lengths(self, epoch: int) -> list[float]:
        """About how many matches each pair has in an epoch, before it is cut to a random number of them."""
        if self.augmentation is None:
            return [float(about["matches"]) for about in self.pairs]
        return [
            self.augmentation.expected(quality, label, key=about["key"], seed=self.seed, epoch=epoch)
            for about, (quality, label) in zip(self.pairs, map(self._figures, self._rows), strict=True)
        ]

    def select(self, indices: Iterable[int]) -> StoredMatches:
        """The same data set with these pairs only."""
        chosen = list(indices)
        other = copy.copy(self)
        other._rows = [self._rows[i] for i in chosen]
        other.pairs = [self.pairs[i] for i in chosen]
        return other

    def joined(self, other: StoredMatches) -> StoredMatches:
        """The pairs of both data sets, this one's first, with this one's random changes and folder."""
        both = copy.copy(self)
        both._paths, both._open = [*self._paths, *other._paths], {}
        both._rows = [*self._rows, *((number + len(self._paths), row) for number, row in other._rows)]
        both.pairs, both.failures = [*self.pairs, *other.pairs], [*self.failures, *other.failures]
        return both

    def augmented(self, augmentation: Augmentation | None, seed: int = 0) -> StoredMatches:
        """The same data set with other random changes."""
        other = copy.copy(self)
        other.augmentation, other.seed = augmentation, seed
        return other

    def _figures(self, where: tuple[int, int]) -> tuple[torch.Tensor | None, torch.Tensor]:
        number, row = where
        arrays = self._shard(number).read(row, ("quality", "label"))
        quality = torch.from_numpy(arrays["quality"].copy()) if "quality" in arrays else None
        return quality, torch.from_numpy(arrays["label"].copy())

    def _shard(self, number: int) -> Shard:
        if number not in self._open:
            self._open[number] = Shard(self._paths[number])
        return self._open[number]

    def _tell_failures(self) -> None:
        if not self.failures:
            return
        identity, reason = self.failures[0]
        total = len(self.failures) + len(self)
        message = (
            f"{len(self.failures)} of {total} pairs have no matches and are left out, the first is {identity}: {reason}"
        )
        if not len(self):
            raise ValueError(message)
        warnings.warn(message, stacklevel=3)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}


def split_scenes(matches: StoredMatches, last: int = 4) -> tuple[StoredMatches, StoredMatches]:
    """Pairs for training, and those of the last scenes of each family, by name, for validation.

    The splits of a data set share neither scene nor pair. The rendered training scenes share a few photographs, which
    hang on walls of both parts.

    Args:
        matches: of several scenes a family. last: scenes of each family for validation.

    Raises ValueError for a family that has no more scenes than that.
    """
    scenes: dict[str, set[str]] = {}
    for about in matches.pairs:
        scenes.setdefault(about["family"], set()).add(about["scene"])
    for family, names in scenes.items():
        if len(names) <= last:
            raise ValueError(
                f"family {family} has {len(names)} scenes; with {last} for validation none is left to train"
            )
    held = last_scenes(((about["family"], about["scene"]) for about in matches.pairs), last)
    inside = [(about["family"], about["scene"]) in held for about in matches.pairs]
    return (
        matches.select(i for i, held_out in enumerate(inside) if not held_out),
        matches.select(i for i, held_out in enumerate(inside) if held_out),
    )


def last_scenes(scenes: Iterable[tuple[str, str]], last: int) -> set[tuple[str, str]]:
    """Of scenes (family, name), each given any number of times, the last of each family by name; never its first."""
    names: dict[str, set[str]] = {}
    for family, name in scenes:
        names.setdefault(family, set()).add(name)
    return {
        (family, name)
        for family, of_family in names.items()
        for name in sorted(of_family)[max(1, len(of_family) - last) :]
    }
