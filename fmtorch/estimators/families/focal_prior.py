"""How likely two focal lengths are: what they cost, and draws of them. All are logarithms, in units of the longer side.

Their mean is normal, and so is their difference, with a well at zero for images of one size: these mostly come from one
camera.
"""

from __future__ import annotations

from typing import Any

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.kernel import inner

USUAL_FOCAL = 1.2  # median focal length in units of the longer image side
FOCAL_DEVIATION = 0.4  # of its logarithm, averaged over the two images
RATIO_DEVIATION = 0.5  # of the logarithm of the two focal lengths' ratio, for images of different sizes
SAME_CAMERA_DEVIATION = 0.01  # width of the well for images of equal size
SAME_CAMERA_GAIN = 5.0  # its depth, in logarithms of the likelihood
SAME_CAMERA_SHARE = 0.7  # of the draws for images of equal size that have one focal length for both
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
