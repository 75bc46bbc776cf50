import cv2
import numpy as np
import torch
from torch import Tensor

from fmtorch.features import rotate_frames, upright_frames


def texture(seed: int, h: int = 160, w: int = 200, sigma: float = 2.5) -> np.ndarray:
    smooth = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(h, w)), (0, 0), sigma)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def random_frames(seed: int, count: int, h: int, w: int, smallest: float = 4, largest: float = 60) -> Tensor:
    """Turned and stretched frames of many sizes, some of which leave the image."""
    rng = np.random.default_rng(seed)
    xy = torch.from_numpy(rng.uniform((0, 0), (w - 1, h - 1), (count, 2))).float()
    sigma = torch.from_numpy(np.exp(rng.uniform(np.log(smallest), np.log(largest), count)) / 6).float()
    lafs = rotate_frames(upright_frames(xy, sigma), torch.from_numpy(rng.uniform(-np.pi, np.pi, count)).float())
    stretch = torch.from_numpy(np.exp(rng.uniform(-0.6, 0.6, count))).float()[:, None]
    return torch.stack([lafs[..., 0] * stretch, lafs[..., 1] / stretch, lafs[..., 2]], -1)
