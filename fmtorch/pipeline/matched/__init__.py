"""Labelled matches: a data set of image pairs seen through a pipeline's first stages, for training and tuning."""

from fmtorch.pipeline.matched.augmentation import Augmentation
from fmtorch.pipeline.matched.batches import Draw, SimilarLengthBatches, collate_trimmed
from fmtorch.pipeline.matched.dataset import MatchedPairs
from fmtorch.pipeline.matched.record import LabelledMatches, collate
from fmtorch.pipeline.matched.stored import StoredMatches, split_scenes

__all__ = [
    "Augmentation",
    "Draw",
    "LabelledMatches",
    "MatchedPairs",
    "SimilarLengthBatches",
    "StoredMatches",
    "collate",
    "collate_trimmed",
    "split_scenes",
]
