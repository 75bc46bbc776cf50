"""AffNet and OriNet: grey patches to the affine shape and the orientation of their frame."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.features.networks.layers import Layout, as_float32, l2net_layout, orthogonal_, standardize, trunk


class AffNet(nn.Module):
    """AffNet (Mishkin, Radenovic, Matas, ECCV 2018): three numbers of an affine shape, each in (-1, 1).

    With x the output, the shape is the lower-triangular [[1 + x0, 0], [x1, 1 + x2]] in the patch's own coordinates, up
    to scale; x = 0 is a circle. The state_dict is that of the authors' release and of kornia's LAFAffNetShapeEstimator.
    """

    outputs = 3
    layout: Layout = l2net_layout(16)

    def __init__(self, dropout: float = 0.25) -> None:
        super().__init__()
        tail = (nn.Tanh(), nn.AdaptiveAvgPool2d(1))
        self.features = nn.Sequential(*trunk(self.layout, dropout, self.outputs, bias=True), *tail)
        orthogonal_(self.features)
        last = self.features[-1 - len(tail)]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        nn.init.zeros_(last.bias)

    def forward(self, patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n 3"]:
        """The three numbers of each patch."""
        return as_float32(self.features, standardize(patches, eps=1e-6))


class AffNetFast(AffNet):
    """AffNet with less than a quarter of its multiplications.

    The first convolution has stride 2 already, the widest has 32 channels.
    """

    layout: Layout = ((16, 2), (16, 1), (32, 2), (32, 1), (32, 1))


class OriNet(nn.Module):
    """OriNet (Mishkin, Radenovic, Matas, ECCV 2018): a vector (y, x) in (-1, 1)^2 whose atan2 is the orientation.

    The state_dict is that of the authors' release and of kornia.feature.OriNet.
    """

    outputs = 2

    def __init__(self, dropout: float = 0.25) -> None:
        super().__init__()
        tail = (nn.Tanh(), nn.AdaptiveAvgPool2d(1))
        layers = trunk(l2net_layout(16), dropout, self.outputs, bias=True)
        last = layers[-1]
        assert isinstance(last, nn.Conv2d)
        last.padding = (1, 1)  # nine positions, whose tanh is averaged
        self.features = nn.Sequential(*layers, *tail)
        orthogonal_(self.features)

    def forward(self, patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n 2"]:
        """The vector of each patch; its angle is atan2(first, second) in kornia's convention."""
        return as_float32(self.features, standardize(patches, eps=1e-8))
