"""Rules for the values of what travels between the stages, which hold of arrays and of tensors."""

from __future__ import annotations

import torch

from fmtorch.core.annotations import Rule

PROBABILITY = Rule(lambda prior: (prior >= 0) & (prior <= 1), "it is P(inlier), within [0, 1]")
DEVIATION = Rule(lambda noise: noise > 0, "it is a standard deviation, positive")
SIZE = Rule(lambda size: (size > 0) & (size < torch.inf), "image sizes (h, w) are positive")
FOCAL = Rule(
    lambda focal: (
        (focal[..., 1] == torch.inf) | ((focal[..., 1] >= 0) & (focal[..., 0] > 0) & (focal[..., 0] < torch.inf))
    ),
    "it is a positive focal length in pixels and a relative deviation, 0 if exact, infinite if unknown",
)
