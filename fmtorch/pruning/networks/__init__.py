"""Networks that tell inliers from outliers: Correspondences -> Prediction."""

from fmtorch.pruning.networks.architectures import DFE, LC, MatchInputs
from fmtorch.pruning.networks.learned import Exportable, Prediction, predict

__all__ = ["DFE", "LC", "Exportable", "MatchInputs", "Prediction", "predict"]
