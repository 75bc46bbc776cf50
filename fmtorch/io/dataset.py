"""The data set `h5`: pairs whose matches somebody else computed, in the layouts that the field exchanges."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fmtorch.data.fmbench import FMBenchPairs
from fmtorch.data.pairs import ImagePair, PairDataset
from fmtorch.data.text_files import DataError, given_root
from fmtorch.io import h5
from fmtorch.io.predictions import hloc_pairs, predicted_pairs
from fmtorch.io.relative_poses import oanet_pairs, posebench_pairs, tutorial_files, tutorial_pairs

CORNER = 0.5  # where glue-factory puts the centre of the first pixel
WITH_GEOMETRY: Mapping[str, Callable[[Path, Path | None], Iterator[ImagePair]]] = {
    "ransac_tutorial": tutorial_pairs, "posebench": posebench_pairs, "oanet": oanet_pairs,
}  # fmt: skip
WITHOUT_GEOMETRY = {"hloc": 0.0, "glue_factory": CORNER, "vismatch": 0.0}
"""Layouts that hold matches alone, and where they put the centre of the first pixel."""
LAYOUTS = (*WITHOUT_GEOMETRY, *WITH_GEOMETRY)


class H5Pairs(PairDataset):
    """Pairs with given matches, which take the place of features and matcher.

    Args:
        root: the file, or the folder of the files, of the layout.
        layout: one of `LAYOUTS`.
        truth: for layouts without geometry, the folder of the `fmbench` set that they were computed on.
        images: folder of the images, for pictures and sizes, where the layout knows names of images.
        features, matches: names of hloc's two files in root; looked for when not given.
        origin: coordinates of the first pixel's centre; of the layout's convention when not given.

    What is wrong with one pair is that pair's `problem`, or its failure when it is read. Raises DataError for what is
    wrong with files as a whole.
    """

    name = "h5"

    def __init__(
        self,
        root: str | Path | None = None,
        layout: str = "hloc",
        truth: str | Path | None = None,
        images: str | Path | None = None,
        features: str | None = None,
        matches: str | None = None,
        origin: float | None = None,
    ) -> None:
        if layout not in LAYOUTS:
            raise DataError(f"no layout {layout!r}; it must be one of {', '.join(LAYOUTS)}")
        folder = given_root(root, "h5", "the file, or the folder of the files, that hold the matches")
        if not folder.exists():
            raise DataError(f"{folder}: no such file or folder")
        folder = folder.resolve()
        digest = hashlib.blake2b(digest_size=16)
        digest.update(repr((layout, origin)).encode())
        if layout in WITH_GEOMETRY:
            _expect_unset(layout, truth=truth, features=features, matches=matches, origin=origin)
            where = None if images is None else Path(images).expanduser()
            if where is not None and not where.is_dir():
                raise DataError(f"images={images}: no such folder; it must hold the images that the layout names")
            self._pairs = list(WITH_GEOMETRY[layout](folder, where))
            if where is not None:
                _expect_distinct(self._pairs, where)
            files = tutorial_files(folder) if layout == "ransac_tutorial" else h5.files(folder)
        else:
            _expect_unset(layout, images=images)
            known = _truth(layout, truth)
            digest.update(known.digest.encode())
            offset = WITHOUT_GEOMETRY[layout] if origin is None else origin
            if layout == "hloc":
                files = [_file_of_kind(folder, features, "features"), _file_of_kind(folder, matches, "matches")]
                self._pairs = list(hloc_pairs(known, files[0], files[1], offset))
            else:
                _expect_unset(layout, features=features)
                files = [_file_of_kind(folder, matches, "matches") if matches else _only(folder)]
                self._pairs = list(predicted_pairs(known, files[0], offset))
        for path in files:
            h5.add_to_digest(digest, path)
        if not self._pairs:
            raise DataError(f"{folder}: holds no pairs")
        self.digest = digest.hexdigest()

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> ImagePair:
        return self._pairs[index]


def _truth(layout: str, truth: str | Path | None) -> PairDataset:
    if truth is None:
        raise DataError(
            f"layout {layout} holds no geometry: give dataset.truth=DIR, the `fmbench` set that it was computed on"
        )
    return FMBenchPairs(truth)


def _expect_distinct(pairs: list[ImagePair], folder: Path) -> None:
    """Raises DataError where one file would stand for images of two scenes."""
    seen: dict[Path, str] = {}
    for pair in pairs:
        for image in (pair.image0, pair.image1):
            if image.path.exists() and seen.setdefault(image.path, pair.scene) != pair.scene:
                raise DataError(
                    f"{image.path} would stand for images of the scenes {seen[image.path]} and {pair.scene}: give each "
                    f"a folder, {folder / seen[image.path]} and {folder / pair.scene}"
                )


def _expect_unset(layout: str, **options: Any) -> None:
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise DataError(f"layout {layout} takes no {' or '.join(given)}")


def _file_of_kind(folder: Path, name: str | None, kind: str) -> Path:
    """The file of this name in the folder, or the only one whose name speaks of its kind."""
    if name is not None:
        path = folder / name
        if not path.is_file():
            raise DataError(f"{path}: no such file; dataset.{kind} must be a file in root")
        return path
    if not folder.is_dir():
        raise DataError(f"{folder}: must be the folder that holds hloc's two files")
    # hloc names matches after the features: feats-sift_matches-NN.h5
    files = [p for p in h5.files(folder) if ("match" in p.stem) == (kind == "matches")]
    files = [p for p in files if kind == "matches" or "feat" in p.stem or "keypoint" in p.stem] or files
    if len(files) != 1:
        names = ", ".join(p.name for p in files) or "none"
        raise DataError(f"{folder}: which file holds the {kind}? ({names}); give dataset.{kind}=NAME")
    return files[0]


def _only(root: Path) -> Path:
    files = h5.files(root)
    if len(files) != 1:
        raise DataError(f"{root}: holds {', '.join(p.name for p in files)}; give the file as root")
    return files[0]
