"""VLAD: one vector for an image from its local descriptors (Jégou, Douze, Schmid and Pérez, CVPR 2010).

SIFT of any kind is taken as RootSIFT-PCA, so that two codebooks serve: one for it, and one for HardNet.
"""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.files import models_dir
from fmtorch.features.sift import load_projection, normalized, project, read_learned, root_sift

Kind = Literal["sift", "rootsiftpca", "hardnet"]
POWER = 0.5  # of RootSIFT-PCA's entries, as `features=rootsiftpca` has it
_SIFT_CLASSES = ("SIFT", "ASIFT", "VLFeatSIFT")
_KINDS: Mapping[str, Kind] = {
    **dict.fromkeys(("sift", "rootsift", "dspsift"), "sift"), "rootsiftpca": "rootsiftpca",
    **dict.fromkeys(("hardnet", "hardnet_fast"), "hardnet"),  # the latter was taught to give the former's descriptors
}  # fmt: skip


class Codebook(NamedTuple):
    """centers: (k, d) of local descriptors, after they were centred by `mean` (D,) and projected by `basis` (D, d)."""

    mean: Float[Tensor, " D"]
    basis: Float[Tensor, "D d"]
    centers: Float[Tensor, "k d"]


def descriptor_kind(options: Mapping[str, Any]) -> Kind:
    """Of which kind the descriptors of a config of features are. Raises ValueError where no codebook fits them."""
    target = str(options.get("_target_", "")).rpartition(".")[2]
    descriptor = options.get("descriptor")
    name = str(descriptor.get("name") if isinstance(descriptor, Mapping) else descriptor)
    kind = "sift" if target in _SIFT_CLASSES else _KINDS.get(name)
    if kind is None:
        raise ValueError(
            f"there is no codebook for the descriptors {name if descriptor else target or 'of these features'}; "
            "it must be a pipeline with SIFT, RootSIFT, DSP-SIFT, RootSIFT-PCA or HardNet"
        )
    return kind


@functools.cache
def codebook(kind: Kind) -> Codebook:
    """The codebook that comes with the package. Raises FileNotFoundError, ValueError that say how to make it."""
    return load_codebook(models_dir() / ("vlad_hardnet.npz" if kind == "hardnet" else "vlad_rootsift_pca.npz"))


def load_codebook(path: Path) -> Codebook:
    """The codebook of a learned file. Raises FileNotFoundError and ValueError that say how to make it."""
    remedy = "make it with `python scripts/make_models.py codebooks`"
    book = Codebook(*read_learned(path, Codebook._fields, ", ".join(Codebook._fields), remedy))
    if book.basis.shape != (len(book.mean), book.centers.shape[-1]):
        raise ValueError(f"{path}: mean, basis and centers do not fit; {remedy}")
    return book


def local_descriptors(descriptors: Float[Tensor, "n D"], kind: Kind) -> Float[Tensor, "m d"]:
    """What VLAD is made of: RootSIFT-PCA of SIFT, others as they are; without those that are zero or not finite."""
    sound = torch.isfinite(descriptors).all(-1) & (descriptors != 0).any(-1)
    values = descriptors[sound].detach().cpu().float()
    if kind != "sift":
        return values
    mean, basis = load_projection(models_dir() / "rootsift_pca.npz")
    return project(root_sift(values), mean, basis, POWER)


def vlad(descriptors: Float[Tensor, "n D"], book: Codebook) -> Float[Tensor, " kd"]:
    """The vector of an image, of unit length: sums of residuals from the nearest centres; zeros without descriptors.
    Each centre's sum is normalised (Arandjelović and Zisserman, CVPR 2013, section 4), then entries are replaced by
    their signed square roots. The inner product of two vectors says how similar their images are."""
    x = (descriptors - book.mean) @ book.basis
    nearest = torch.cdist(x, book.centers).argmin(-1)
    sums = torch.zeros_like(book.centers).index_add_(0, nearest, x)
    counts = torch.bincount(nearest, minlength=len(book.centers))
    residuals = normalized(sums - counts[:, None] * book.centers)
    return normalized((residuals.sign() * residuals.abs().sqrt()).flatten()[None])[0]


def image_vector(descriptors: Float[Tensor, "n D"], kind: Kind) -> Float[Tensor, " kd"]:
    """The VLAD vector of an image by the package's codebook, on the CPU; zeros without descriptors."""
    return vlad(local_descriptors(descriptors, kind), codebook(kind))
