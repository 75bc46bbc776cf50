"""Which photographs patch networks are trained on, and which are held out: always whole sources."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from fmtorch.scenes.textures import PICTURES, skimage_file

SUFFIXES = {".jpg", ".jpeg", ".png", ".ppm", ".tif", ".tiff"}
PACKAGE_SOURCE = "scikit-image"


@dataclasses.dataclass(frozen=True)
class Photograph:
    """A file and the source it comes from; photographs of one source never serve both training and validation."""

    path: Path
    source: str


def list_photographs(
    folder: Path | str, sources: Sequence[str] | None = None, excluded: Sequence[str] = ()
) -> list[Photograph]:
    """The photographs of a folder, in a fixed order.

    The source is the fourth column of ``sources.txt`` (file width height source path) where the folder has one, with
    the path appended after a colon for `excluded`; else the subfolder, or for files at the top the file itself.
    sources: only these; None: all. excluded: parts of "source:path" that are left out.
    Raises FileNotFoundError where the folder is absent, ValueError where nothing is left.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder of photographs")
    table = folder / "sources.txt"
    if table.is_file():
        rows = [line.split(maxsplit=4) for line in table.read_text().splitlines() if line and not line.startswith("#")]
        photographs = [(folder / row[0], row[3], f"{row[3]}:{row[4]}") for row in rows]
    else:
        files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
        names = [path.relative_to(folder) for path in files]
        photographs = [
            (path, str(name.parent if len(name.parts) > 1 else name), str(name))
            for path, name in zip(files, names, strict=True)
        ]
    kept = [
        Photograph(path, source)
        for path, source, full in photographs
        if (sources is None or source in sources) and not any(part in full for part in excluded)
    ]
    if not kept:
        raise ValueError(f"{folder}: none of its {len(photographs)} photographs is left by sources and excluded")
    return kept


def package_photographs() -> list[Photograph]:
    """Those that the scikit-image package brings, of the side that rendered training scenes use."""
    return [Photograph(skimage_file(name), PACKAGE_SOURCE) for name in PICTURES["train"]]


def split(photographs: Sequence[Photograph], held_out: Sequence[str]) -> tuple[list[Photograph], list[Photograph]]:
    """Training and validation photographs; ValueError where a held-out source does not exist or nothing is left."""
    known = {photograph.source for photograph in photographs}
    unknown = sorted(set(held_out) - known)
    if unknown:
        raise ValueError(f"held_out names {', '.join(unknown)}; the sources are {', '.join(sorted(known))}")
    train = [p for p in photographs if p.source not in held_out]
    validation = [p for p in photographs if p.source in held_out]
    if not train or not validation:
        raise ValueError("held_out must leave sources on both sides: training and validation")
    return train, validation
