"""`MatchedPairs`: a data set of image pairs seen through a pipeline's first stages, with labels."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from fmtorch.data.pairs import DepthDataset, PairDataset
from fmtorch.matched import labels
from fmtorch.matched.compute import Progress, compute_shards, partition
from fmtorch.matched.record import LabelledMatches
from fmtorch.matched.shards import FORMAT, Shard, ShardError
from fmtorch.pipeline import Pipeline
from fmtorch.resources import cache_dir
from fmtorch.storage.configuration import configuration, environment
from fmtorch.storage.files import replacing
from fmtorch.storage.runs import canonical, identity_digest
from fmtorch.types import Correspondences

MOST = 4000  # matches kept of a pair


class MatchedPairs(Dataset[LabelledMatches]):
    """Labelled matches of the pairs of a data set, each item a batch of one; for torch's DataLoader with `collate`.

    Matches are computed once, by `workers` threads, and kept in files that are read through a memory map; an
    interrupted computation goes on where it stopped, a damaged file is computed anew. The folder's name holds a digest
    of all that defines them: data set, stages before estimation, label rules, libraries. The order is the data set's;
    pairs that fail are left out, see `failures`.

    Args:
        dataset: image pairs with ground truth; labels are by depth where it is a `DepthDataset`.
        pipeline: a `Pipeline`, or the name of one of conf/pipeline. Its estimator is not used.
        overrides: changes of a named pipeline, as on the command line, e.g. ``["pruner=[one_to_one]"]``.
        root: the folder of such folders, by default ``matched`` in the cache folder.
        workers: threads, by default one a core. progress: called with (pairs done, pairs in all).
        most: matches kept of a pair, the best by quality.

    Raises ValueError for an unknown pipeline or `most` below 1, and where every pair fails.
    """

    def __init__(
        self,
        dataset: PairDataset,
        pipeline: Pipeline | str,
        *,
        overrides: Sequence[str] = (),
        root: str | Path | None = None,
        workers: int | None = None,
        progress: Progress | None = None,
        most: int = MOST,
    ) -> None:
        if most < 1:
            raise ValueError(f"most is {most}; at least 1 match of a pair must be kept")
        stages = _pipeline(pipeline, overrides)
        identity = {
            "format": FORMAT, "dataset": [dataset.name, dataset.digest], "most": most,
            "labels": [labels.VERSION, "depth" if isinstance(dataset, DepthDataset) else "lines",
                       labels.INLIER_PX, labels.OUTLIER_PX, labels.EDGE_PX],
            "stages": configuration([_uncached(stages.extractor), stages.matcher, stages.pruners]),
            "environment": environment(),
        }  # fmt: skip
        home = Path(root).expanduser() if root is not None else cache_dir() / "matched"
        folder = home / f"{dataset.name}-{identity_digest(identity)[:16]}"
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "about.json").exists():
            with replacing(folder / "about.json") as temporary:
                temporary.write_text(json.dumps(json.loads(canonical(identity)), indent=2) + "\n", encoding="utf-8")
        pairs = [dataset[i] for i in range(len(dataset))]
        shards = partition(pairs)
        paths = [folder / f"shard-{number:05d}.arrow" for number in range(len(shards))]
        missing = [number for number, path in enumerate(paths) if not _sound(path)]
        done, total = len(pairs) - sum(len(shards[number]) for number in missing), len(pairs)
        report = progress or (lambda done, total: None)
        report(done, total)
        jobs = [(paths[number], [pairs[i] for i in shards[number]]) for number in missing]
        for count in compute_shards(dataset, stages, jobs, most=most, workers=workers or os.cpu_count() or 1):
            done += count
            report(done, total)
        self.folder = folder
        self._paths = paths
        rows = [(number, row) for number, members in enumerate(shards) for row in range(len(members))]
        order = np.argsort([i for members in shards for i in members], kind="stable")
        self._index([rows[i] for i in order])

    def _index(self, rows: list[tuple[int, int]]) -> None:
        """Take these (shard, row), without those of pairs that failed."""
        self._open: dict[int, Shard] = {}
        known = [self._shard(number).index() for number in range(len(self._paths))]
        about = [{name: column[row] for name, column in known[number].items()} for number, row in rows]
        self.failures: list[tuple[str, str]] = [(a["identity"], a["reason"]) for a in about if a["reason"]]
        kept = [i for i, a in enumerate(about) if not a["reason"]]
        if self.failures:
            identity, reason = self.failures[0]
            message = (
                f"{len(self.failures)} of {len(rows)} pairs have no matches and are left out: {identity}: {reason}"
            )
            if not kept:
                raise ValueError(f"every pair failed: {message}")
            warnings.warn(message + ("; ..." if len(self.failures) > 1 else ""), stacklevel=3)
        self._rows = [rows[i] for i in kept]
        self.pairs: list[dict[str, Any]] = [about[i] for i in kept]

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> LabelledMatches:
        number, row = self._rows[index]
        arrays = self._shard(number).read(row)
        key = torch.tensor([self.pairs[index]["key"]], dtype=torch.int64)
        tensors = {name: torch.from_numpy(array.copy())[None] for name, array in arrays.items()}
        label, F = tensors.pop("label"), tensors.pop("F")
        if "mutual" in tensors:
            tensors["mutual"] = tensors["mutual"].to(torch.bool)
        mask = torch.ones_like(label, dtype=torch.bool)
        return LabelledMatches(Correspondences(mask=mask, key=key, **tensors), label, F)

    def _shard(self, number: int) -> Shard:
        """An open file; each process opens its own when it first reads."""
        if number not in self._open:
            self._open[number] = Shard(self._paths[number])
        return self._open[number]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}


def _pipeline(pipeline: Pipeline | str, overrides: Sequence[str]) -> Pipeline:
    if isinstance(pipeline, str):
        from fmtorch import presets  # the only room that reads YAML files, loaded when a name is given

        return presets.pipeline(pipeline, overrides=overrides)
    if overrides:
        raise ValueError("overrides change a pipeline that is given by name; this one is given as an object")
    return pipeline


def _uncached(extractor: object) -> object:
    """What computes the features, where a cache is around it."""
    return getattr(extractor, "extractor", extractor)


def _sound(path: Path) -> bool:
    """Whether a file is there and whole; of a damaged one a warning tells."""
    if not path.exists():
        return False
    try:
        Shard(path, verify=True)
    except ShardError as error:
        warnings.warn(f"{error}; it is computed anew", stacklevel=3)
        return False
    return True
