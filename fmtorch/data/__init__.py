"""Data sets of image pairs."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float, Int

from fmtorch import presets
from fmtorch.core.lenses import MODELS, Lens, undistorted_points
from fmtorch.data.cameras import undistorted
from fmtorch.data.files import DataError, NpzArrays
from fmtorch.data.fmbench import FMBenchPairs
from fmtorch.data.image_cameras import ExifFocal, ImageCameras, exif_focal, read_model
from fmtorch.data.images import ImageError, read_image, stored_orientation, stored_size, to_grey
from fmtorch.data.pairs import DepthDataset, GivenMatches, ImagePair, ImageSource, PairDataset, subset

__all__ = [
    "MODELS", "DataError", "DepthDataset", "ExifFocal", "FMBenchPairs", "GivenMatches", "ImageCameras", "ImageError",
    "ImagePair", "ImageSource", "Lens", "NpzArrays", "PairBatch", "PairDataset", "build", "collate", "exif_focal",
    "load", "read_image", "read_model", "stored_orientation", "stored_size", "subset", "to_grey", "undistorted",
    "undistorted_points",
]  # fmt: skip

Progress = Callable[[int, int], None]


def load(
    name: str, split: str = "test", root: str | Path | None = None, progress: Progress | None = None, **options: Any
) -> PairDataset:
    """The data set ``conf/dataset/<name>.yaml``: an indexable of `ImagePair`, as torch's DataLoader takes it.

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


@dataclasses.dataclass(frozen=True, eq=False)
class PairBatch:
    """Several pairs and, stacked, their fundamental matrices (B, 3, 3) float64 and keys (B,)."""

    pairs: tuple[ImagePair, ...]
    F: Float[torch.Tensor, "b 3 3"]
    key: Int[torch.Tensor, " b"]

    def __len__(self) -> int:
        return len(self.pairs)


def collate(pairs: Sequence[ImagePair]) -> PairBatch:
    """A batch of pairs, for torch's DataLoader; images stay on disk."""
    F = torch.stack([torch.from_numpy(pair.F) for pair in pairs]) if pairs else torch.zeros(0, 3, 3).double()
    return PairBatch(tuple(pairs), F, torch.tensor([pair.key for pair in pairs], dtype=torch.int64))
