"""The images of a folder, and the pairs of them that are asked for."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
EXHAUSTIVE, SEQUENTIAL, SIMILAR = "exhaustive", "sequential", "similar"
CHOICES = f"{EXHAUSTIVE}, {SEQUENTIAL}:N, {SIMILAR}:N"
# Pictures that fmtorch draws beside a result.json; a set of pairs holds copies of photographs.
_DRAWN = ("matches.png", "pruning.png", "epipolar.png")
_SET_OF_PAIRS = "pairs.json"

Pair = tuple[Path, Path]


def images_below(folder: Path) -> list[Path]:
    """The images of a folder, at any depth, by name; none that fmtorch itself has written, nor in hidden folders.

    Raises ValueError where there are fewer than two.
    """
    if not folder.is_dir():
        raise ValueError(f"images={folder} is no folder")
    images = sorted(_images(folder))
    if len(images) < 2:
        raise ValueError(f"images={folder} holds {len(images)} images ({', '.join(SUFFIXES)}); a pair needs two")
    return images


def _images(folder: Path) -> Iterator[Path]:
    for parent, folders, files in os.walk(folder):
        inside = Path(parent)
        folders[:] = [
            name for name in folders if not (name.startswith(".") or (inside / name / _SET_OF_PAIRS).is_file())
        ]
        drawn = _DRAWN if "result.json" in files else ()
        for name in files:
            path = inside / name
            if path.suffix.lower() in SUFFIXES and name not in drawn and path.is_file():
                yield path


def count_of(pairs: Path | str | None, kind: str) -> int | None:
    """The N of ``pairs=kind:N``; None where something else is asked for. Raises ValueError where N is no number."""
    name, colon, number = str(pairs or "").partition(":")
    if name != kind:
        return None
    if not colon or not number.isdecimal() or int(number) < 1:
        raise ValueError(f"pairs={pairs}; it must be {kind}:N with a whole number N of at least 1, as {kind}:10")
    return int(number)


def chosen_pairs(folder: Path, images: Sequence[Path], pairs: Path | None) -> list[Pair]:
    """All pairs of the images, neighbours in the order of their names, or those of a file.

    pairs: ``exhaustive`` or None, ``sequential:N`` (each image with the N next ones), or a text file with the names of
    two images a line, below the folder. There an empty line and one that begins with # is left out, and a pair that
    stands there again. Raises ValueError for anything else, naming file and line for what is no pair.
    """
    if pairs is None or str(pairs) == EXHAUSTIVE:
        return list(itertools.combinations(images, 2))
    if count := count_of(pairs, SEQUENTIAL):
        ordered = sorted(images, key=lambda path: natural_order(path.relative_to(folder).as_posix()))
        return [(a, b) for i, a in enumerate(ordered) for b in ordered[i + 1 : i + 1 + count]]
    if not pairs.is_file():
        raise ValueError(f"pairs={pairs}: no such file; it must be {CHOICES}, or a file with two names a line")
    return _listed_pairs(folder, images, pairs)


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """A sort key by which numbers in names count as numbers: a2.jpg comes before a10.jpg."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part.casefold()) for part in parts if part]


def _listed_pairs(folder: Path, images: Sequence[Path], pairs: Path) -> list[Pair]:
    known = {path.relative_to(folder).as_posix(): path for path in images}
    selected: dict[frozenset[Path], Pair] = {}
    for number, line in enumerate(pairs.read_text(encoding="utf-8").splitlines(), start=1):
        names = line.split()
        if not names or names[0].startswith("#"):
            continue
        where = f"{pairs}, line {number}"
        if len(names) != 2 or names[0] == names[1]:
            raise ValueError(f"{where}: {line.strip()!r}; it must be the names of two images")
        missing = [name for name in names if name not in known]
        if missing:
            raise ValueError(f"{where}: no image {missing[0]} in {folder}")
        pair = known[names[0]], known[names[1]]
        selected.setdefault(frozenset(pair), pair)
    if not selected:
        raise ValueError(f"{pairs} names no pair")
    return list(selected.values())


def in_blocks(pairs: Sequence[Pair], block: int) -> list[Pair]:
    """The pairs in an order that needs few images at a time: `block` first ones meet one second image after another."""
    number: dict[Path, int] = {}
    for pair in pairs:
        for image in pair:
            number.setdefault(image, len(number))
    return sorted(pairs, key=lambda pair: (number[pair[0]] // block, number[pair[1]], number[pair[0]]))
