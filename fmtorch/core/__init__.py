"""What everything stands on: types, records, random numbers, threads, options, files."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.core.checks import checked
    from fmtorch.core.failures import own_traceback, place_of
    from fmtorch.core.files import claim, conf_dir, create, models_dir, replacing
    from fmtorch.core.onnx_network import NetworkFileError, onnx_session
    from fmtorch.core.options import Within, expect_options, fits
    from fmtorch.core.records import Record, arguments_of, arrays_of, expect_fields, slotted
    from fmtorch.core.stages import Estimator, FeatureExtractor, GreyPyramid, ImagePruner, Matcher, PairImages, Pruner
    from fmtorch.core.terminal import error_line, exits_with_message
    from fmtorch.core.types import PAIR_TYPES, RELATED, WARNINGS, Correspondences, Estimate, Features, collate, pair_key

__all__ = [
    "PAIR_TYPES", "RELATED", "WARNINGS", "Correspondences", "Estimate", "Estimator", "FeatureExtractor", "Features",
    "GreyPyramid", "ImagePruner", "Matcher", "NetworkFileError", "PairImages", "Pruner", "Record", "Within",
    "arguments_of", "arrays_of", "checked", "claim", "collate", "conf_dir", "create", "error_line",
    "exits_with_message", "expect_fields", "expect_options", "fits", "models_dir", "onnx_session",
    "own_traceback", "pair_key", "place_of", "replacing", "slotted",
]  # fmt: skip

lazy_exports(__name__)
