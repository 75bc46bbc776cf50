"""How well descriptors tell points apart: FPR at 95 % recall, mean average precision, nearest-neighbour accuracy."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.jit import random
from fmtorch.jit.random import Stream
from fmtorch.training.patch_losses import distances
from fmtorch.training.patch_store import PatchStore

Describe = Callable[[Tensor], Tensor]
GALLERY = 1000


def fpr_at_recall(positive: Float[Tensor, " n"], negative: Float[Tensor, " m"], recall: float = 0.95) -> float:
    """Share of negatives at most as far apart as the positive distance below which `recall` of the positives lie."""
    threshold = positive.sort().values[max(0, -(-int(recall * 1e9) * len(positive) // 10**9) - 1)]
    return float((negative <= threshold).double().mean())


def patch_quality(a: Float[Tensor, "n d"], b: Float[Tensor, "n d"]) -> dict[str, float]:
    """Figures from two unit descriptors of each of n >= 2 points.

    fpr95: negatives are each point with the next one's other patch. map: each patch of `a` asks for its own among
    `GALLERY` patches of `b` (its block; the last block may be smaller); with one right answer average precision is the
    inverse of its rank, where equals count against it. accuracy: how often it ranks first.
    """
    positive = (a - b).square().sum(1).clamp_min(0).sqrt()
    negative = (a - b.roll(1, 0)).square().sum(1).clamp_min(0).sqrt()
    ranks = []
    for start in range(0, len(a), GALLERY):
        d = distances(a[start : start + GALLERY], b[start : start + GALLERY])
        ranks.append((d <= d.diagonal()[:, None]).sum(1).double())
    rank = torch.cat(ranks)
    return {
        "fpr95": fpr_at_recall(positive, negative),
        "map": float((1 / rank).mean()),
        "accuracy": float((rank == 1).double().mean()),
    }


def validation_pairs(store: PatchStore, count: int, seed: int = 0) -> Float[Tensor, "2 n 1 h w"]:
    """Two patches each of up to `count` points of a store, in random order: always the same for one seed."""
    n = len(store)
    key = torch.zeros(1, dtype=torch.int64)
    points = random.bits(seed, key, Stream.TRAINING, 0, n, 1).flatten().argsort(stable=True)[:count]
    return store.views(points, random.uniform(seed + 1, key, Stream.TRAINING, 0, len(points), 2)[0])


def middle(patches: Float[Tensor, "*b h w"], size: int = 32) -> Float[Tensor, "*b size size"]:
    """The middle of patches that were cut with their surroundings."""
    top, left = (patches.shape[-2] - size) // 2, (patches.shape[-1] - size) // 2
    return patches[..., top : top + size, left : left + size]


@torch.no_grad()
def describe_in_batches(
    describe: Describe, patches: Float[Tensor, "n 1 h w"], batch: int = 256
) -> Float[Tensor, "n d"]:
    """A network's output for many patches."""
    return torch.cat([describe(part) for part in torch.split(patches, batch)])


def evaluate_descriptor(describe: Describe, pairs: Float[Tensor, "2 n 1 h w"]) -> dict[str, float]:
    """`patch_quality` of a descriptor on validation pairs."""
    return patch_quality(*(describe_in_batches(describe, middle(patches)) for patches in pairs))
