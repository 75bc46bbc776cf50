"""Networks that tell inliers from outliers: Correspondences -> Prediction."""

from fmtorch.pruning.networks.dfe import DFE
from fmtorch.pruning.networks.inputs import MatchInputs
from fmtorch.pruning.networks.lc import LC
from fmtorch.pruning.networks.learned import Exportable, Prediction, predict

__all__ = ["DFE", "LC", "Exportable", "MatchInputs", "Prediction", "predict"]
