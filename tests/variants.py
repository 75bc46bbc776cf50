"""Presets, and other methods that an option makes of them, by one word each: ``irls``, ``irls:loss=huber``."""

from typing import Any

from fmtorch import presets
from fmtorch.presets import instantiate, merged
from scripts.benchmark.methods import options

OTHER_LIBRARIES = (
    "opencv", "poselib", "colmap", "fastpose", "kornia_ransac", "magsac_cpp", "gc_ransac_cpp", "degensac_cpp",
    "superansac_cpp",
)  # fmt: skip
"""Prefixes of the presets that call other libraries' estimators; of these only OpenCV's keep the laws."""
METHODS = ("lmeds", "usac_default", "usac_fast", "usac_accurate", "usac_prosac", "usac_magsac")
OPTIONS = {
    "estimator": {
        "colmap": ["two_view=false"],
        "irls": [f"loss={loss}" for loss in ("cauchy", "geman_mcclure", "huber", "truncated")],
        "opencv": [f"method={method}" for method in METHODS],
        "poselib": ["shared_focal=true"],
    },
    "pruner": {
        name: ["soft=true"]
        for name in ("clnet", "code", "convmatch", "dfe", "gms", "lc", "lc_e", "lc_side", "lpm", "ncmnet", "oanet")
    },
}
"""By preset, beside what its file says."""


def variants(group: str) -> list[str]:
    """Every preset of a group, and after it its variants: a new file in conf/ joins by being there."""
    names = presets.available(group)
    return [word for name in names for word in (name, *(f"{name}:{o}" for o in OPTIONS[group].get(name, ())))]


def loaded(group: str, word: str) -> dict[str, Any]:
    name, _, rest = word.partition(":")
    return merged(presets.load(group, name), options(rest))


def keywords(word: str) -> dict[str, Any]:
    name, _, rest = word.partition(":")
    return {"estimator": name, **options(rest)}


def built(group: str, word: str, **changed: Any) -> Any:
    return instantiate(merged(loaded(group, word), changed), f"{group}={word}")
