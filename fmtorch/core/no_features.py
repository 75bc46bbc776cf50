"""No features, for matchers that take the images themselves."""

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core.types import Features


@dataclasses.dataclass(frozen=True)
class NoFeatures:
    """An extractor that finds nothing. keep: nothing of it is worth a place in a cache."""

    keep = False

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        """No features of an image."""
        size = torch.tensor(image.shape[:2], dtype=torch.int64)
        return Features(torch.zeros(0, 2, 3), torch.zeros(0), torch.zeros(0, 0), size)
