"""Layers of OANet, CLNet and NCMNet from the definitions, at inference: one pair, no padding, features (C, n)."""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import batch_norm, instance_norm, scaled_dot_product_attention

from tests.reference.pruner_losses import EPS


def linear(layer: Any, x: Tensor) -> Tensor:
    return layer.weight @ x + layer.bias[:, None]


def batch_norm_relu(layer: Any, x: Tensor) -> Tensor:
    known = layer.running_mean, layer.running_var, layer.weight, layer.bias
    return torch.relu(batch_norm(x.T, *known, eps=EPS).T)


def context_batch_norm_relu(layer: Any, x: Tensor) -> Tensor:
    return batch_norm_relu(layer, instance_norm(x[None], eps=1e-3)[0])


def normed(layer: Any, x: Tensor) -> Tensor:
    return batch_norm_relu(layer.norm, linear(layer.linear, x))


def context(module: Any, x: Tensor) -> Tensor:
    """Clusters: means of all matches, by softmax over them; matches: those of all clusters, by softmax over these."""
    score = linear(module.linear0, context_batch_norm_relu(module.norm0, x))
    y = torch.stack([(x * torch.softmax(row, 0)).sum(1) for row in score], 1)
    for each in module.filters:
        z = linear(each.linear0, context_batch_norm_relu(each.norm0, y))
        z = z + linear(each.linear1, batch_norm_relu(each.norm1, z.T)).T
        y = y + linear(each.linear2, context_batch_norm_relu(each.norm2, z))
    score = linear(module.linear1, context_batch_norm_relu(module.norm1, x))
    return torch.stack([(y * torch.softmax(column, 0)).sum(1) for column in score.T], 1)


def neighbors(x: Tensor, count: int) -> list[list[int]]:
    """Of each match the nearest by distance, itself first; then itself again."""
    order = torch.cdist(x.T, x.T).argsort(stable=True).tolist()
    return [(nearest + [i] * count)[:count] for i, nearest in enumerate(order)]


def annular(module: Any, x: Tensor, nearest: list[list[int]]) -> Tensor:
    """Edges (x, x - y), as a convolution sees them: three in a row, without overlap, then all rings."""
    c = len(x)
    weight = module.edges.weight.view(c, 2 * c, 3)
    columns = []
    for i, around in enumerate(nearest):
        edges = torch.stack([torch.cat([x[:, i], x[:, i] - x[:, j]]) for j in around], 1)
        rings = [sum(weight[..., k] @ edges[:, first + k] for k in range(3)) for first in range(0, len(around), 3)]
        columns.append(batch_norm_relu(module.norm0, torch.stack(rings, 1) + module.edges.bias[:, None]).flatten())
    return normed(module.rings, torch.stack(columns, 1))


def graph(module: Any, x: Tensor, logit: Tensor) -> Tensor:
    weight = torch.relu(torch.tanh(logit))
    A = weight[:, None] * weight + torch.eye(len(weight), dtype=x.dtype)
    D = torch.diag(A.sum(1) ** -0.5)
    return normed(module.perceptron, x @ D @ A @ D)


def attention(query: Tensor, key: Tensor, value: Tensor, heads: int) -> Tensor:
    parts = zip(query.chunk(heads), key.chunk(heads), value.chunk(heads), strict=True)
    return torch.cat([scaled_dot_product_attention(q.T[None], k.T[None], v.T[None])[0].T for q, k, v in parts])


def pruned(logit: list[float], ratio: float) -> list[int]:
    order = sorted(range(len(logit)), key=lambda i: -logit[i])
    return order[: int(len(logit) * ratio)]
