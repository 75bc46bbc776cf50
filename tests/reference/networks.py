"""Layers of learned pruners written from their definitions: one pair after the other, no mask, autograd's gradients."""

import torch
from torch import Tensor

EPS = 1e-5


def context_norm(x: Tensor) -> Tensor:
    """Of one pair, (C, n): each channel to mean 0 and variance 1 (Yi et al., CVPR 2018, eq. 2 and 3)."""
    mean = x.mean(1, keepdim=True)
    variance = (x - mean).square().mean(1, keepdim=True)
    return (x - mean) / (variance + EPS).sqrt()


def context_batch_norm_relu(
    x: Tensor, mask: Tensor, weight: Tensor, bias: Tensor, running: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Context norm pair by pair, batch norm over all matches of the batch, ReLU; x (C, B, N)."""
    pairs = [context_norm(x[:, b, mask[b]]) for b in range(x.shape[1])]
    together = torch.cat(pairs, 1)
    if running is None:
        mean = together.mean(1)
        variance = (together - mean[:, None]).square().mean(1)
    else:
        mean, variance = running
    normal = (together - mean[:, None]) / (variance + EPS).sqrt()[:, None]
    y = torch.relu(weight[:, None] * normal + bias[:, None])
    padded = torch.zeros_like(x)
    padded[:, mask] = y
    return padded
