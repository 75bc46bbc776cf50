"""What everything stands on: types, records, random numbers, threads, options, files."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.core.files import conf_dir, models_dir, replacing
    from fmtorch.core.grey_pyramid import grey_pyramid
    from fmtorch.core.stages import Estimator, FeatureExtractor, ImagePruner, Matcher, PairImages, Pruner
    from fmtorch.core.types import PAIR_TYPES, RELATED, WARNINGS, Correspondences, Estimate, Features, collate, pair_key

__all__ = [
    "PAIR_TYPES", "RELATED", "WARNINGS", "Correspondences", "Estimate", "Estimator", "FeatureExtractor", "Features",
    "ImagePruner", "Matcher", "PairImages", "Pruner", "collate", "conf_dir", "grey_pyramid", "models_dir",
    "pair_key", "replacing",
]  # fmt: skip

lazy_exports(__name__)
