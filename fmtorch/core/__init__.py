"""What everything stands on: types, records, random numbers, threads, options, files."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.core.files import conf_dir, models_dir
    from fmtorch.core.onnx_network import NetworkFileError
    from fmtorch.core.stages import (
        Estimator,
        FeatureExtractor,
        GreyPyramid,
        ImagePruner,
        Matcher,
        PairImages,
        Pruner,
        grey_pyramid,
    )
    from fmtorch.core.types import PAIR_TYPES, RELATED, WARNINGS, Correspondences, Estimate, Features, collate, pair_key

__all__ = [
    "PAIR_TYPES", "RELATED", "WARNINGS", "Correspondences", "Estimate", "Estimator", "FeatureExtractor", "Features",
    "GreyPyramid", "ImagePruner", "Matcher", "NetworkFileError", "PairImages", "Pruner", "collate", "conf_dir",
    "grey_pyramid", "models_dir", "pair_key",
]  # fmt: skip

lazy_exports(__name__)
