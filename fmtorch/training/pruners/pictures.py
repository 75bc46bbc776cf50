"""A picture of classified matches in TensorBoard's log, after each validation."""

from __future__ import annotations

from collections.abc import Sequence

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray

from fmtorch.data import ImagePair, read_image
from fmtorch.evaluation.pictures import draw_matches
from fmtorch.pipeline.labelled import LabelledMatches
from fmtorch.pruning.networks.learned import predict
from fmtorch.training.pruners.module import PrunerTraining

HEIGHT = 480  # px


class ValidationPictures(Callback):
    """Draws some validation pairs: matches with P(inlier) >= 0.5 green, the others thin and red.

    pairs: the pairs and their matches, batches of one.
    """

    def __init__(self, pairs: Sequence[tuple[ImagePair, LabelledMatches]]) -> None:
        self.pairs = list(pairs)

    @torch.no_grad()
    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Adds the pictures of the network's present state to the log."""
        assert isinstance(pl_module, PrunerTraining)
        if not isinstance(trainer.logger, TensorBoardLogger) or not trainer.is_global_zero:
            return
        board = trainer.logger.experiment
        for pair, matches in self.pairs:
            picture = classified(pair, matches, pl_module.network)
            board.add_image(pair.identity, picture, trainer.global_step, dataformats="HWC")


@torch.no_grad()
def classified(pair: ImagePair, matches: LabelledMatches, network: torch.nn.Module) -> NDArray[np.uint8]:
    """The two images of a pair with its matches as a network classifies them; RGB (H, W, 3)."""
    device = next((p.device for p in network.parameters()), torch.device("cpu"))
    training = network.training
    network.eval()
    c = matches.correspondences
    kept = (predict(network, c.to(device)).logit[-1, 0] >= 0).cpu().numpy()
    network.train(training)
    inside = c.mask[0].numpy()
    x0, x1 = (x[0].double().numpy()[inside] for x in (c.x0, c.x1))
    image0, image1 = read_image(pair.image0), read_image(pair.image1)
    names = ("P(inlier) >= 0.5", "below")
    return draw_matches(image0, image1, x0, x1, kept[inside], height=HEIGHT, names=names)
