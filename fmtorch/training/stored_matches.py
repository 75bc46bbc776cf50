"""Labelled matches on disk, the torch Dataset that reads them, and batches of pairs with similar numbers of matches."""

import copy
import itertools
import warnings
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, Sampler

from fmtorch.core import Correspondences, replacing
from fmtorch.jit.random import Stream, uniform
from fmtorch.training.labelled import Augmentation, LabelledMatches, collate, subset_size

PATTERN = "shard-*.arrow"
FORMAT = 1  # of the files; raised when the schema changes

ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {  # of a pair: types and shapes, -1: number of its matches
    **dict.fromkeys(("F", "K0", "K1"), ("float64", (3, 3))), **dict.fromkeys(("size0", "size1"), ("int64", (2,))),
    **dict.fromkeys(("x0", "x1"), ("float32", (-1, 2))), "label": ("int8", (-1,)),
    **dict.fromkeys(("ratio", "score", "prior", "noise"), ("float32", (-1,))), "mutual": ("uint8", (-1,)),
    **dict.fromkeys(("lafs0", "lafs1"), ("float32", (-1, 2, 3))),
}  # fmt: skip
_TEXTS, _COUNTS = ("identity", "family", "scene", "reason"), ("matches", "inliers", "outliers")
INDEX = {"key": pa.int64(), **dict.fromkeys(_TEXTS, pa.string()), **dict.fromkeys(_COUNTS, pa.int64())}
"""What is known of a pair without its matches, and types."""
SCHEMA = pa.schema(INDEX | {name: pa.list_(pa.from_numpy_dtype(kind)) for name, (kind, _) in ARRAYS.items()})

Row = Mapping[str, Any]


class ShardError(ValueError):
    """A file of matches that is missing, damaged or of another version; the message names it."""


def write_shard(path: Path, rows: Sequence[Row]) -> None:
    """Write rows of `SCHEMA`: texts, integers, flat arrays, None for what a pair does not have. Whole or absent."""
    batch = pa.RecordBatch.from_pylist(rows, schema=SCHEMA)
    batch = batch.replace_schema_metadata({"format": str(FORMAT), "checksum": str(_checksum(batch))})
    with replacing(path) as temporary, pa.ipc.new_file(str(temporary), batch.schema) as writer:
        writer.write_batch(batch)


class Shard:
    """A file of matches, mapped into memory: reading a pair touches the bytes of that pair only.
    verify: check the checksum, at about 1 GB/s. Raises ShardError for a missing or damaged file or another version."""

    def __init__(self, path: Path, *, verify: bool = False) -> None:
        self.path = path
        try:
            self._file = pa.memory_map(str(path))
            reader = pa.ipc.open_file(self._file)
            about = reader.schema.metadata or {}
            if about.get(b"format") != str(FORMAT).encode() or not reader.schema.equals(SCHEMA):
                raise ShardError(f"{path} is not of format {FORMAT} of this version")
            self.batch = reader.get_batch(0)
            if verify:
                self.batch.validate(full=True)
                if about.get(b"checksum") != str(_checksum(self.batch)).encode():
                    raise ShardError(f"{path} is damaged: its checksum is wrong")
        except (pa.ArrowException, OSError, ValueError) as error:
            raise error if isinstance(error, ShardError) else ShardError(f"{path} cannot be read: {error}") from error

    def __len__(self) -> int:
        return int(self.batch.num_rows)

    def index(self) -> dict[str, list[Any]]:
        """What is known of each pair without its matches: the columns of `INDEX`."""
        index: dict[str, list[Any]] = self.batch.select(list(INDEX)).to_pydict()
        return index

    def read(self, row: int, names: Sequence[str] = tuple(ARRAYS)) -> dict[str, NDArray[Any]]:
        """A pair's arrays, views of the file: points (n, 2), frames (n, 2, 3), F (3, 3), ...; absent ones left out."""
        lists = ((name, self.batch.column(name)[row].values) for name in names)
        known = ((name, values.to_numpy(zero_copy_only=True)) for name, values in lists if values is not None)
        return {name: values.reshape(ARRAYS[name][1]) for name, values in known}


def _checksum(batch: pa.RecordBatch) -> int:
    total = 0
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        total = zlib.crc32(name.encode(), total)
        if pa.types.is_list(column.type):
            total = zlib.crc32(np.asarray(column.is_valid()).tobytes(), total)
            total = zlib.crc32(column.offsets.to_numpy().tobytes(), total)
            values = column.values.to_numpy(zero_copy_only=True)
            total = zlib.crc32(values.data if len(values) else b"", total)
        else:
            total = zlib.crc32(repr(column.to_pylist()).encode(), total)
    return total


class Draw(NamedTuple):
    """An item of a batch: which pair, in which epoch, and at most how many of its matches."""

    pair: int
    epoch: int = 0
    matches: int | None = None


class StoredMatches(Dataset[LabelledMatches]):
    """The labelled matches in a folder that `MatchedPairs` has filled; each item is a batch of one pair.

    Files are mapped into memory and opened by each process for itself, so the data set can be handed to the workers of
    a DataLoader, forked or spawned. Pairs that failed are left out, with a warning; `failures` holds their identities
    and reasons. `pairs` has of each item the columns of `INDEX`.

    Args:
        folder: holds ``shard-*.arrow``.
        augmentation: random changes of each item, by `seed`, the pair's key and the epoch (`set_epoch`, or a `Draw`).

    Raises ValueError where the folder has no such files or every pair failed, ShardError for a damaged file."""

    def __init__(self, folder: str | Path, *, augmentation: Augmentation | None = None, seed: int = 0) -> None:
        self.folder = Path(folder)
        paths = sorted(self.folder.glob(PATTERN))
        if not paths:
            raise ValueError(f"{folder} holds no labelled matches ({PATTERN}); MatchedPairs computes them")
        self._read_index(paths, augmentation, seed)

    def _read_index(self, paths: Sequence[Path], augmentation: Augmentation | None, seed: int) -> None:
        self.augmentation, self.seed, self.epoch = augmentation, seed, 0
        self._paths = list(paths)
        self._open: dict[int, Shard] = {}
        self.pairs: list[dict[str, Any]] = []
        self.failures: list[tuple[str, str]] = []
        self._rows: list[tuple[int, int]] = []
        for number in range(len(self._paths)):
            index = self._shard(number).index()
            for row, values in enumerate(zip(*index.values(), strict=True)):
                about = dict(zip(index, values, strict=True))
                if about["reason"]:
                    self.failures.append((about["identity"], about["reason"]))
                else:
                    self._rows.append((number, row))
                    self.pairs.append(about)
        if self.failures:
            identity, reason = self.failures[0]
            count = f"{len(self.failures)} of {len(self.failures) + len(self)} pairs"
            message = f"{count} have no matches and are left out, the first is {identity}: {reason}"
            if not len(self):
                raise ValueError(message)
            warnings.warn(message, stacklevel=3)

    @property
    def digest(self) -> str:
        """Of all that defines the matches."""
        return self.folder.name

    def __len__(self) -> int:
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
        lengths = []
        for about, (number, row) in zip(self.pairs, self._rows, strict=True):
            arrays = self._shard(number).read(row, ("ratio", "label"))
            known = {name: torch.from_numpy(values.copy()) for name, values in arrays.items()}
            given = known.get("ratio"), known["label"]
            lengths.append(self.augmentation.expected(*given, key=about["key"], seed=self.seed, epoch=epoch))
        return lengths

    def select(self, indices: Iterable[int]) -> "StoredMatches":
        chosen, other = list(indices), copy.copy(self)
        other._rows, other.pairs = [self._rows[i] for i in chosen], [self.pairs[i] for i in chosen]
        return other

    def joined(self, other: "StoredMatches") -> "StoredMatches":
        """The pairs of both data sets, this one's first, with this one's random changes and folder."""
        both = copy.copy(self)
        both._paths, both._open = [*self._paths, *other._paths], {}
        both._rows = [*self._rows, *((number + len(self._paths), row) for number, row in other._rows)]
        both.pairs, both.failures = [*self.pairs, *other.pairs], [*self.failures, *other.failures]
        return both

    def augmented(self, augmentation: Augmentation | None, seed: int = 0) -> "StoredMatches":
        other = copy.copy(self)
        other.augmentation, other.seed = augmentation, seed
        return other

    def _shard(self, number: int) -> Shard:
        if number not in self._open:
            self._open[number] = self._reader(self._paths[number])
        return self._open[number]

    def _reader(self, path: Path) -> Shard:
        return Shard(path)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}


def split_scenes(matches: StoredMatches, last: int = 4) -> tuple[StoredMatches, StoredMatches]:
    """Pairs for training, and those of the last scenes of each family, by name, for validation.

    The splits share neither scene nor pair; of rendered training scenes they share a few photographs on walls.

    Args:
        matches: of several scenes a family. last: scenes of each family for validation.

    Raises ValueError for a family that has no more scenes than that."""
    scenes = [(about["family"], about["scene"]) for about in matches.pairs]
    for family, count in Counter(family for family, _ in dict.fromkeys(scenes)).items():
        if count <= last:
            raise ValueError(f"family {family} has {count} scenes; with {last} for validation none is left to train")
    held = last_scenes(scenes, last)
    training, validation = ([i for i, scene in enumerate(scenes) if (scene in held) is side] for side in (False, True))
    return matches.select(training), matches.select(validation)


HELD_OUT = 4  # scenes of a family
QUARTER = 4  # of a family of fewer scenes one in so many


def last_scenes(scenes: Iterable[tuple[str, str]], last: int | None) -> set[tuple[str, str]]:
    """Of scenes (family, name), each given any number of times, the last of each family by name; never its first.
    last: how many; None: `HELD_OUT`, or a quarter of a family that has few."""
    names: dict[str, set[str]] = {}
    for family, name in scenes:
        names.setdefault(family, set()).add(name)
    held = set()
    for family, own in names.items():
        count = last or min(HELD_OUT, max(1, len(own) // QUARTER))
        held |= {(family, name) for name in sorted(own)[max(1, len(own) - count) :]}
    return held


MAX_PADDING = 0.2  # share of a batch's slots
_POOL = 8  # batches that are sorted by length together: more make lengths more similar and batches less random


class SimilarLengthBatches(Sampler[list[Draw]]):
    """Each pair once an epoch, in random batches of similar lengths: a ``batch_sampler`` for torch's DataLoader.

    Pairs are shuffled, sorted by length within pools of a few batches, and the batches shuffled. Every batch draws one
    number of matches that its pairs are cut to, so that padding is due to shorter pairs only; `collate_trimmed` bounds
    it. All is a function of (seed, epoch): after `set_epoch` the batches are those of an uninterrupted training, and
    `start` leaves out those that it has seen. The epoch travels with each item, for workers of a DataLoader.

    Args:
        dataset: `MatchedPairs`. batch: pairs in a batch; the last one of an epoch may be smaller.
        seed: selects the batches. matches: range of the number of matches, uniform in its logarithm; None: no limit.
        rank, world_size: in a distributed training; each has as many batches, where need be some of the first twice.

    Raises ValueError for a batch below 1, and for a rank that is not below world_size."""

    def __init__(
        self, dataset: StoredMatches, batch: int = 32, *, seed: int = 0, matches: Sequence[int] | None = (50, 4000),
        rank: int = 0, world_size: int = 1,
    ) -> None:  # fmt: skip
        if batch < 1:
            raise ValueError(f"batch is {batch}; it must be at least 1")
        if not 0 <= rank < world_size:
            raise ValueError(f"rank is {rank} of {world_size} processes; it must be from 0 to {world_size - 1}")
        self.dataset, self.batch, self.seed, self.matches = dataset, batch, seed, matches
        self.rank, self.world_size = rank, world_size
        self.epoch = self.start = 0

    def set_epoch(self, epoch: int, start: int = 0) -> None:
        """Choose the epoch, and how many of its batches (of this process) are left out at its start."""
        self.epoch, self.start = epoch, start

    def __len__(self) -> int:
        batches = -(-len(self.dataset) // self.batch)
        return max(-(-batches // self.world_size) - self.start, 0)

    def __iter__(self) -> Iterator[list[Draw]]:
        lengths = torch.tensor(self.dataset.lengths(self.epoch), dtype=torch.float64)
        order = self._shuffled(len(lengths), 0)
        pools = [pool[torch.argsort(lengths[pool], stable=True)] for pool in torch.split(order, _POOL * self.batch)]
        batches = [batch.tolist() for pool in pools for batch in torch.split(pool, self.batch)]
        batches = [batches[i] for i in self._shuffled(len(batches), 1).tolist()]
        sizes: list[int | None] = [None] * len(batches)
        if self.matches is not None:
            sizes = [subset_size(self.matches, u) for u in self._numbers(len(batches), 2).tolist()]
        drawn = [[Draw(i, self.epoch, size) for i in batch] for batch, size in zip(batches, sizes, strict=True)]
        rounds = -(-len(drawn) // self.world_size)
        everyone = list(itertools.islice(itertools.cycle(drawn), rounds * self.world_size)) if drawn else []
        yield from everyone[self.rank :: self.world_size][self.start :]

    def _numbers(self, n: int, purpose: int) -> torch.Tensor:
        return uniform(self.seed, torch.tensor([self.epoch * 3 + purpose]), Stream.BATCHES, 0, n, 1)[0, :, 0]

    def _shuffled(self, n: int, purpose: int) -> torch.Tensor:
        return torch.argsort(self._numbers(n, purpose))


def collate_trimmed(items: Sequence[LabelledMatches], padding: float = MAX_PADDING) -> LabelledMatches:
    """`collate`, with the longest pairs cut so that at most `padding` of all slots are padding.
    The first matches of a pair are kept, a random subset after an `Augmentation`. Raises ValueError as it does."""
    n = longest(torch.tensor([int(item.correspondences.mask.sum()) for item in items]), padding)
    return collate([item.compact().first(n) for item in items])


def longest(counts: torch.Tensor, padding: float) -> int:
    """The largest number of slots with at most `padding` of them empty, for pairs with so many matches each."""
    low, high = (int(counts.min()), int(counts.max())) if len(counts) else (0, 0)
    while low < high:  # the share of padding grows with the number of slots
        middle = (low + high + 1) // 2
        filled = int(counts.clamp(max=middle).sum())
        low, high = (middle, high) if filled >= (1 - padding) * len(counts) * middle else (low, middle - 1)
    return max(low, 1)


class EndlessBatches(Sampler[list[Draw]]):
    """Epoch after epoch of `batches`, from the batch of a given step on."""

    def __init__(self, batches: SimilarLengthBatches, step: int) -> None:
        self.batches, self.step = batches, step

    def __iter__(self) -> Iterator[list[Draw]]:
        self.batches.set_epoch(0)
        epoch, start = divmod(self.step, len(self.batches))
        while True:
            self.batches.set_epoch(epoch, start)
            yield from self.batches
            epoch, start = epoch + 1, 0


def training_batches(
    matches: StoredMatches, batch: int, seed: int, step: int, rank: int = 0, processes: int = 1, *, workers: int = 0
) -> DataLoader[LabelledMatches]:
    """A loader of augmented batches from `step` on, which never ends.
    matches: with the augmentation of the training. batch: pairs in a batch of one process. rank, processes: of a
    distributed training. workers: processes that load; 0: this one."""
    lengths = None if matches.augmentation is None else matches.augmentation.matches
    similar = SimilarLengthBatches(matches, batch, seed=seed, matches=lengths, rank=rank, world_size=processes)
    return DataLoader(
        matches, batch_sampler=EndlessBatches(similar, step), collate_fn=collate_trimmed, num_workers=workers,
        persistent_workers=workers > 0,
    )  # fmt: skip
