"""HardNet, L2-Net, GeoDesc and a faster HardNet: grey patches to descriptors of 128 numbers and unit length."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.features.networks.layers import (
    PATCH_SIZE,
    Layout,
    as_float32,
    l2net_layout,
    orthogonal_,
    standardize,
    trunk,
    unit_length,
)


class HardNet(nn.Module):
    """HardNet (Mishchuk, Mishkin, Radenovic, Matas, NIPS 2017): L2-Net's layout, hardest-in-batch triplets.

    The state_dict is that of the authors' release and of kornia.feature.HardNet. Each patch is standardised inside.
    """

    outputs = 128
    layout: Layout = l2net_layout(32)

    def __init__(self, dropout: float = 0.3) -> None:
        super().__init__()
        layers = trunk(self.layout, dropout, self.outputs)
        self.features = nn.Sequential(*layers, nn.BatchNorm2d(self.outputs, affine=False))
        orthogonal_(self.features)

    def forward(self, patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n 128"]:
        """Descriptors of unit length; their Euclidean distance lies in [0, 2]."""
        return unit_length(as_float32(self.features, standardize(patches, eps=1e-6)))


class HardNetFast(HardNet):
    """HardNet with less than a quarter of its multiplications.

    The first convolution has stride 2 already, the widest has 64 channels.
    """

    layout: Layout = ((32, 2), (32, 1), (64, 2), (64, 1), (64, 1))


class L2Net(nn.Module):
    """L2-Net (Tian, Fan, Wu, CVPR 2017).

    Unlike HardNet's, its input loses the mean patch of the training set (`pixel_mean`) before each patch is
    standardised, and its output passes local response normalisation over all channels, that is division by the length.
    """

    outputs = 128
    pixel_mean: Tensor

    def __init__(self, dropout: float = 0.1) -> None:
        super().__init__()
        self.register_buffer("pixel_mean", torch.zeros(1, 1, PATCH_SIZE, PATCH_SIZE))
        layers = trunk(l2net_layout(32), dropout, self.outputs)
        self.features = nn.Sequential(*layers, nn.BatchNorm2d(self.outputs, affine=False))
        orthogonal_(self.features)

    def forward(self, patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n 128"]:
        """Descriptors of unit length (the release's normalisation with kappa 0, alpha 1 and beta 1/2)."""
        return unit_length(as_float32(self.features, standardize(patches - self.pixel_mean, eps=1e-12)))


class GeoDesc(nn.Module):
    """GeoDesc (Luo et al., ECCV 2018): L2-Net's layout without a batch norm after the last convolution.

    Each patch is standardised by itself, as in the authors' training code (lzx551402/tfmatch, cnn_wrapper/descnet.py);
    there is no dropout.
    """

    outputs = 128

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(*trunk(l2net_layout(32), 0.0, self.outputs))
        orthogonal_(self.features)

    def forward(self, patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n 128"]:
        """Descriptors of unit length."""
        return unit_length(as_float32(self.features, standardize(patches, eps=1e-6)))
