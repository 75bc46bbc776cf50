"""Methods that are named in one word: NAME:LEVEL[:KEY=VALUE,...], such as fmtorch:known or poselib:shared:threshold=1.

A method takes a pair's matches and what is known of its cameras, and gives F, a pose, and focal lengths.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import fmtorch
from fmtorch import presets
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.runs.fingerprint import code_digest
from scripts.benchmark import cameras_peers, kept
from scripts.benchmark.cameras_knowledge import LEVELS, NOTHING, Answer, Array, Knowledge, answer
from scripts.benchmark.matched import options

Solver = Callable[[Correspondences, Knowledge, int], Answer]
OURS, OURS_F = "fmtorch", "fmtorch_f"
PRUNERS = ("frame_consistency", "match_noise")  # P(inlier) and noise of each match; their time is included


class Spec(NamedTuple):
    """A method's name, the level of knowledge of `LEVELS`, and its options."""

    name: str
    level: str
    options: dict[str, Any]


def read(text: str) -> Spec:
    """``NAME:LEVEL[:KEY=VALUE,...]``. Raises SystemExit for anything else."""
    name, _, rest = text.partition(":")
    level, _, settings = rest.partition(":")
    if level not in LEVELS:
        raise SystemExit(f"{text}: write NAME:LEVEL[:KEY=VALUE,...] with a level of {', '.join(LEVELS)}")
    return Spec(name, level, options(settings))


def build(text: str) -> Solver:
    """The method of ``NAME:LEVEL[:KEY=VALUE,...]``: `fmtorch`, `fmtorch_f` (its F without cameras), or a peer."""
    spec = read(text)
    if spec.name in (OURS, OURS_F):
        pruners = [presets.build("pruner", name) for name in PRUNERS]
        call = _ours if spec.name == OURS else _fundamental
        return functools.partial(_with_prior, pruners, functools.partial(call, spec.options))
    try:
        peer = cameras_peers.peer(spec.name, spec.level, **spec.options)
    except ValueError as error:
        raise SystemExit(f"{text}: {error}") from error
    return lambda c, given, seed: peer(best_first(c), given, seed)


def identity(text: str) -> str:
    """The digest of what a method's results depend on: options, code, versions of peers."""
    spec = read(text)
    if spec.name in (OURS, OURS_F):
        stages: kept.Stages = [("estimator", "fmtorch", spec.options)]
        code = code_digest(fmtorch.find_fundamental.__module__)
        return kept.identity(stages + [("pruner", name, {}) for name in PRUNERS], spec.name, spec.level, code)
    files = [Path(cameras_peers.__file__), Path(cameras_peers.__file__).with_name("cameras_knowledge.py")]
    code = hashlib.blake2b(b"".join(file.read_bytes() for file in files)).hexdigest()
    code += code_digest("fmtorch.estimators.external.colmap") if spec.name.startswith("colmap") else ""
    return kept.identity([], text, cameras_peers.version(spec.name), code)


def best_first(c: Correspondences) -> tuple[Array, Array]:
    """The matches of a batch of one in ascending order of their ratios: x0, x1 (n, 2) in pixels."""
    mask = c.mask[0]
    assert c.quality is not None
    order = c.quality[0][mask].argsort(stable=True)
    x0, x1 = (np.ascontiguousarray(x[0][mask][order].double().numpy()) for x in (c.x0, c.x1))
    return x0, x1


def _with_prior(
    pruners: list[Callable[[Correspondences], Correspondences]], call: Solver, c: Correspondences, given: Knowledge,
    seed: int,
) -> Answer:  # fmt: skip
    for prune in pruners:
        c = prune(c)
    return call(c, given, seed)


def _arguments(settings: dict[str, Any], c: Correspondences, seed: int) -> dict[str, Any]:
    return {
        "mask": c.mask, "quality": c.quality, "prior": c.prior, "noise": c.noise, "lafs0": c.lafs0, "lafs1": c.lafs1,
        "size0": c.size0, "size1": c.size1, "key": c.key, "seed": seed, **settings,
    }  # fmt: skip


def _ours(settings: dict[str, Any], c: Correspondences, given: Knowledge, seed: int) -> Answer:
    """What this project makes of a pair by what is known of its cameras."""
    focal: str | float | None = given.deviation or None
    if given.K0 is None and given.K1 is None:
        focal = "shared" if given.one_camera else "unknown"
    cameras: dict[str, Any] = {"K0": given.K0, "K1": given.K1, "focal": focal}
    estimate = fmtorch.find_fundamental(c.x0, c.x1, **cameras, **_arguments(settings, c, seed))
    if not bool(estimate.ok[0]):
        return NOTHING
    assert estimate.R is not None
    assert estimate.t is not None
    assert estimate.focals is not None
    F, R, t, focals = (value[0].double().numpy() for value in (estimate.F, estimate.R, estimate.t, estimate.focals))
    return Answer(F, R, t, focals)


def _fundamental(settings: dict[str, Any], c: Correspondences, given: Knowledge, seed: int) -> Answer:
    """The pose of our F, estimated without cameras."""
    estimate: Estimate = fmtorch.find_fundamental(c.x0, c.x1, **_arguments(settings, c, seed))
    if not bool(estimate.ok[0]):
        return NOTHING
    x0, x1 = (x[0].double().numpy() for x in (c.x0, c.x1))
    return answer(estimate.F[0].double().numpy(), given, (x0, x1), estimate.inliers[0].numpy())
