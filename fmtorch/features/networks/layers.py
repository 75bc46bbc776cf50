"""What the patch networks share: the trunk of convolutions and the normalisation of patches."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

PATCH_SIZE = 32
Layout = Sequence[tuple[int, int]]
"""Channels and stride of each 3 x 3 convolution before the last."""


def l2net_layout(width: int) -> Layout:
    """L2-Net's six 3 x 3 convolutions (Tian, Fan, Wu, CVPR 2017, fig. 2).

    width: channels of the first pair of convolutions; the second has twice, the third four times as many, and each of
    these two begins with stride 2.
    """
    return (width, 1), (width, 1), (2 * width, 2), (2 * width, 1), (4 * width, 2), (4 * width, 1)


def standardize(patches: Float[Tensor, "n 1 h w"], eps: float) -> Float[Tensor, "n 1 h w"]:
    """Each patch with zero mean and unit (sample) standard deviation; a constant patch becomes zero.

    The statistics are constants for the gradient, as in the authors' code: gradients through them are noise.
    """
    mean = patches.mean(dim=(1, 2, 3), keepdim=True).detach()
    centred = patches - mean
    count = patches.shape[-1] * patches.shape[-2]
    std = (centred.square().sum(dim=(1, 2, 3), keepdim=True) / (count - 1)).sqrt().detach()
    return centred / (std + eps)


def trunk(layout: Layout, dropout: float, outputs: int, *, bias: bool = False) -> list[nn.Module]:
    """Convolutions of 3 x 3 with batch norm and ReLU, then one over the whole of what is left.

    Batch norms have no learned scale or shift. bias: of the last convolution.
    """
    layers: list[nn.Module] = []
    channels = 1
    for out, stride in layout:
        layers += [
            nn.Conv2d(channels, out, kernel_size=3, stride=stride, padding=1, bias=False),
            nn.BatchNorm2d(out, affine=False),
            nn.ReLU(inplace=True),
        ]
        channels = out
    side = PATCH_SIZE // math.prod(stride for _, stride in layout)
    return [*layers, nn.Dropout(dropout), nn.Conv2d(channels, outputs, kernel_size=side, bias=bias)]


def orthogonal_(features: nn.Module, gain: float = 0.6) -> None:
    """The authors' initialisation: orthogonal weights, biases of 0.01."""
    for module in features.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.orthogonal_(module.weight, gain=gain)
            if module.bias is not None:
                nn.init.constant_(module.bias, 0.01)


def unit_length(x: Float[Tensor, "n d"], eps: float = 1e-10) -> Float[Tensor, "n d"]:
    """Vectors of unit Euclidean length; a zero vector stays zero, with a finite gradient."""
    return x / (x.square().sum(dim=1, keepdim=True) + eps).sqrt()


def as_float32(features: nn.Module, x: Tensor) -> Tensor:
    """The trunk's output as (N, D) float32, whatever the precision of autocast."""
    out: Tensor = features(x.to(memory_format=torch.channels_last))
    return out.flatten(1).float()
