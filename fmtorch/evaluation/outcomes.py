"""Outcomes of several pairs as batches on the CPU: metrics are float64, and so little work needs no GPU."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate, collate
from fmtorch.pipeline.pipeline import Outcome


def joined_correspondences(outcomes: Sequence[Outcome]) -> Correspondences:
    """Those of the outcomes that have some."""
    return collate([o.correspondences.to("cpu") for o in outcomes if o.correspondences is not None])


def joined_estimates(outcomes: Sequence[Outcome]) -> Estimate:
    """Those of the outcomes that have one."""
    return collate([o.estimate.to("cpu") for o in outcomes if o.estimate is not None])


def joined_true(outcomes: Sequence[Outcome]) -> Tensor:
    """The true F, (B, 3, 3) float64."""
    return torch.stack([torch.from_numpy(o.pair.F) for o in outcomes])
