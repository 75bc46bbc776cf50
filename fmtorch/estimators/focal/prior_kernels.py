"""How likely two focal lengths are, of the candidates of one pair, compiled: `prior.focal_cost`."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fmtorch.kernels import inner

Array = NDArray[Any]
USUAL_FOCAL, FOCAL_DEVIATION, RATIO_DEVIATION = 1.2, 0.4, 0.5  # these as in `prior`
SAME_CAMERA_DEVIATION, SAME_CAMERA_GAIN = 0.01, 5.0
LOG_USUAL = 0.1823215567939546  # math.log(USUAL_FOCAL)


@inner
def focal_cost(focal: Array, same_size: bool, out: Array) -> Any:
    """The cost of two log focal lengths; its gradient (2) and the two entries of its Hessian -> out (4,)."""
    difference = focal[0] - focal[1]
    squared = difference * difference
    mean = (focal[0] + focal[1]) * (0.5 / FOCAL_DEVIATION) - LOG_USUAL / FOCAL_DEVIATION
    well = (SAME_CAMERA_DEVIATION**2 if same_size else 0.0) / (squared + SAME_CAMERA_DEVIATION**2)
    precision = 1 / RATIO_DEVIATION**2 + 2 * SAME_CAMERA_GAIN / SAME_CAMERA_DEVIATION**2 * well * well
    b = 0.5 / FOCAL_DEVIATION
    pull = precision * difference
    out[0], out[1], out[2], out[3] = b * mean + pull, b * mean - pull, b * b + precision, b * b - precision
    return mean * mean / 2 + squared / (2 * RATIO_DEVIATION**2) - SAME_CAMERA_GAIN * well
