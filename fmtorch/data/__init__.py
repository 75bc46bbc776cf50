"""Data sets of image pairs."""

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

from fmtorch import presets
from fmtorch.core.lenses import MODELS, Lens, undistorted_points
from fmtorch.data.files import DataError, NpzArrays
from fmtorch.data.fmbench import FMBenchPairs
from fmtorch.data.image_cameras import ExifFocal, ImageCameras, exif_focal, read_model
from fmtorch.data.images import ImageError, read_image, stored_orientation, stored_size, to_grey
from fmtorch.data.pairs import DepthDataset, GivenMatches, ImagePair, ImageSource, PairDataset, undistorted

__all__ = [
    "MODELS", "DataError", "DepthDataset", "ExifFocal", "FMBenchPairs", "GivenMatches", "ImageCameras", "ImageError",
    "ImagePair", "ImageSource", "Lens", "NpzArrays", "PairDataset", "build", "exif_focal",
    "load", "read_image", "read_model", "stored_orientation", "stored_size", "to_grey", "undistorted",
    "undistorted_points",
]  # fmt: skip

Progress = Callable[[int, int], None]


def load(
    name: str, split: str = "test", root: str | Path | None = None, progress: Progress | None = None, **options: Any
) -> PairDataset:
    """The data set ``conf/dataset/<name>.yaml`` of `ImagePair`; for torch's DataLoader, with ``collate_fn=list``.

    Args:
        name: of the set: rendered, stereo, fmbench, tum, kitti, colmap, bundler, cameras, pair_list, hpatches, h5.
        split: `test` or `train`, of a set that has both.
        root: where it lies, or for generated sets where they are kept.
        progress: called with (done, total) while a generated set is drawn for the first time.
        options: in place of those of the file.

    Raises:
        ValueError: for an unknown name or option.
        DataError: (a ValueError) for data that cannot be used.

    Example:
        >>> from fmtorch.data import load
        >>> pair = load("stereo")[0]
        >>> pair.family, pair.F.shape
        ('stereo', (3, 3))
    """
    config = presets.load("dataset", name)
    return build({**config, **({"split": split} if "split" in config else {}), "root": root, **options}, progress)


def build(config: Mapping[str, Any], progress: Progress | None = None) -> PairDataset:
    """The data set of a config with a `_target_`; `progress`: called while it draws its images, if it does.
    Raises ValueError, naming the option, where the config does not fit its target, and what this raises itself."""
    reports = "progress" in inspect.signature(presets.target_of(config, "dataset")).parameters
    dataset: Any = presets.instantiate(config, "dataset", **({"progress": progress} if reports else {}))
    if missing := [name for name in ("name", "digest") if not hasattr(dataset, name)]:
        raise ValueError(f"{type(dataset).__name__} has no {' and no '.join(missing)}; a PairDataset has both")
    return cast(PairDataset, dataset)
