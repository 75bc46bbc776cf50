"""Patch networks as torch modules: (N, 1, 32, 32) grey patches to descriptors, affine shapes or orientations.

Their state_dicts are those of the authors' and kornia's releases, see `load_weights`.
"""

from fmtorch.features.networks.checkpoints import ARCHITECTURES, build, load_weights
from fmtorch.features.networks.descriptors import GeoDesc, HardNet, L2Net
from fmtorch.features.networks.geometry import AffNet, OriNet

__all__ = ["ARCHITECTURES", "AffNet", "GeoDesc", "HardNet", "L2Net", "OriNet", "build", "load_weights"]
