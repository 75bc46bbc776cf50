"""The engine's way from pairs to estimates, written once for both forms: tensors of pairs, and arrays of one pair."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from fmtorch.estimators.final_fits import Fit
from fmtorch.estimators.focal.cameras import TwoCameras
from fmtorch.estimators.one_pair.pair import Array, each_pair
from fmtorch.estimators.pairs import NormalizedPairs


class Outcome(NamedTuple):
    """Estimates of pairs, without gradients: their fit, inliers, which have a model, the samples drawn."""

    fit: Fit
    inliers: Bool[Tensor, "p n"]
    found: Bool[Tensor, " p"]
    draws: Int[Tensor, " p"]


@dataclasses.dataclass(frozen=True)
class Form:
    """Parts of one form. selected: search, refinement and selection. refit_inliers: told anew after the final fit."""

    selected: Callable[[Any], Any]
    inlier_rule: Any
    final: Any
    refit_inliers: bool

    def __call__(self, pairs: Any) -> Any:
        """An `Outcome`, or what one says of one pair in arrays."""
        selection = self.selected(pairs)
        inliers = self.inlier_rule(selection.matrices, pairs)
        fit = self.final.value(selection, pairs, inliers)
        if self.refit_inliers:
            inliers = self.inlier_rule(fit.F, pairs)
        return Outcome(fit, inliers, selection.found, selection.draws)


def pair_by_pair(form: Form, pairs: NormalizedPairs) -> Outcome:
    """The outcome of pairs on the CPU by a kernel form."""
    with np.errstate(all="ignore"):  # infinite or NaN beyond the range of a float, as in tensors
        solved = [form(pair) for pair in each_pair(pairs)]
    F, at = (torch.from_numpy(np.stack([getattr(one.fit, name) for one in solved])) for name in ("F", "at"))
    found, draws = (torch.tensor([getattr(one, name) for one in solved]) for name in ("found", "draws"))
    counted = _padded([one.fit.counted for one in solved], pairs)
    adapted = _adapted([one.fit for one in solved])
    return Outcome(Fit(F, at, counted, *adapted), _padded([one.inliers for one in solved], pairs), found, draws)


def _padded(rows: list[Array], pairs: NormalizedPairs) -> Bool[Tensor, "p n"]:
    """Flags of the matches of each pair, False in padded slots."""
    out = np.zeros(tuple(pairs.mask.shape), np.bool_)
    for place, row in zip(out, rows, strict=True):
        place[: len(row)] = row
    return torch.from_numpy(out)


def _adapted(fits: list[Any]) -> tuple[TwoCameras, Tensor] | tuple[()]:
    """The cameras and truncation distances of fits that are adapted to their pairs; nothing of others."""
    if fits[0].truncation is None:
        return ()
    axes, focal = (torch.from_numpy(np.stack([fit.cameras[i] for fit in fits], -1)) for i in (0, 1))
    return TwoCameras(axes.permute(1, 2, 0, 3), focal), torch.tensor(
        [fit.truncation for fit in fits], dtype=torch.float64
    )
