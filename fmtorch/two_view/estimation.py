"""One estimator call as the public functions make it: preset, prior, cameras, verdict."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fmtorch.core.checks import number
from fmtorch.core.stages import Estimator, Pruner, model_of, output_of
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.estimators.ransac import Ransac
from fmtorch.geometry.significance import judged
from fmtorch.jit.together import compile_together
from fmtorch.jobs.execution import one_thread
from fmtorch.presets.files import construct, instantiate, load, merged
from fmtorch.pruning.consistency import FrameConsistency, PositionConsistency
from fmtorch.two_view.arguments import expect_lenses
from fmtorch.two_view.assumed_sizes import with_assumed_sizes
from fmtorch.two_view.known_cameras import KnownCameras

RANSAC = f"fmtorch.estimators.{Ransac.__name__}"  # the `_target_` of presets of this project's own engine


def estimated(
    c: Correspondences, model: str, name: str, config_dir: Path | str | None, seed: int, options: Mapping[str, Any],
    covariance: bool = False, assume_sizes: bool = False,
) -> Estimate:  # fmt: skip
    """The estimate of matches by a preset, with a prior of their consistency where it uses one and none is given.
    model: what the preset must estimate. What is known of cameras counts where `focal` or `shared_focal` is given; then
    the estimate may have a covariance. assume_sizes: whether sizes that are not given may be taken from the points."""
    seed = int(number("seed", seed, integer=True))
    estimator = estimator_of(name, config_dir, options)
    _expect_gradients(c, estimator, name)
    if (gives := model_of(estimator)) != model:
        option = f" (here by model={model})" if "model" in load("estimator", name, config_dir) else ""
        needed = f"find_{model} needs one that gives {model} matrices{option}"
        raise ValueError(f"estimator={name} gives {gives} matrices; {needed}")
    if c.lens is not None:
        expect_lenses(estimator, f"estimator={name}")
        if c.requires_grad:
            raise ValueError("lens is given, and its estimates have no gradients: give points, prior, noise detached")
    return estimated_by(estimator, c, seed, covariance, assume_sizes)


def estimated_by(
    estimator: Estimator, c: Correspondences, seed: int, covariance: bool = False, assume_sizes: bool = False
) -> Estimate:
    """The same of an estimator that is built, and of values that are known to be right."""
    if not c.asks_for_cameras:
        c = _with_prior(c, estimator)
        if assume_sizes and c.size0 is None and getattr(estimator, "assumes_cameras", False):
            return with_assumed_sizes(c, lambda sized: _judged(estimator, sized, seed))
        return _judged(estimator, c, seed)
    return KnownCameras(estimator, functools.partial(_with_prior, estimator=estimator), covariance)(c, seed)


def _judged(estimator: Estimator, c: Correspondences, seed: int) -> Estimate:
    """The estimate of an estimator, which may be anybody's, with its significance."""
    return judged(output_of(estimator, estimator(c, seed), Estimate, c), c)


def _expect_gradients(c: Correspondences, estimator: Estimator, name: str) -> None:
    """Raise ValueError naming a field that requires a gradient which the estimator does not give."""
    reached = getattr(estimator, "gradients_reach", None)
    if reached is None or not (torch.is_grad_enabled() and c.requires_grad):
        return
    for field in ("x0", "x1", "prior", "noise"):
        value = getattr(c, field)
        if value is not None and value.requires_grad and field not in reached:
            raise ValueError(
                f"{field} requires a gradient, and the final fit of estimator={name} passes none to it: "
                f"give {field}.detach(), or take another (estimator=fmtorch, or the option final=gauss_newton)"
            )


def _with_prior(c: Correspondences, estimator: Estimator) -> Correspondences:
    """The matches with a prior of their consistency where the estimator uses one and none is given."""
    if c.prior is None and getattr(estimator, "uses_prior", False):
        pruner = _consistency(c.lafs0 is not None and c.lafs1 is not None and c.ratio is not None)
        compile_together([*getattr(pruner, "kernels", ()), *getattr(estimator, "kernels", ())])
        with one_thread(c.mask.device):
            return pruner(c)
    return c


def estimator_of(name: str, config_dir: Path | str | None, options: Mapping[str, Any]) -> Estimator:
    """The estimator of a preset, built but once where its options are plain values and its file is not a user's."""
    plain = _plain(options)
    if config_dir is None:
        try:
            return _kept(name, json.dumps(plain, sort_keys=True))
        except TypeError:  # an option is an object of some kind
            pass
    return _built(name, config_dir, plain)


@functools.lru_cache(maxsize=64)
def _kept(name: str, options: str) -> Estimator:
    return _built(name, None, json.loads(options))


def _built(name: str, config_dir: Path | str | None, options: Mapping[str, Any]) -> Estimator:
    config, where = merged(load("estimator", name, config_dir), options), f"estimator={name}"
    if config.get("_target_") == RANSAC:
        return construct(Ransac, config, where)
    built: Estimator = instantiate(config, where)
    return built


def _plain(value: Any) -> Any:
    """The value with numbers of NumPy as Python's, at any depth."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value


@functools.cache
def _consistency(framed: bool) -> Pruner:
    """The prior of matches with frames and ratios, or of points alone, with the constants of its preset."""
    if framed:
        return construct(FrameConsistency, load("pruner", "frame_consistency"), "pruner=frame_consistency")
    return construct(PositionConsistency, load("pruner", "position_consistency"), "pruner=position_consistency")
