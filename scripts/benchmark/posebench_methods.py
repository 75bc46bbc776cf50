"""Estimators by PoseBench's protocol: KIND:PRESET[:KEY=VALUE,...], such as E:fmtorch or F:poselib.

E: a relative pose of known cameras. F: a fundamental matrix, of whose four poses the best one counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

import fmtorch
from fmtorch import metrics, presets
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import ImagePair
from fmtorch.metrics import PoseError
from scripts.benchmark import kept
from scripts.benchmark.matched import options

MAX_ITERATIONS, MIN_ITERATIONS, CONFIDENCE = 1000, 100, 0.9999
KINDS = ("E", "F")
FOCAL_SAMPLES = 250  # of a round of our search with focal lengths
IN_PIXELS = ("threshold", "inlier_threshold", "scale")  # options of our presets that are distances
ENGINE = "fmtorch.estimators.Ransac"
NOT_SCALED = "scaled"  # false: our preset keeps its own distances


class Method(NamedTuple):
    """kind: of `KINDS`. preset: of an estimator. changes: options that replace the protocol's."""

    kind: str
    preset: str
    changes: dict[str, Any]


def read(text: str) -> Method:
    """``KIND:PRESET[:KEY=VALUE,...]``. Raises SystemExit for anything else."""
    kind, _, rest = text.partition(":")
    preset, _, settings = rest.partition(":")
    if kind not in KINDS or preset not in presets.available("estimator"):
        raise SystemExit(f"{text}: write KIND:PRESET[:KEY=VALUE,...], KIND being E or F, PRESET one of `fmtorch list`")
    return Method(kind, preset, options(settings))


def protocol(method: Method, threshold: float) -> dict[str, Any]:
    """The options of a method for a data set whose threshold is so many pixels.

    At most 1,000 samples, at least 100, confidence 0.9999. A peer gets the threshold. Our presets, whose distances are
    of matches that are exact to about a pixel, get them times the threshold, unless ``scaled=false``.
    """
    changes = dict(method.changes)
    scaled = changes.pop(NOT_SCALED, True)
    preset = presets.load("estimator", method.preset)
    if preset["_target_"] == ENGINE:
        own = _distances(preset, threshold) if scaled else {}
        own |= {"hypotheses": MAX_ITERATIONS, "confidence": CONFIDENCE}
        if preset.get("focal"):
            own["focal"] = {**own.get("focal", {}), "rounds": MAX_ITERATIONS // FOCAL_SAMPLES}
    else:
        known = {
            "threshold": threshold, "iterations": MAX_ITERATIONS, "min_iterations": MIN_ITERATIONS,
            "confidence": CONFIDENCE, "two_view": False,
        }  # fmt: skip
        own = {name: value for name, value in known.items() if name in preset}
    return _merged(own, changes)


def identity(text: str) -> str:
    """The digest of what a method's results depend on: options at 1 px, code, versions of peers."""
    method = read(text)
    return kept.identity([("estimator", method.preset, protocol(method, 1.0))], text)


def estimated(method: Method, pair: ImagePair, c: Correspondences, threshold: float, seed: int) -> Estimate:
    """The estimate of one pair. Raises ValueError where it is refused."""
    given: dict[str, Any] = {
        "mask": c.mask, "quality": c.quality, "size0": c.size0, "size1": c.size1, "key": pair.key, "seed": seed,
        "estimator": method.preset, **protocol(method, threshold),
    }  # fmt: skip
    if method.kind == "E":
        return fmtorch.find_essential(c.x0, c.x1, pair.K0, pair.K1, **given)  # type: ignore[arg-type]
    return fmtorch.find_fundamental(c.x0, c.x1, **given)


def error(method: Method, estimate: Estimate, pair: ImagePair) -> PoseError:
    """The angles of an estimate in degrees; the sign of the translation counts."""
    K0, K1, R, t = (torch.from_numpy(np.array(v, np.float64)) for v in (pair.K0, pair.K1, pair.R, pair.t))
    if method.kind == "F":
        return metrics.closest_pose_error(estimate.F[0].double(), K0, K1, R, t)
    assert estimate.R is not None
    assert estimate.t is not None
    return metrics.pose_error(estimate.R[0].double(), estimate.t[0].double(), R, t, up_to_sign=False)


def _distances(preset: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """The distances within a preset, at any depth, times `scale`."""
    levels = {key: _distances(value, scale) for key, value in preset.items() if isinstance(value, Mapping)}
    own = {key: value * scale for key, value in preset.items() if key in IN_PIXELS and value is not None}
    return {**{key: inside for key, inside in levels.items() if inside}, **own}


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with `changes` at any depth."""
    result = dict(base)
    for key, value in changes.items():
        inside = result.get(key)
        result[key] = _merged(inside, value) if isinstance(inside, dict) and isinstance(value, dict) else value
    return result
