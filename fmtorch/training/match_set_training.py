"""The training of patch networks on match sets: the loop is `PatchTraining`'s, a batch is matches of several pairs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.features.networks import read_checkpoint
from fmtorch.jit import random
from fmtorch.jit.random import Stream
from fmtorch.training.match_sets import MAX_SIMILARITY, MatchSets, match_sets
from fmtorch.training.patch_loop import PatchTraining, TrainingOptions
from fmtorch.training.patch_objectives import DescriptorObjective
from fmtorch.training.track_store import TrackStore

MatchSetLoss = Callable[[Tensor, Tensor, Tensor], Tensor]
"""A loss of the descriptors (s, n, d), twice, of match sets and of the S_patch (s, n) of their matches."""


class MatchSetTraining(PatchTraining):
    """`PatchTraining` on batches of `options.batch` / `matches` match sets (Luo et al., ECCV 2018, section 3.4).

    matches: of each set, N_1 of the paper; max_similarity: of the photographs of a pair, above which it is left out.
    Each epoch is a random order of all sets.

    Raises ValueError where the batch is no multiple of `matches`, or larger than all sets together.
    """

    def __init__(
        self, network: nn.Module, loss: MatchSetLoss, store: TrackStore, options: TrainingOptions,
        description: dict[str, Any] | None = None, device: torch.device | str = "cpu",
        *, matches: int = 64, max_similarity: float = MAX_SIMILARITY,
    ) -> None:  # fmt: skip
        if options.batch % matches:
            raise ValueError(f"batch={options.batch} must be a multiple of match_sets.matches={matches}")
        self.matches, self.criterion = matches, loss
        self.sets: MatchSets = match_sets(store.tracks, matches, max_similarity)
        if options.batch > matches * len(self.sets):
            raise ValueError(f"batch={options.batch} is more than {matches} matches of the {len(self.sets)} sets")
        super().__init__(network, DescriptorObjective(self._unsupervised), store, options, description, device)

    def resume(self, path: Path | str) -> None:
        """As `PatchTraining.resume`; of other match sets it is refused, too."""
        theirs, mine = read_checkpoint(path).get("match_sets"), self.description.get("match_sets")
        if theirs != mine:
            raise ValueError(f"{path} was trained with match_sets {theirs}, not {mine}; start anew or take those")
        super().resume(path)

    def _loss(self, draws: Float[Tensor, "b k"]) -> Tensor:
        patches, similarity = self._matches()
        pairs = torch.from_numpy(np.asarray(self.store.patches[patches.flatten(1).numpy()])).unsqueeze(2).float() / 255
        objective = DescriptorObjective(functools.partial(self._of_sets, similarity.float().to(self.device)))
        return objective.loss(self.network, pairs.to(self.device), draws.to(self.device))

    def _of_sets(self, similarity: Tensor, a: Tensor, b: Tensor) -> Tensor:
        a, b = (x.reshape(*similarity.shape, -1) for x in (a, b))
        return self.criterion(a, b, similarity)

    def _unsupervised(self, a: Tensor, b: Tensor) -> Tensor:
        raise NotImplementedError("the loss of match sets needs the similarity of their patches")

    def _matches(self) -> tuple[Tensor, Tensor]:
        """This step's matches: indices (2, s, n) of their patches and their S_patch (s, n)."""
        seed, count = self.options.seed, self.options.batch // self.matches
        epoch, i = divmod(self.step, len(self.sets) // count)
        words = random.bits(seed + 1, torch.tensor([epoch]), Stream.TRAINING, 0, len(self.sets), 1)
        chosen = words.flatten().argsort(stable=True)[i * count : (i + 1) * count]
        numbers = random.uniform(seed + 2, torch.tensor([self.step]), Stream.TRAINING, 0, count, self.matches)[0]
        return self.sets.draw(chosen.tolist(), self.matches, numbers)
