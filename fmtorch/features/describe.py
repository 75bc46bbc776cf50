"""Descriptors: SIFT of patches, its projections, and VLAD, one vector for an image from its local descriptors."""

import dataclasses
import functools
import math
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.files import models_dir
from fmtorch.features.patches import FRAME_SIGMAS, PATCH, ImagePyramid

# SIFT of patches, plain, as RootSIFT, and pooled over domain sizes; batched (Lowe, IJCV 2004, section 6)

CELLS, DIRECTIONS = 4, 8  # a grid of 4 x 4 histograms of 8 directions
CELL_SIGMAS = 3.0  # side of a cell in keypoint sigmas: vl_sift's magnification
EXTENT = CELL_SIGMAS * (CELLS + 1) / 2 / FRAME_SIGMAS  # half side of the patch in frames: votes reach half a cell on
WINDOW = CELLS / 2  # cells, sigma of the Gaussian window; Lowe, section 6.1
CLIP = 0.2  # largest entry of the normalised histogram; Lowe, section 6.1
SMOOTHING = 1.0  # keypoint sigmas, the blur at which gradients are taken: that of the level of detection
PATCH_BLUR = 0.75  # pixels, the blur that patches have from the pyramid
FLAT = 1e-6  # gradients below are the rounding of float32 intensities
CHUNK = 64  # patches worked on together: their histograms fit a core's cache


def root_sift(descriptors: Float[Tensor, "*batch n d"]) -> Float[Tensor, "*batch n d"]:
    """Square root of the L1-normalised descriptor: Euclidean distance becomes the Hellinger distance."""
    total = descriptors.sum(-1, keepdim=True)
    return (descriptors / torch.where(total > 0, total, 1.0)).sqrt()


@dataclasses.dataclass(frozen=True)
class PatchSIFT:
    """SIFT descriptors of frames; with several `sizes` the mean over them, DSP-SIFT (Dong and Soatto, CVPR 2015).
    root: RootSIFT (Arandjelovic and Zisserman, CVPR 2012) of each. smallest, largest: the range of domain sizes, in
    units of the frame. sizes: how many are sampled in it, evenly, both ends included."""

    root: bool = False
    smallest: float = 1.0
    largest: float = 1.0
    sizes: int = 1

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n 128"]:
        """Descriptors of unit length; zeros for a frame without gradient. In OpenCV's order."""
        total = lafs.new_zeros(len(lafs), CELLS * CELLS * DIRECTIONS)
        for size in torch.linspace(self.smallest, self.largest, self.sizes).tolist():
            scaled = torch.cat([lafs[..., :2] * (EXTENT * size), lafs[..., 2:]], -1)
            described = sift_of_patches(pyramid.extract(scaled))
            total = total + (root_sift(described) if self.root else described)
        return total if self.sizes == 1 else normalized(total)


def sift_of_patches(patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n 128"]:
    """SIFT of patches that cover `EXTENT` frames: gradients of the blurred patch vote, weighted by a Gaussian window.
    Each gradient votes for the two nearest directions and the four nearest cells; the histogram is normalised, clipped
    and normalised again. Entry (4 y + x) 8 + d: cell (x, y), direction 45 d degrees counter-clockwise on the screen."""
    pooling, along, across = _matrices(patches.device)
    parts = []
    for part in torch.split(patches[:, 0], CHUNK):
        gx, gy = across @ part @ along.T, along @ part @ across.T
        squared = (gx * gx + gy * gy).flatten(1)
        magnitude = torch.where(squared > FLAT * FLAT, squared, 0.0).sqrt()
        position = (torch.atan2(-gy, gx) * (DIRECTIONS / (2 * math.pi))).flatten(1)
        lower = position.floor()
        upper_weight = (position - lower) * magnitude
        lower_bin = lower.long() & (DIRECTIONS - 1)
        votes = part.new_zeros(len(part), DIRECTIONS, PATCH * PATCH)
        votes.scatter_(1, lower_bin[:, None], (magnitude - upper_weight)[:, None])
        votes.scatter_(1, ((lower_bin + 1) & (DIRECTIONS - 1))[:, None], upper_weight[:, None])
        parts.append((votes @ pooling).transpose(1, 2).flatten(1))
    histogram = torch.cat(parts) if parts else patches.new_zeros(0, CELLS * CELLS * DIRECTIONS)
    return normalized(normalized(histogram).clamp(max=CLIP))


def normalized(x: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
    """Rows of unit length; zero rows stay zero."""
    norm = torch.linalg.vector_norm(x, dim=1, keepdim=True)
    return x / torch.where(norm > 0, norm, 1.0)


@functools.cache
def _matrices(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Pooling (1024, 16) of the pixels' votes; blur with derivative, and blur, along an axis (32, 32)."""
    sigma_pixels = PATCH / (2 * EXTENT * FRAME_SIGMAS)  # a keypoint sigma
    x = torch.arange(PATCH, dtype=torch.float64)
    cell = CELL_SIGMAS * sigma_pixels
    centred = (x - (PATCH - 1) / 2) / cell
    centres = torch.arange(CELLS, dtype=torch.float64) - (CELLS - 1) / 2
    weight = (1 - (centred[:, None] - centres).abs()).clamp(min=0) * torch.exp(-0.5 * (centred / WINDOW) ** 2)[:, None]
    pooling = torch.einsum("yi,xj->yxij", weight, weight).reshape(PATCH * PATCH, CELLS * CELLS)
    sigma = math.sqrt(max((SMOOTHING * sigma_pixels) ** 2 - PATCH_BLUR**2, 1e-6))
    blur = torch.exp(-0.5 * ((x[:, None] - x) / sigma) ** 2)
    blur = torch.where(blur > 1e-8, blur, 0.0)  # denormal numbers would make the products ten times slower
    blur = blur / blur.sum(1, keepdim=True)
    derivative = torch.zeros(PATCH, PATCH, dtype=torch.float64)
    inner = torch.arange(1, PATCH - 1)
    derivative[inner, inner + 1], derivative[inner, inner - 1] = 0.5, -0.5
    return pooling.float().to(device), (derivative @ blur).float().to(device), blur.float().to(device)


# RootSIFT-PCA: RootSIFT projected on its principal components (Bursuc, Tolias and Jégou, ICMR 2015)

DIMENSIONS = 80  # of the paper's RootSIFT-PCA


@dataclasses.dataclass(frozen=True)
class RootSIFTPCA:
    """RootSIFT of frames, centred, projected to 80 dimensions, raised to a power, and normalised.
    model: the learned file with `mean` (128,) and `basis` (128, 80); None: the one that comes with the package.
    power: exponent of the entries' absolute values, which keep their signs; the authors' released code has 0.5."""

    model: Path | str | None = None
    power: float = 0.5

    def __post_init__(self) -> None:
        object.__setattr__(self, "model", Path(self.model) if self.model else models_dir() / "rootsift_pca.npz")

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]:
        """Descriptors (N, 80) of unit length.
        Raises FileNotFoundError where the learned file is absent, ValueError where it is not what it should be."""
        mean, basis = load_projection(Path(str(self.model)))
        return project(PatchSIFT(root=True)(pyramid, lafs), mean.to(lafs.device), basis.to(lafs.device), self.power)


def project(
    descriptors: Float[Tensor, "n 128"], mean: Float[Tensor, "128"], basis: Float[Tensor, "128 d"], power: float
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
    return mean.float(), (basis * basis.gather(0, basis.abs().argmax(0, keepdim=True)).sign()).float()


def read_learned(path: Path, names: Sequence[str], what: str, remedy: str) -> list[Tensor]:
    """Tensors of a learned file, `what` in messages. Raises FileNotFoundError, ValueError, which end with `remedy`."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; {remedy}")
    try:
        with np.load(path, allow_pickle=False) as file:
            return [torch.from_numpy(file[name].astype(np.float32)) for name in names]
    except (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: no file with {what} ({error}); {remedy}") from error


@functools.lru_cache(maxsize=8)
def load_projection(path: Path) -> tuple[Float[Tensor, "128"], Float[Tensor, "128 d"]]:
    """Mean and basis of a learned file. Raises FileNotFoundError and ValueError that say how to make it."""
    remedy = "make it with `python scripts/make_models.py pca`"
    mean, basis = read_learned(path, ("mean", "basis"), "`mean` and `basis`", remedy)
    if mean.shape != (128,) or basis.dim() != 2 or len(basis) != 128:
        shapes = f"mean {tuple(mean.shape)}, basis {tuple(basis.shape)}"
        raise ValueError(f"{path}: {shapes} must be (128,), (128, D); {remedy}")
    return mean, basis


# VLAD (Jégou, Douze, Schmid and Pérez, CVPR 2010). SIFT of any kind is taken as RootSIFT-PCA, so that two codebooks
# serve: one for it, and one for HardNet.

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
