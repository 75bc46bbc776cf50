"""Labelled matches: a data set of image pairs seen through a pipeline's first stages, for training and tuning."""

from fmtorch.matched.dataset import MatchedPairs
from fmtorch.matched.record import LabelledMatches, collate

__all__ = ["LabelledMatches", "MatchedPairs", "collate"]
