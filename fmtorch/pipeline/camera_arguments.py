"""What users say of cameras, as fields of `Correspondences`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from fmtorch.core.arguments import Arrays, as_tensor
from fmtorch.core.types import Correspondences
from fmtorch.geometry.square_pixels import calibration_problems

Focal = Literal["shared", "unknown"] | float | Arrays | Mapping[str, Any] | None
FORMS = "None, 'unknown', 'shared', (px, deviation) or ((px, deviation), (px, deviation))"
FORMS_WITH_K = "None, 'unknown', 'shared', or the relative deviations of the focal lengths of K: one, two, or (B, 2)"
UNKNOWN = (1.0, math.inf)  # px, relative deviation


def camera_fields(K0: Arrays | None, K1: Arrays | None, focal: Focal, sizes_known: bool) -> dict[str, Any]:
    """The fields K0, K1, focal, shared_focal of the arguments of `find_fundamental`; none where nothing is said.

    Raises ValueError or TypeError, naming the argument.
    """
    if K0 is None and K1 is None and (focal is None or isinstance(focal, Mapping)):
        return {}
    if not sizes_known and (K0 is None or K1 is None):
        missing = "focal" if K0 is None and K1 is None else "K1 alone" if K0 is None else "K0 alone"
        raise ValueError(f"{missing} needs the image sizes: give size0 and size1")
    fields: dict[str, Any] = {name: _floating(K, name) for name, K in (("K0", K0), ("K1", K1)) if K is not None}
    if isinstance(focal, str):
        return fields | _named(focal)
    return fields | {"focal": _deviations(focal, K0 is not None, K1 is not None) if fields else _measured(focal)}


def expect_calibrations(c: Correspondences) -> None:
    """Raise ValueError naming K0 or K1 where it is no calibration matrix of the image, of a single pair."""
    if len(c) != 1:
        return
    for name, K, size in (("K0", c.K0, c.size0), ("K1", c.K1, c.size1)):
        if K is not None and (problem := calibration_problems(K, size, name)[0]):
            raise ValueError(problem)


def _named(focal: str) -> dict[str, Any]:
    """Fields where no focal length is known."""
    if focal not in ("shared", "unknown"):
        raise ValueError(f"focal is {focal!r}; it must be {FORMS}")
    nothing = torch.tensor([UNKNOWN, UNKNOWN], dtype=torch.float64)
    return {"focal": nothing} if focal == "unknown" else {"focal": nothing, "shared_focal": torch.tensor(True)}


def _measured(focal: Any) -> Tensor:
    """Focal lengths and deviations (2, 2) or (B, 2, 2)."""
    if isinstance(focal, list | tuple):
        focal = [UNKNOWN if entry is None else entry for entry in focal]
    values = _floating(focal, "focal")
    if values.shape == (2,):
        values = values.expand(2, 2)
    if values.dim() not in (2, 3) or values.shape[-2:] != (2, 2):
        raise ValueError(f"focal has shape {tuple(values.shape)}; without K0 and K1 it must be {FORMS}")
    return values


def _deviations(focal: Any, known0: bool, known1: bool) -> Tensor:
    """Deviations of the focal lengths of K, in the place where they stand beside px: (2, 2) or (B, 2, 2)."""
    values = _floating(0.0 if focal is None or isinstance(focal, Mapping) else focal, "focal")
    values = values.expand(2) if values.shape in ((), (1,)) else values
    if values.dim() > 2 or values.shape[-1] != 2:
        raise ValueError(f"focal has shape {tuple(values.shape)}; with K0 or K1 it must be {FORMS_WITH_K}")
    if not bool((values >= 0).all()):
        raise ValueError(f"focal is {values.tolist()}; a relative deviation is not negative")
    known = torch.tensor([known0, known1], device=values.device)
    values = torch.where(known, values, torch.inf)
    return torch.stack([torch.ones_like(values), values], -1)


def _floating(value: Any, name: str) -> Tensor:
    tensor = as_tensor(value, name)
    return tensor if tensor.is_floating_point() else tensor.to(torch.float64)
