"""RootSIFT-PCA: RootSIFT projected on its principal components (Bursuc, Tolias and Jégou, ICMR 2015)."""

from __future__ import annotations

import dataclasses
import functools
import zipfile
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.resources import models_dir
from fmtorch.features.patch_sift import PatchSIFT, normalized
from fmtorch.features.patches import ImagePyramid

DIMENSIONS = 80  # of the paper's RootSIFT-PCA


@dataclasses.dataclass(frozen=True)
class RootSIFTPCA:
    """RootSIFT of frames, centred, projected to 80 dimensions, raised to a power, and normalised.

    model: the learned file with `mean` (128,) and `basis` (128, 80); None: the one that comes with the package.
    power: exponent of the entries' absolute values, which keep their signs; the authors' released code has 0.5.
    """

    model: Path | str | None = None
    power: float = 0.5

    def __post_init__(self) -> None:
        object.__setattr__(self, "model", Path(self.model) if self.model else models_dir() / "rootsift_pca.npz")

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]:
        """Descriptors (N, 80) of unit length.

        Raises FileNotFoundError where the learned file is absent, ValueError where it is not what it should be.
        """
        mean, basis = load_projection(Path(str(self.model)))
        return project(PatchSIFT(root=True)(pyramid, lafs), mean.to(lafs.device), basis.to(lafs.device), self.power)


def project(
    descriptors: Float[Tensor, "n 128"], mean: Float[Tensor, 128], basis: Float[Tensor, "128 d"], power: float
) -> Float[Tensor, "n d"]:
    """Centred, projected, signed power of each entry, unit length."""
    projected = (descriptors - mean) @ basis
    return normalized(projected.sign() * projected.abs() ** power)


def learn_projection(
    descriptors: Float[Tensor, "n D"], dimensions: int = DIMENSIONS
) -> tuple[Float[Tensor, " D"], Float[Tensor, "D d"]]:
    """Mean and the `dimensions` principal axes of descriptors, largest variance first; the largest entry positive."""
    x = descriptors.double()
    mean = x.mean(0)
    _, axes = torch.linalg.eigh((x - mean).T @ (x - mean) / len(x))
    basis = axes.flip(1)[:, :dimensions]
    sign = basis.gather(0, basis.abs().argmax(0, keepdim=True)).sign()
    return mean.float(), (basis * sign).float()


@functools.lru_cache(maxsize=8)
def load_projection(path: Path) -> tuple[Float[Tensor, 128], Float[Tensor, "128 d"]]:
    """Mean and basis of a learned file. Raises FileNotFoundError and ValueError that say how to make it."""
    remedy = "make it with `python scripts/make_models.py pca`"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; {remedy}")
    try:
        with np.load(path, allow_pickle=False) as file:
            mean, basis = (torch.from_numpy(file[name].astype(np.float32)) for name in ("mean", "basis"))
    except (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: no file with `mean` and `basis` ({error}); {remedy}") from error
    if mean.shape != (128,) or basis.dim() != 2 or len(basis) != 128:
        raise ValueError(
            f"{path}: mean {tuple(mean.shape)}, basis {tuple(basis.shape)} must be (128,), (128, D); {remedy}"
        )
    return mean, basis
