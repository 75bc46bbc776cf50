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


def ngransac_log_probabilities(weights: dict[str, Tensor], x: Tensor) -> Tensor:
    """The network of Brachmann & Rother, "Neural-guided RANSAC", ICCV 2019, on one pair's input (n, 5)."""

    def linear(y: Tensor, name: str) -> Tensor:
        return weights[f"{name}.weight"][:, :, 0, 0] @ y + weights[f"{name}.bias"][:, None]

    def norm(y: Tensor, name: str) -> Tensor:
        running = (weights[f"{name}.running_mean"], weights[f"{name}.running_var"])
        mask = torch.ones(1, y.shape[1], dtype=torch.bool)
        affine = weights[f"{name}.weight"], weights[f"{name}.bias"]
        return context_batch_norm_relu(y[:, None], mask, *affine, running)[:, 0]

    y = torch.relu(linear(x.T, "p_in"))
    for block in range(12):
        z = norm(linear(y, f"{block}s0"), f"{block}s1")
        y = y + norm(linear(z, f"{block}s2"), f"{block}s3")
    return torch.nn.functional.logsigmoid(linear(y, "p_out")[0]).log_softmax(0)
