"""The training loop of patch networks: every step is a function of the seed and its number, so a run can be resumed.

A batch is points of a whole store, or matches of pairs of photographs (`MatchSetTraining`, as GeoDesc is trained).
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor, from_numpy, nn

from fmtorch.core.files import replacing
from fmtorch.features.networks import read_checkpoint
from fmtorch.jit import random
from fmtorch.jit.random import Stream
from scripts.patch_networks.objectives import DRAWS, DescriptorObjective, Objective
from scripts.patch_networks.patches import patch_similarity
from scripts.patch_networks.stores import PatchStore, Tracks

MAX_SIMILARITY = 0.85  # of the photographs of a pair: GeoDesc's authors leave out those that are more alike
OPTIMIZERS: dict[str, Callable[..., torch.optim.Optimizer]] = {
    "adam": torch.optim.Adam,
    "sgd": functools.partial(torch.optim.SGD, momentum=0.9, dampening=0.9),  # as the authors of HardNet do
}


@dataclasses.dataclass(frozen=True)
class TrainingOptions:
    """How a patch network is trained; the learning rate falls linearly to zero over the run.

    batch: points a step, with two patches each. steps: the run's length, or minutes where that is given: wall time that
    this run has spent in all its parts. optimizer: adam or sgd. bf16: autocast to bfloat16. checkpoint_steps,
    log_steps: how often to save, to log.
    """

    batch: int = 512
    steps: int = 5000
    minutes: float | None = None
    optimizer: str = "adam"
    learning_rate: float = 3e-3
    weight_decay: float = 1e-4
    seed: int = 0
    bf16: bool = True
    checkpoint_steps: int = 250
    log_steps: int = 50


class PatchTraining:
    """A network in training: `run` goes on to the end, or until a step; `save` keeps all that is needed."""

    def __init__(
        self, network: nn.Module, objective: Objective, store: PatchStore, options: TrainingOptions,
        description: dict[str, Any] | None = None, device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
        if options.batch > len(store):
            raise ValueError(f"batch={options.batch} is more than the {len(store)} points there are")
        if options.optimizer not in OPTIMIZERS:
            raise ValueError(f"optimizer={options.optimizer}; there are: {', '.join(OPTIMIZERS)}")
        self.network, self.objective, self.store, self.options = network.to(device), objective, store, options
        self.description, self.device = description or {}, torch.device(device)
        rates = {"lr": options.learning_rate, "weight_decay": options.weight_decay}
        self.optimizer = OPTIMIZERS[options.optimizer](self.network.parameters(), **rates)
        self.step, self.seconds, self.losses = 0, 0.0, list[float]()

    def resume(self, path: Path | str) -> None:
        """Go on from a checkpoint of a run with the same options; ValueError names what differs."""
        content = read_checkpoint(path)
        mine, theirs = dataclasses.asdict(self.options), content.get("options", {})
        changed = [k for k, v in mine.items() if k not in ("steps", "minutes") and theirs.get(k) != v]
        if content.get("match_sets") != self.description.get("match_sets"):
            changed.append("match_sets")
        if changed:
            raise ValueError(f"{path} was trained with other {', '.join(changed)}; start anew or take those options")
        self.network.load_state_dict(content["state_dict"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.step, self.seconds, self.losses = content["step"], content["seconds"], list(content["losses"])

    def run(
        self, until: int | None = None, checkpoint: Path | None = None, log: Callable[[str], None] | None = None
    ) -> None:
        """Train to the end, or to the step `until`. Raises FloatingPointError where the loss is no longer finite."""
        o = self.options
        last = time.perf_counter()
        self.network.train()
        while self.progress() < 1 and (until is None or self.step < until):
            for group in self.optimizer.param_groups:
                group["lr"] = o.learning_rate * (1 - self.progress())
            loss = self._one_step()
            if not torch.isfinite(loss):
                raise FloatingPointError(f"the loss is {float(loss)} at step {self.step}: lower the learning rate")
            self.losses.append(float(loss))
            self.step += 1
            now = time.perf_counter()
            self.seconds, last = self.seconds + now - last, now
            if log and self.step % o.log_steps == 0:
                recent = self.losses[-o.log_steps :]
                log(f"step {self.step} loss {sum(recent) / len(recent):.4f} seconds {self.seconds:.0f}")
            if checkpoint and self.step % o.checkpoint_steps == 0:
                self.save(checkpoint)
        if checkpoint:
            self.save(checkpoint)

    def progress(self) -> float:
        """The part of the run that is done, 0 to 1."""
        o = self.options
        return self.step / o.steps if o.minutes is None else self.seconds / (60 * o.minutes)

    def save(self, path: Path | str, **more: Any) -> None:
        """Write the checkpoint; a file that was there before is replaced when the new one is complete."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        content = {
            "state_dict": self.network.state_dict(), "optimizer": self.optimizer.state_dict(), "step": self.step,
            "seconds": self.seconds, "losses": self.losses, "options": dataclasses.asdict(self.options),
            "data": self.store.description, **self.description, **more,
        }  # fmt: skip
        with replacing(path) as unfinished:
            torch.save(content, unfinished)

    def _one_step(self) -> Tensor:
        o = self.options
        key = torch.tensor([self.step])
        draws = random.uniform(o.seed, key, Stream.TRAINING, 0, o.batch, DRAWS + 2)[0].float()
        torch.manual_seed(int(random.bits(o.seed, key, Stream.TRAINING, o.batch, 1, DRAWS + 2)[0, 0, 0]))  # dropout
        with torch.autocast(self.device.type, torch.bfloat16, enabled=o.bf16):
            loss = self._loss(draws)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        return loss.detach()

    def _loss(self, draws: Float[Tensor, "b k"]) -> Tensor:
        """The loss of this step's patches; `draws` are `DRAWS` random numbers of each point and two more."""
        pairs = self.store.views(self._selected(len(self.store), self.options.batch), draws[:, DRAWS:])
        return self.objective.loss(self.network, pairs.to(self.device), draws.to(self.device))

    def _selected(self, total: int, count: int) -> Int[Tensor, " b"]:
        """This step's points or match sets: each epoch is a random order of all."""
        epoch, i = divmod(self.step, total // count)
        return _order(self.options.seed + 1, epoch, total)[i * count : (i + 1) * count]


@functools.lru_cache(maxsize=2)
def _order(seed: int, epoch: int, total: int) -> Int[Tensor, " n"]:
    return random.bits(seed, torch.tensor([epoch]), Stream.TRAINING, 0, total, 1).flatten().argsort(stable=True)


@dataclasses.dataclass(frozen=True, eq=False)
class MatchSets:
    """The matches of pairs of photographs, set after set (Luo et al., GeoDesc, ECCV 2018, section 3.4).

    The patches that a loss compares with each other then come from one pair of photographs, as when a descriptor is
    used; pairs whose photographs are nearly alike are left out, since they teach little.

    patches: (2, k) indices of the two patches of each match. similarity: (k,) its S_patch. first: (s + 1,) where each
    set begins. image_similarity: (s,) the mean of a set's S_patch.
    """

    patches: NDArray[np.int64]
    similarity: NDArray[np.float64]
    first: NDArray[np.int64]
    image_similarity: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.first) - 1

    def draw(
        self, sets: Sequence[int], matches: int, numbers: Float[Tensor, "s n"]
    ) -> tuple[Int[Tensor, "2 s n"], Float[Tensor, "s n"]]:
        """n = `matches` different matches of each of the sets, as random numbers in [0, 1) choose them.

        Returns the indices of their patches and their S_patch.
        """
        rows = []
        for i, row in zip(sets, numbers.tolist(), strict=True):
            left = list(range(int(self.first[i]), int(self.first[i + 1])))
            for k in range(matches):  # Fisher and Yates
                other = k + int(row[k] * (len(left) - k))
                left[k], left[other] = left[other], left[k]
            rows.append(left[:matches])
        index = np.array(rows).reshape(len(rows), matches)
        return from_numpy(self.patches[:, index]), from_numpy(self.similarity[index])


def match_sets(tracks: Tracks, matches: int, max_similarity: float = MAX_SIMILARITY) -> MatchSets:
    """The sets of pairs of photographs that share at least `matches` points and are not more alike than allowed.

    S_image, the similarity of two photographs, is the mean S_patch of their shared points (section 3.3). In the order
    of the first photograph and then of the second; matches in the order of their points. Patches without a known
    incidence angle match nothing.

    Raises ValueError where no pair is left.
    """
    pairs = _pairs_of_points(tracks.first)
    pairs = pairs[:, np.isfinite(tracks.incidence)[pairs].all(0)]
    pairs = np.where(tracks.view[pairs[0]] > tracks.view[pairs[1]], pairs[::-1], pairs)
    a, b = pairs = pairs[:, np.lexsort((pairs[0], *tracks.view[pairs][::-1]))]
    similarity = patch_similarity(tracks.rays[a], tracks.rays[b], tracks.incidence[a], tracks.incidence[b])
    begins = np.flatnonzero(np.r_[True, (np.diff(tracks.view[pairs]) != 0).any(0)][: len(a)])
    counts = np.diff(np.r_[begins, len(a)])
    image = np.add.reduceat(similarity, begins) / counts if len(begins) else np.zeros(0)
    kept = (counts >= matches) & (image <= max_similarity)
    if not kept.any():
        raise ValueError(
            f"no pair of photographs shares {matches} points and has a similarity of at most {max_similarity}: "
            "lower match_sets.matches, or cut more points"
        )
    of_kept = np.repeat(kept, counts)
    return MatchSets(pairs[:, of_kept], similarity[of_kept], np.r_[0, np.cumsum(counts[kept])], image[kept])


def _pairs_of_points(first: NDArray[np.int64]) -> NDArray[np.int64]:
    """All pairs (2, k) of patches of the same point."""
    counts = np.diff(first)
    parts = [np.zeros((2, 0), np.int64)]
    for length in np.unique(counts[counts >= 2]):
        i, j = np.triu_indices(length, 1)
        start = first[:-1][counts == length][:, None]
        parts.append(np.stack([(start + i).ravel(), (start + j).ravel()]))
    return np.concatenate(parts, axis=1)


class MatchSetTraining(PatchTraining):
    """`PatchTraining` on batches of `options.batch` / `matches` match sets, each epoch a random order of all.

    loss: of the descriptors (s, n, d), twice, of match sets and of the S_patch (s, n) of their matches. matches: of
    each set, N_1 of the paper; max_similarity: of the photographs of a pair, above which it is left out.

    Raises ValueError where the store has no geometry, and where the batch is no multiple of `matches`, or larger than
    all sets together.
    """

    def __init__(
        self, network: nn.Module, loss: Callable[..., Tensor], store: PatchStore,
        options: TrainingOptions, description: dict[str, Any] | None = None, device: torch.device | str = "cpu",
        *, matches: int = 64, max_similarity: float = MAX_SIMILARITY,
    ) -> None:  # fmt: skip
        if store.tracks is None:
            raise ValueError("training.match_sets needs patches with their geometry: training.tracks")
        if options.batch % matches:
            raise ValueError(f"batch={options.batch} must be a multiple of match_sets.matches={matches}")
        self.matches, self.criterion = matches, loss
        self.sets = match_sets(store.tracks, matches, max_similarity)
        if options.batch > matches * len(self.sets):
            raise ValueError(f"batch={options.batch} is more than {matches} matches of the {len(self.sets)} sets")
        super().__init__(network, DescriptorObjective(loss), store, options, description, device)  # for its figures

    def _loss(self, draws: Float[Tensor, "b k"]) -> Tensor:
        seed, count = self.options.seed, self.options.batch // self.matches
        chosen = self._selected(len(self.sets), count).tolist()
        numbers = random.uniform(seed + 2, torch.tensor([self.step]), Stream.TRAINING, 0, count, self.matches)[0]
        patches, similarity = self.sets.draw(chosen, self.matches, numbers)
        similarity = similarity.float().to(self.device)

        def criterion(a: Tensor, b: Tensor) -> Tensor:
            a, b = (x.reshape(*similarity.shape, -1) for x in (a, b))
            return self.criterion(a, b, similarity)

        pairs = self.store.pairs(patches.flatten(1)).to(self.device)
        return DescriptorObjective(criterion).loss(self.network, pairs, draws.to(self.device))
