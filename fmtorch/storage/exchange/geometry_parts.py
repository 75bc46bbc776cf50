"""Two-view geometries of the shards of one verification, a file a batch in one folder, until they are merged."""

from __future__ import annotations

import json
import shutil
import uuid
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from fmtorch.core.files import replacing
from fmtorch.storage.exchange.two_view import Kind, PairGeometry

SETTINGS = "settings.json"
_MATRICES = ("F", "E", "H", "R", "t")

Ids = tuple[Any, Any]


class GeometryParts:
    """The folder, which any number of shards of the same settings may write to.

    Raises ValueError where it holds geometries of other settings.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        wanted = json.dumps(settings, sort_keys=True)
        folder.mkdir(exist_ok=True)
        file = folder / SETTINGS
        if not file.exists():
            with replacing(file) as temporary:
                temporary.write_text(wanted, encoding="utf-8")
        if file.read_text(encoding="utf-8") != wanted:
            raise ValueError(f"{folder} holds shards of other settings or matches; give the same, or delete the folder")
        self.done: set[Ids] = {ids for part in self.read() for ids, _ in part}

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

    def read(self) -> Iterator[list[tuple[Ids, PairGeometry]]]:
        """The geometries, part by part."""
        for path in sorted(self.folder.glob("*.npz")):
            with np.load(path) as part:
                yield [
                    (_ids(ids), _geometry(part, i, str(kind)))
                    for i, (ids, kind) in enumerate(zip(part["pairs"].tolist(), part["kinds"].tolist(), strict=True))
                ]

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder)


def _ids(ids: list[Any]) -> Ids:
    first, second = ids
    return first, second


def _geometry(part: Any, i: int, kind: str) -> PairGeometry:
    matrices = (part.get(f"{name}-{i}") for name in _MATRICES)
    return PairGeometry(cast(Kind, kind), part[f"inliers-{i}"], *matrices)
