"""Networks that tell inliers from outliers: Correspondences -> Prediction."""

from fmtorch.pruning.networks.architectures import DFE, LC, ConvMatch, MatchInputs
from fmtorch.pruning.networks.learned import Exportable, Prediction, learned_file, predict
from fmtorch.pruning.networks.progressive import CLNet, NCMNet, OANet

__all__ = [
    "DFE", "LC", "CLNet", "ConvMatch", "Exportable", "MatchInputs", "NCMNet", "OANet", "Prediction", "learned_file",
    "predict",
]  # fmt: skip
