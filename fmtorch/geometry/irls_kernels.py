"""`irls` for the matches of one pair, compiled; float64."""

from __future__ import annotations

from fmtorch.compiling.arrays import F8x2
from fmtorch.compiling.kernel import kernel
from fmtorch.compiling.lanes import LANES, load, store
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry.eight_point_kernels import weighted_eight_point
from fmtorch.geometry.rank2_kernels import assign
from fmtorch.geometry.sampson_objective_kernels import MATCH, Weighted, in_rows, linearise, robust


@kernel
def reweighted(F: F8x2, weighted: Weighted) -> None:
    """`irls.reweighted` of models (k, 9), in place."""
    matches = in_rows(weighted.points, weighted.weight, weighted.s2)
    J, work = matrix(10, LANES), matrix(3, LANES)
    weights, fitted = matrix(len(matches) // MATCH, LANES), vector(9)
    for k in range(len(F)):
        for row in range(0, len(matches), MATCH):
            inverse, r2 = linearise(F[k], matches, row, J)
            _, slope = robust(r2, load(matches, row + 5), weighted.loss, weighted.table, work)
            store(weights, row // MATCH, inverse * (load(matches, row + 4) * slope))
        if weighted_eight_point(weighted.points, weights.ravel()[: len(weighted.weight)], fitted):
            assign(F[k], fitted)
