"""Training batches as one endless sequence, each a function of (seed, step, rank), so that it can start anywhere."""

from __future__ import annotations

from collections.abc import Iterator

from torch.utils.data import DataLoader, Sampler

from fmtorch.pipeline.labelled import Draw, LabelledMatches, SimilarLengthBatches, StoredMatches, collate_trimmed


class EndlessBatches(Sampler[list[Draw]]):
    """Epoch after epoch of `batches`, from the batch of a given step on."""

    def __init__(self, batches: SimilarLengthBatches, step: int) -> None:
        self.batches, self.step = batches, step

    def __iter__(self) -> Iterator[list[Draw]]:
        self.batches.set_epoch(0)
        epoch, start = divmod(self.step, len(self.batches))
        while True:
            self.batches.set_epoch(epoch, start)
            yield from self.batches
            epoch, start = epoch + 1, 0


def training_batches(
    matches: StoredMatches, batch: int, seed: int, step: int, rank: int = 0, processes: int = 1, *, workers: int = 0
) -> DataLoader[LabelledMatches]:
    """A loader of augmented batches from `step` on, which never ends.

    Args:
        matches: with the augmentation of the training.
        batch: pairs in a batch of one process. seed: selects batches and augmentation. step: steps done so far.
        rank, processes: of a distributed training. workers: processes that load; 0: this one.
    """
    lengths = None if matches.augmentation is None else matches.augmentation.matches
    similar = SimilarLengthBatches(matches, batch, seed=seed, matches=lengths, rank=rank, world_size=processes)
    return DataLoader(
        matches, batch_sampler=EndlessBatches(similar, step), collate_fn=collate_trimmed, num_workers=workers,
        persistent_workers=workers > 0,
    )  # fmt: skip
