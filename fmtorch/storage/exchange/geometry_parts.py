"""Two-view geometries of a verification that is under way: a file a batch in one folder, until all are there."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from fmtorch.core.files import replacing
from fmtorch.core.settings import claim
from fmtorch.storage.exchange.two_view import Kind, PairGeometry

SETTINGS = "settings.json"
_MATRICES = ("F", "E", "H", "R", "t")

Ids = tuple[Any, Any]


class GeometryParts:
    """The folder, which any number of processes and shards of the same settings may write to.

    done: the pairs that it has. Raises ValueError where it holds geometries of other settings.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        claim(folder / SETTINGS, settings, "geometries", f"give the same, or delete {folder}")
        self.done: set[Ids] = set()
        for path in self._files():
            with np.load(path) as part:
                self.done.update(map(_ids, part["pairs"].tolist()))

    def write(self, geometries: Iterable[tuple[Ids, PairGeometry]]) -> None:
        """Keep geometries of pairs, all of them or none."""
        arrays: dict[str, Any] = {}
        pairs, kinds = [], []
        for i, (ids, geometry) in enumerate(geometries):
            pairs.append(ids)
            kinds.append(geometry.kind)
            values = {name: getattr(geometry, name) for name in ("inliers", *_MATRICES)}
            arrays |= {f"{name}-{i}": value for name, value in values.items() if value is not None}
        with replacing(self.folder / f"{uuid.uuid4().hex}.npz") as temporary, temporary.open("wb") as file:
            np.savez(file, pairs=np.array(pairs), kinds=np.array(kinds), **arrays)
        self.done.update(pairs)

    def read(self) -> Iterator[tuple[Ids, PairGeometry]]:
        """The geometries, each pair's once."""
        seen: set[Ids] = set()
        for path in self._files():
            with np.load(path) as part:
                for i, (pair, kind) in enumerate(zip(part["pairs"].tolist(), part["kinds"].tolist(), strict=True)):
                    if (ids := _ids(pair)) not in seen:
                        seen.add(ids)
                        yield ids, _geometry(part, i, str(kind))

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder)

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("*.npz"))


def _ids(ids: list[Any]) -> Ids:
    first, second = ids
    return first, second


def _geometry(part: Any, i: int, kind: str) -> PairGeometry:
    matrices = (part.get(f"{name}-{i}") for name in _MATRICES)
    return PairGeometry(cast(Kind, kind), part[f"inliers-{i}"], *matrices)
