"""The exchangeable parts of the engine, by the roles and names that configs use; the one place that names them all.

An option that names a part holds its name (``score: msac``), or a mapping of its name and options of its own
(``score: {name: msac, prior_weighted: true}``), or an object: that of a user's `_target_`.
"""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from fmtorch.estimators.degeneracy import Degensac
from fmtorch.estimators.final_fits import (
    AdaptiveGaussNewton,
    GaussNewton,
    LeastSquares,
    NoFit,
    UnweightedLeastSquares,
)
from fmtorch.estimators.graph_cut import GraphCut
from fmtorch.estimators.inliers import BetterHalf, RobustDeviations, WithinThreshold
from fmtorch.estimators.sampling import PriorWeighted, Prosac, Uniform
from fmtorch.estimators.saturated_gains import SaturatedGains
from fmtorch.estimators.scores import InlierCount, Median, SigmaConsensus, TruncatedSquares
from fmtorch.estimators.solvers import EightPoint, SevenPoint


class Entry(NamedTuple):
    """A part in its two forms. tensor: makes the one on padded tensors. kernel: name of the other within `one_pair`."""

    tensor: Callable[..., Any]
    kernel: str | None = None


PARTS: dict[str, dict[str, Entry]] = {
    "solver": {
        "seven_point": Entry(SevenPoint, "solvers.SevenPoint"),
        "eight_point": Entry(EightPoint, "solvers.EightPoint"),
    },
    "sampler": {
        "uniform": Entry(Uniform, "sampling.Uniform"),
        "prosac": Entry(Prosac, "sampling.Prosac"),
        "prior": Entry(PriorWeighted, "sampling.PriorWeighted"),
    },
    "score": {
        "inlier_count": Entry(InlierCount, "scores.InlierCount"),
        "msac": Entry(TruncatedSquares, "scores.TruncatedSquares"),
        "saturated": Entry(SaturatedGains, "saturated_gains.SaturatedGains"),
        "magsac": Entry(SigmaConsensus, "scores.SigmaConsensus"),
        "median": Entry(Median, "scores.Median"),
    },
    "degeneracy": {"degensac": Entry(Degensac, "degeneracy.Degensac")},
    "local_optimization": {"graph_cut": Entry(GraphCut, "graph_cut.GraphCut")},
    "inliers": {
        "threshold": Entry(WithinThreshold, "inliers.WithinThreshold"),
        "median": Entry(BetterHalf, "inliers.BetterHalf"),
        "lmeds": Entry(RobustDeviations, "inliers.RobustDeviations"),
    },
    "final": {
        "none": Entry(NoFit, "final_fits.NoFit"),
        "least_squares": Entry(LeastSquares, "final_fits.LeastSquares"),
        "unweighted_least_squares": Entry(UnweightedLeastSquares, "final_fits.LeastSquares"),
        "gauss_newton": Entry(GaussNewton, "final_fits.GaussNewton"),
        "adaptive": Entry(AdaptiveGaussNewton, "final_fits.AdaptiveGaussNewton"),
    },
}


def takes(role: str, spec: Any, option: str) -> bool:
    """Whether a named part asks the engine for this option."""
    name = spec.get("name") if isinstance(spec, Mapping) else spec
    entry = PARTS[role].get(name) if isinstance(name, str) else None
    return entry is not None and option in inspect.signature(entry.tensor).parameters


def part(role: str, spec: Any, **context: Any) -> Any:
    """The part that an option describes, None for none.

    context: what the engine tells its parts; each takes what its constructor names, unless its own options say so.
    Raises ValueError for an unknown name or option, naming those there are.
    """
    if spec is None or not isinstance(spec, str | Mapping):
        return spec
    name, options = (spec, {}) if isinstance(spec, str) else (spec.get("name"), dict(spec))
    options.pop("name", None)
    if name not in PARTS[role]:
        raise ValueError(f"{role} is {name!r}; it must be one of: {', '.join(PARTS[role])}")
    make = PARTS[role][name].tensor
    known = inspect.signature(make).parameters
    unknown = [key for key in options if key not in known]
    if unknown:
        raise ValueError(f"{role}={name}: no option {', '.join(unknown)}; there are: {', '.join(known) or 'none'}")
    return make(**({key: value for key, value in context.items() if key in known} | options))


def kernel_form(made: object, *others: object) -> Any:
    """The kernel form of a part, with the same options; None where there is none, as of a user's own part.

    others: parts in their kernel form that this one calls.
    """
    for entries in PARTS.values():
        for entry in entries.values():
            if entry.tensor is type(made) and entry.kernel is not None:
                module, _, name = entry.kernel.partition(".")
                return pkgutil.resolve_name(f"fmtorch.estimators.one_pair.{module}:{name}")(made, *others)
    return None
