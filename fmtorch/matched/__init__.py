"""Labelled matches: a data set of image pairs seen through a pipeline's first stages, for training and tuning."""

from fmtorch.matched.augmentation import Augmentation
from fmtorch.matched.batches import Draw, SimilarLengthBatches, collate_trimmed
from fmtorch.matched.dataset import MatchedPairs
from fmtorch.matched.record import LabelledMatches, collate
from fmtorch.matched.stored import StoredMatches, split_scenes

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
