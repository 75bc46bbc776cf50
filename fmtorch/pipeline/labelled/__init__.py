"""Labelled matches: a data set of image pairs seen through a pipeline's first stages, for training and tuning."""

from fmtorch.pipeline.labelled.augmentation import Augmentation
from fmtorch.pipeline.labelled.batches import Draw, SimilarLengthBatches, collate_trimmed
from fmtorch.pipeline.labelled.dataset import MatchedPairs
from fmtorch.pipeline.labelled.record import LabelledMatches, collate
from fmtorch.pipeline.labelled.stored import StoredMatches, split_scenes

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
