"""Labelled matches of made-up two-view scenes: points seen by two cameras, and wrong partners."""

from __future__ import annotations

import math

import torch
from torch.utils.data import DataLoader, Dataset

from fmtorch.core.types import Correspondences
from fmtorch.geometry import fundamental_from_projections
from fmtorch.training import LabelledMatches, collate

SIZE = 480, 640
FOCAL = 600.0


def labelled_pair(number: int, matches: int = 60, outliers: float = 0.4) -> LabelledMatches:
    """A batch of one, a function of its number."""
    rng = torch.Generator().manual_seed(number)
    K = torch.tensor([[FOCAL, 0, (SIZE[1] - 1) / 2], [0, FOCAL, (SIZE[0] - 1) / 2], [0, 0, 1]], dtype=torch.float64)
    X = torch.rand(matches, 3, generator=rng, dtype=torch.float64) * torch.tensor([4.0, 3, 4]) + torch.tensor(
        [-2.0, -1.5, 4]
    )
    angle = 0.2 + 0.3 * float(torch.rand((), generator=rng))
    R = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    ).double()
    t = torch.tensor([-1.5, 0.2, 0.3], dtype=torch.float64)
    P0 = K @ torch.eye(3, 4, dtype=torch.float64)
    P1 = K @ torch.cat([R, t[:, None]], 1)
    x0, x1 = (_projected(P, X) for P in (P0, P1))
    wrong = torch.rand(matches, generator=rng) < outliers
    x1 = torch.where(wrong[:, None], torch.rand(matches, 2, generator=rng) * torch.tensor([640.0, 480.0]), x1)
    size = torch.tensor([SIZE])
    c = Correspondences(
        x0.float()[None], x1.float()[None], torch.ones(1, matches, dtype=torch.bool),
        quality=torch.rand(1, matches, generator=rng) * 0.8, size0=size, size1=size, K0=K[None], K1=K[None],
        key=torch.tensor([number]),
    )  # fmt: skip
    F = fundamental_from_projections(P0, P1)
    return LabelledMatches(c, (~wrong).to(torch.int8)[None], (F / F.norm())[None])


def _projected(P: torch.Tensor, X: torch.Tensor) -> torch.Tensor:
    x = torch.cat([X, torch.ones_like(X[:, :1])], 1) @ P.T
    return x[:, :2] / x[:, 2:]


class Pairs(Dataset[LabelledMatches]):
    """`count` made-up pairs."""

    def __init__(self, count: int, matches: int = 60) -> None:
        self.count, self.matches = count, matches

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> LabelledMatches:
        return labelled_pair(index, self.matches)


class Steps:
    """Batches of four, a function of the step."""

    def __init__(self, start: int, rank: int, processes: int, pairs: int) -> None:
        self.start, self.rank, self.processes, self.pairs = start, rank, processes, pairs

    def __iter__(self):
        step = self.start
        while True:
            yield [(4 * (self.processes * step + self.rank) + i) % self.pairs for i in range(4)]
            step += 1


def batches(step: int, rank: int = 0, processes: int = 1, pairs: int = 24) -> DataLoader[LabelledMatches]:
    """Training batches from a step on."""
    return DataLoader(Pairs(pairs), batch_sampler=Steps(step, rank, processes, pairs), collate_fn=collate)
