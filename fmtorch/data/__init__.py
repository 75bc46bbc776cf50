"""Data sets of image pairs."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch.core.options import expect_options
from fmtorch.data.fmbench import FMBenchPairs
from fmtorch.data.image_cameras import ExifFocal, exif_focal
from fmtorch.data.images import ImageError, read_image, to_grey
from fmtorch.data.pairs import DepthDataset, ImagePair, ImageSource, PairDataset
from fmtorch.data.text_files import DataError

__all__ = [
    "NEEDS_ROOT",
    "SCENE_SETS",
    "DataError",
    "DepthDataset",
    "ExifFocal",
    "FMBenchPairs",
    "ImageError",
    "ImagePair",
    "ImageSource",
    "PairBatch",
    "PairDataset",
    "collate",
    "exif_focal",
    "expect_loadable",
    "load",
    "model_of",
    "read_image",
    "to_grey",
]

_CLASSES = {
    "fmbench": ("fmtorch.data.fmbench", "FMBenchPairs"),
    "rendered": ("fmtorch.scenes", "RenderedPairs"),
    "stereo": ("fmtorch.scenes", "StereoPair"),
    "tum": ("fmtorch.data.tum", "tum_pairs"),
    "kitti": ("fmtorch.data.kitti", "KittiPairs"),
    "colmap": ("fmtorch.data.colmap", "colmap_pairs"),
    "bundler": ("fmtorch.data.bundler", "BundlerPairs"),
    "cameras": ("fmtorch.data.fmbench", "CameraFilePairs"),
    "pair_list": ("fmtorch.data.pair_list", "PairList"),
    "hpatches": ("fmtorch.data.hpatches", "HPatchesPairs"),
    "h5": ("fmtorch.io.dataset", "H5Pairs"),
}
NEEDS_ROOT = {
    "fmbench": "a set's folder with pairs_with_gt.txt, or a folder of such sets",
    "tum": "the folder of the sequences' folders of TUM RGB-D",
    "kitti": "the folder with sequences/ and poses/ of KITTI odometry",
    "colmap": "a folder of scenes with a COLMAP model each, or one such scene",
    "bundler": "a folder of scenes with list.txt and a Bundler file each, or one such scene",
    "cameras": "a folder of scenes with Camera.txt and Images/ each, or one such scene",
    "pair_list": "the folder of the images of dataset.file, the list",
    "hpatches": "the folder of the sequences, i_* and v_*",
    "h5": "the file, or the folder of the files, that hold the matches",
}
"""What `root` must be, by the names of the data sets that cannot do without."""
SCENE_SETS = ("tum", "kitti", "colmap", "bundler", "cameras")
"""The data sets of scenes with cameras, whose candidates `fmtorch pairs` judges."""
_WITHOUT_SPLIT = frozenset(("stereo", "pair_list", "hpatches", "h5"))
_GENERATED = frozenset(("rendered",))


def load(
    name: str,
    split: str = "test",
    root: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> PairDataset:
    """The data set `name`: an indexable of `ImagePair`, as torch's DataLoader takes it.

    Args:
        name: of the set: rendered, stereo, fmbench, tum, kitti, colmap, bundler, cameras, pair_list, hpatches, h5.
        split: `test` or `train`.
        root: where it lies, or for generated sets where they are kept.
        progress: called with (done, total) while a generated set is drawn for the first time.
        options: the data set's own.

    Raises:
        DataError: (a ValueError) for an unknown name or for data that cannot be used.

    Example:
        >>> from fmtorch.data import load
        >>> pair = load("stereo")[0]
        >>> pair.family, pair.F.shape
        ('stereo', (3, 3))
    """
    expect_loadable(name, split=split, root=root, **options)
    if root is not None:
        options["root"] = root
    elif name in NEEDS_ROOT:
        raise DataError(f"{name} needs root: {NEEDS_ROOT[name]}")
    if name not in _WITHOUT_SPLIT:
        options["split"] = split
    if name in _GENERATED and progress is not None:
        options["progress"] = progress
    return _class(name)(**options)


def expect_loadable(name: str, **options: Any) -> None:
    """Raises ValueError where there is no such data set, or it does not take these options of `load`."""
    if name not in _CLASSES:
        raise DataError(f"no data set {name!r}; there are {', '.join(_CLASSES)}")
    if name in _WITHOUT_SPLIT:
        options.pop("split", None)
    given = {key: value for key, value in options.items() if not (key == "root" and value is None)}
    expect_options(_class(name), given, "dataset", given=("root",))


def model_of(name: str) -> str:
    """What the pairs of a data set are related by: fundamental, or homography. Raises DataError for an unknown name."""
    if name not in _CLASSES:
        raise DataError(f"no data set {name!r}; there are {', '.join(_CLASSES)}")
    model: str = getattr(_class(name), "model", "fundamental")
    return model


def _class(name: str) -> Callable[..., PairDataset]:
    module, cls = _CLASSES[name]
    return cast(Callable[..., PairDataset], getattr(importlib.import_module(module), cls))


@dataclasses.dataclass(frozen=True, eq=False)
class PairBatch:
    """Several pairs and, stacked, their fundamental matrices (B, 3, 3) float64 and keys (B,)."""

    pairs: tuple[ImagePair, ...]
    F: Float[Tensor, "b 3 3"]
    key: Int[Tensor, " b"]

    def __len__(self) -> int:
        return len(self.pairs)


def collate(pairs: Sequence[ImagePair]) -> PairBatch:
    """A batch of pairs, for torch's DataLoader; images stay on disk."""
    F = torch.stack([torch.from_numpy(pair.F) for pair in pairs]) if pairs else torch.zeros(0, 3, 3).double()
    return PairBatch(tuple(pairs), F, torch.tensor([pair.key for pair in pairs], dtype=torch.int64))
