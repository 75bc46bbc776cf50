"""A score that saturates where matches crowd, so that no single textured plane outvotes the rest of the image."""

from __future__ import annotations

import functools
import math

import numpy as np

from fmtorch.compiling.arrays import Array, F4x2, F8x1, F8x2, I4x2, I8x1
from fmtorch.compiling.kernel import Kernel, kernel
from fmtorch.compiling.lanes import added, sqrt, store
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.parts.scored_matches import fractional_bits, scored_matches
from fmtorch.estimators.parts.scores import (
    ZERO,
    GemanMcClure,
    check_threshold,
    geman_mcclure,
    rounded,
)
from fmtorch.geometry.residual_kernels import HOMOGRAPHY, MATCH, SAMPSON, SINGLES, TINY32, Residual, fill, load

GRID = 12  # cells along each side of each image
CELL_ROWS = 2 * GRID * GRID // SINGLES


class SaturatedGains:
    """The sum over grid cells of ``sqrt(sum of P g(r))``, over both images; g is the gain of Geman & McClure.

    Saturates where matches crowd, so that a model which explains the whole image beats one that explains a single
    textured plane. The narrow peak of g tells exact models from those nearby, and its tail lets one scale serve scenes
    of different noise. The grid is that of the box around the matches of weight.
    threshold: the scale, at which a match counts half, Sampson distance, px. preselection: the plain sum of g, for few
    matches.
    """

    def __init__(self, threshold: float, prior_weighted: bool = True) -> None:
        check_threshold(threshold)
        self.threshold, self.prior_weighted = float(threshold), prior_weighted
        self.preselection = GemanMcClure(threshold, prior_weighted)

    def __call__(self, F: Array, which: Array, pair: Pair) -> Array:
        """As `Score`."""
        rows, cells, bits = pair.cached(self, self._matches)
        out = np.empty(len(which))
        score_saturated_of(pair.residual)(F, which, rows, cells, bits, out)
        return out

    def _matches(self, pair: Pair) -> tuple[Array, Array, int]:
        """What the kernel takes of the matches."""
        cells = pair.cached(("cells", self.prior_weighted), self._cells)
        return scored_matches(pair, self.threshold, self.prior_weighted), cells, fractional_bits(pair.count)

    def _cells(self, pair: Pair) -> Array:
        cells = np.empty((2, pair.count), np.int32)
        saturated_cells(pair.table, self.prior_weighted, cells)
        return cells


@functools.cache
def score_saturated_of(residual: Residual) -> Kernel[..., None]:
    """The kernel of saturated gains for a residual."""
    of_row = residual.of_row

    @kernel(name=f"score_saturated_{residual.name}")
    def score_saturated(F: F4x2, which: I8x1, rows: F4x2, cells: I4x2, bits: int, out: F8x1) -> None:
        """Sums over the cells of both images of roots of summed gains of Geman & McClure -> out (k,).

        rows: the matches. cells: of `saturated_cells`. bits: fractional, that gains and roots are rounded to.
        """
        shift = np.float32(1.5 * 2.0 ** (23 - bits))
        gains, sums = np.empty((len(rows) // MATCH, SINGLES), np.float32), np.empty((CELL_ROWS, SINGLES), np.float32)
        for k in range(len(which)):
            for row in range(0, len(rows), MATCH):
                g = geman_mcclure(of_row(F[which[k]], rows, row))
                store(gains, row // MATCH, rounded(g * load(rows, row + 5), shift))
            for row in range(CELL_ROWS):
                store(sums, row, fill(ZERO))
            gain, of_cell = gains.ravel(), sums.ravel()
            for i in range(cells.shape[1]):
                of_cell[cells[0, i]] += gain[i]
                of_cell[cells[1, i]] += gain[i]
            total = fill(ZERO)
            for row in range(CELL_ROWS):
                total += rounded(sqrt(load(sums, row)), shift)
            out[k] = added(total)

    return score_saturated


@kernel(holds_gil=True)
def saturated_cells(table: F8x2, weighted: bool, out: I4x2) -> None:
    """Each match's cells in grids over the matches of weight -> out (2, n), of image 0 and, counted on, of image 1.

    table: (9, n), of `Pair`. weighted: by the prior.
    """
    for image in range(2):
        out[image] = image * GRID * GRID
        for axis in range(2):
            x, low, high = table[2 * image + axis].astype(np.float32), np.float32(math.inf), np.float32(-math.inf)
            for i in range(len(x)):
                if not weighted or np.float32(table[6, i]) > ZERO:
                    low, high = min(low, x[i]), max(high, x[i])
            for i in range(len(x)):
                share = (x[i] - low) / max(high - low, TINY32) * np.float32(GRID)
                cell = np.int32(min(max(share, ZERO), np.float32(GRID - 1))) if math.isfinite(share) else np.int32(0)
                out[image, i] += cell * (GRID if axis else 1)


score_saturated = score_saturated_of(SAMPSON)
score_saturated_homography = score_saturated_of(HOMOGRAPHY)
