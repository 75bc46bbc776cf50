"""The oriented epipolar constraint: what lies before both cameras is on the same side of the epipolar geometry."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import as_rows, cross

_COLUMNS = (0.618, 0.414)  # of a generic combination, so that no usual epipole makes both columns parallel


def consistently_oriented(F: Float[Tensor, " 9 *s"], points: Float[Tensor, " 4 n *t"]) -> Bool[Tensor, "*s"]:
    """Whether ``F x0`` and ``e1 x x1``, the same epipolar line, point the same way for all matches of a sample.

    Chum, Werner & Matas, "Epipolar geometry estimation via RANSAC benefits from the oriented epipolar constraint"
    (ICPR 2004). A model through a wrong match mostly fails, so a look at the sample alone tells most wrong models.
    F: rank-two matrices, row by row. points: x0, y0, x1, y1 of the matches that a model was made from; *t broadcasts
    against *s.
    """
    f = as_rows(F)
    u, v = _COLUMNS
    ex, ey, ez = cross(f[:, 0] + u * f[:, 2], f[:, 1] + v * f[:, 2])  # across all columns: the left epipole
    x0, y0, x1, y1 = points
    a, b = f[0, 0] * x0 + f[0, 1] * y0 + f[0, 2], f[1, 0] * x0 + f[1, 1] * y0 + f[1, 2]
    agreement = a * (ey - ez * y1) + b * (ez * x1 - ex)
    one_sided: Tensor = (agreement.amin(0) > 0) | (agreement.amax(0) < 0)
    return one_sided
