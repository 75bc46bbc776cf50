"""Patch networks as torch modules: (N, 1, 32, 32) grey patches to descriptors, affine shapes or orientations.

Their state_dicts are those of the authors' and kornia's releases, see `load_weights`.
"""

from fmtorch.features.networks.checkpoints import ARCHITECTURES, DESCRIPTORS, build, load_weights
from fmtorch.features.networks.descriptors import GeoDesc, HardNet, HardNetFast, L2Net
from fmtorch.features.networks.geometry import AffNet, AffNetFast, OriNet

__all__ = [
    "ARCHITECTURES", "DESCRIPTORS", "AffNet", "AffNetFast", "GeoDesc", "HardNet", "HardNetFast", "L2Net", "OriNet",
    "build", "load_weights",
]  # fmt: skip
