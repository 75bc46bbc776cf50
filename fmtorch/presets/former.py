"""Presets of earlier versions under their old names, and what is written in their place now."""

from __future__ import annotations

from typing import NamedTuple


class Now(NamedTuple):
    """What replaces a preset: one of the same group, and what is changed beside it, as words of a command line."""

    name: str
    overrides: tuple[str, ...] = ()
    remark: str = ""


def _estimator_alone(pipeline: str, estimator: str) -> Now:
    return Now(pipeline, (f"estimator={estimator}",))


def _soft(pruner: str) -> Now:
    return Now(pruner, (f"pruner.{pruner}.soft=true",))


_PAPER_PIPELINES = (
    "dspsift_ratio", "hardnet_gms", "hardnet_ratio", "hesaffnet_gms", "hesaffnet_ratio", "l2net_ratio",
    "rootsiftpca_gms", "rootsiftpca_ratio", "sift_gms", "sift_lc", "sift_lpm", "sift_ratio",
)  # fmt: skip
_PAPER_ESTIMATORS = ("cf_ransac", "cf_ransac_usac", "gc_ransac", "lmeds", "msac", "ransac", "usac")
_OPENCV = ("lmeds", "ransac", "usac_accurate", "usac_default", "usac_fast", "usac_magsac", "usac_prosac")
_KERNELS = ("cauchy", "geman_mcclure", "huber", "magsac", "truncated")
_SOFT = ("code", "dfe", "gms", "lc", "lc_e", "lc_side", "lpm")

FORMER: dict[str, dict[str, Now]] = {
    "pipeline": {
        **{f"{name}_paper": Now(f"paper/{name}") for name in _PAPER_PIPELINES},
        **{f"sift_{name}_paper": _estimator_alone("paper/sift_ratio", f"paper/{name}")
           for name in ("lmeds", "msac", "usac")},
        "sift_gcransac_paper": _estimator_alone("paper/sift_ratio", "paper/gc_ransac"),
        "sift_cfransac_paper": _estimator_alone("paper/sift_ratio", "paper/cf_ransac"),
        **{f"sift_{name}": _estimator_alone("sift_ratio", name) for name in ("magsac", "msac", "usac")},
        "sift_lmeds": _estimator_alone("sift_ratio", "lmeds_eight_point"),
        "sift_gcransac": _estimator_alone("sift_ratio", "gc_ransac"),
        "sift_cfransac": _estimator_alone("sift_ratio", "cf_ransac"),
        "code_lmeds": _estimator_alone("code", "lmeds_eight_point"),
    },
    "estimator": {
        **{f"{name}_paper": Now(f"paper/{name}") for name in _PAPER_ESTIMATORS},
        **{f"opencv_{name}": Now("opencv", (f"estimator.method={name}",)) for name in _OPENCV},
        **{f"irls_{name}": Now("irls", (f"estimator.kernel={name}",)) for name in _KERNELS},
        "poselib_shared_focal": Now("poselib", ("estimator.shared_focal=true",)),
        "fmtorch_max": Now("fmtorch", remark=", as accurate in half the time"),
    },
    "pruner": {f"{name}_soft": _soft(name) for name in _SOFT},
}  # fmt: skip
"""By group and old name."""


def moved(group: str, name: str, command: bool = False) -> str | None:
    """Where a preset of an earlier version went, in one line; None where there was none of that name.

    command: options as words of a command line, ``estimator.method=lmeds``; otherwise as arguments, ``method=lmeds``.
    """
    now = FORMER.get(group, {}).get(name)
    if now is None:
        return None
    place = f"pruner.{now.name}." if group == "pruner" else f"{group}."
    words = [word if command else word.removeprefix(place) for word in now.overrides]
    return f"{name} is now {now.name}{' with ' + ' '.join(words) if words else ''}{now.remark}"
