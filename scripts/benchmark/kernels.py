"""Kernels and their tensor forms, interleaved: milliseconds of processor time a call, and seconds to compile each.

    python -m scripts.benchmark.kernels [pruning] [search] [refinement] [estimators]

On synthetic matches of one pair. Processor time, which other work on the machine disturbs less than the time on the
wall; compiled into an empty cache folder.
"""

from __future__ import annotations

import functools
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from fmtorch import presets
from fmtorch.compiling import switch
from fmtorch.core.types import Correspondences
from scripts.benchmark.pruning_speed import correspondences

COUNT = 600  # matches of the pair
REPEATS = 15
PRUNERS = (
    "frame_consistency", "position_consistency", "match_noise", "ratio_prior", "one_to_one", "gms", "gms_soft", "lpm",
)  # fmt: skip
ESTIMATORS = (
    "fmtorch", "fmtorch_fast", "fmtorch_max", "ransac", "msac", "lmeds", "usac", "magsac", "gc_ransac", "cf_ransac",
    "irls_magsac",
)  # fmt: skip


def main(groups: list[str]) -> None:
    """Print a line for each kernel."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["FMTORCH_CACHE"] = folder
        c = framed(correspondences(COUNT))
        measured = {"pruning": pruning, "search": search, "refinement": refinement, "estimators": estimators}
        for group in groups or list(measured):
            measured[group](c)


def line(name: str, compiled: Callable[[], Any], tensors: Callable[[], Any] | None) -> None:
    """Print compile seconds and the medians of interleaved calls."""
    seconds = milliseconds(compiled, 1) / 1e3
    ours, theirs = [], []
    for _ in range(REPEATS):
        ours.append(milliseconds(compiled, 5))
        if tensors is not None:
            theirs.append(milliseconds(tensors, 1))
    reference = f"{np.median(theirs):8.3f}" if theirs else "        "
    print(f"{name:24} {seconds:6.1f} s  {np.median(ours):8.3f} ms  {reference} ms", flush=True)


def milliseconds(call: Callable[[], Any], times: int) -> float:
    """Of processor time a call."""
    begun = time.process_time()
    for _ in range(times):
        call()
    return (time.process_time() - begun) / times * 1e3


def framed(c: Correspondences) -> Correspondences:
    """The same matches with frames."""
    frames = torch.from_numpy(np.random.default_rng(0).normal(size=(1, COUNT, 2, 3))).float()
    return c.replace(lafs0=frames, lafs1=frames * 1.1)


def pruning(c: Correspondences) -> None:
    """Pruners as stages."""
    whole("pruner", PRUNERS, c)


def estimators(c: Correspondences) -> None:
    """Whole estimators; the seconds are those of kernels that none before it has compiled."""
    whole("estimator", ESTIMATORS, c)


def whole(group: str, names: Sequence[str], c: Correspondences) -> None:
    """Presets of a group, called with kernels and without."""
    for name in names:
        stage = presets.build(group, name)

        def run(form: str, stage: Any = stage) -> None:
            os.environ[switch.SWITCH] = form
            stage(c)

        line(name, functools.partial(run, "on"), functools.partial(run, "off"))
    os.environ[switch.SWITCH] = "on"


def search(c: Correspondences) -> None:
    """Draws, solvers and scores: 500 samples, 1,000 models on 600 matches."""
    from fmtorch.estimators import sampling, sampling_kernels, scores, scores_kernels
    from fmtorch.estimators.focal.cameras import CentredPairs
    from fmtorch.estimators.focal.hypotheses import FocalSamples
    from fmtorch.estimators.pairs import normalized_pairs
    from fmtorch.estimators.saturated_gains import SaturatedGains
    from fmtorch.estimators.solvers import EightPoint, SevenPoint
    from fmtorch.geometry.eight_point_kernels import eight_point
    from fmtorch.geometry.five_point_kernels import five_point
    from fmtorch.geometry.seven_point_kernels import seven_point

    (pair,), _ = normalized_pairs(c.replace(prior=1 - c.quality), 0, 7)  # type: ignore[operator]
    sampler, samples = sampling.PriorWeighted(), 500
    cumulative = sampler.weight(pair)[0, :COUNT].cumsum(0).numpy()
    totals = np.full(samples, cumulative[-1])
    sample = np.empty((7, samples), np.int64)
    line(
        "draw 500 of seven",
        lambda: sampling_kernels.draw(cumulative, totals, 12345, 7, 0, sample),
        lambda: sampler.draw(pair, 0, samples, 7),
    )
    points = np.ascontiguousarray(pair.points[:, 0, :COUNT].numpy())
    F, draw = np.empty((10 * samples, 9), np.float32), np.empty(10 * samples, np.int64)
    eights = np.stack([np.random.default_rng(s).permutation(COUNT)[:8] for s in range(samples)], 1)
    for name, kernel, solver, index in (
        ("500 of seven", seven_point, SevenPoint(), sample),
        ("500 of eight", eight_point, EightPoint(), eights),
    ):
        tensors = torch.from_numpy(points[:, index]).float()[:, :, None]
        line(name, lambda k=kernel, i=index: k(points, i, F, draw), lambda s=solver, t=tensors: s(t))  # type: ignore[misc]
    fives, depth = np.ascontiguousarray(sample[:5]), np.full((2, samples), 1.2)
    cameras, five = CentredPairs(pair), torch.from_numpy(fives)[:, None]
    centred, offset = np.ascontiguousarray(cameras.points[:, 0, :COUNT].numpy()), cameras.offset[:, 0].numpy().copy()
    hypotheses = FocalSamples(lambda *_: five)
    line(
        "500 of five",
        lambda: five_point(centred, fives, depth, offset, F, draw),
        lambda: hypotheses(pair, 0, samples),
    )
    models = np.random.default_rng(0).normal(size=(1000, 9)).astype(np.float32)
    which, out = np.arange(1000), np.empty(1000)
    p32, ones = points.astype(np.float32), np.ones(COUNT, np.float32)
    scale, none = np.full(COUNT, 1e4, np.float32), np.empty(0, np.float32)
    cells = np.empty((2, COUNT), np.int32)
    scores_kernels.saturated_cells(p32, ones, cells)
    tensor_models = torch.from_numpy(models).T[:, None].contiguous()
    for name, code, score in (
        ("count", scores_kernels.COUNT, scores.InlierCount(1.0)),
        ("msac", scores_kernels.TRUNCATED_SQUARES, scores.TruncatedSquares(1.0)),
        ("geman_mcclure", scores_kernels.GEMAN_MCCLURE, scores.GemanMcClure(1.0)),
    ):
        line(
            f"1,000 by {name}",
            lambda code=code: scores_kernels.score_gains(models, which, p32, ones, scale, code, none, 10, out),  # type: ignore[misc]
            lambda score=score: scores.score_models(score, tensor_models, pair),  # type: ignore[misc]
        )
    line(
        "1,000 saturated",
        lambda: scores_kernels.score_saturated(models, which, p32, ones, scale, cells, 10, out),
        lambda: scores.score_models(SaturatedGains(1.0), tensor_models, pair),
    )
    line(
        "1,000 medians",
        lambda: scores_kernels.score_median(models, which, p32, out),
        lambda: scores.score_models(scores.Median(), tensor_models, pair),
    )


def refinement(c: Correspondences) -> None:
    """One evaluation and step of 12 models on 128 matches, and a weighted fit to 600."""
    from fmtorch.geometry import eight_point
    from fmtorch.geometry.eight_point_kernels import weighted_eight_point
    from fmtorch.geometry.rank2_manifold import retract, solve, start
    from fmtorch.geometry.rank2_manifold_kernels import start as start_kernel
    from fmtorch.geometry.rank2_manifold_kernels import step
    from fmtorch.geometry.robust_losses import KERNELS
    from fmtorch.geometry.sampson_objective import SampsonObjective
    from fmtorch.geometry.sampson_objective_kernels import GEMAN_MCCLURE, evaluate

    rng = np.random.default_rng(0)
    k, points, weight = 12, rng.uniform(-1, 1, (4, 128)), rng.random(128)
    models, s2, table = rng.normal(size=(k, 9)), np.full(128, 1e-4), np.zeros((2, 2))
    F, e0, e1, G, g0, g1 = (np.empty((k, size)) for size in (9, 3, 3, 9, 3, 3))
    products, cost, damping = np.empty((k, 10, 10)), np.empty(k), np.full(k, 1e-4)
    tensors = [
        torch.from_numpy(a) for a in (models.T[:, None].copy(), points[:, None], weight[None], np.sqrt(s2)[None])
    ]
    objective = SampsonObjective(tensors[1], tensors[2], KERNELS["geman_mcclure"], tensors[3])
    line("start of 12", lambda: start_kernel(models, 5, F, e0, e1), lambda: start(tensors[0]))
    state = start(tensors[0])
    line(
        "12 with derivatives",
        lambda: evaluate(F, points, weight, s2, GEMAN_MCCLURE, table, True, products, cost),
        lambda: objective(state[0], True),
    )
    normal = objective(state[0], True)[0]
    damped = torch.full((1, k), 1e-4, dtype=torch.float64)
    line(
        "12 steps",
        lambda: step(products, F, e0, e1, damping, G, g0, g1),
        lambda: retract(state[0], solve(normal, *state, damped), *state[1:]),
    )
    many, ones, out = rng.uniform(-1, 1, (4, COUNT)), np.ones(COUNT), np.empty(9)
    x0, x1 = (torch.from_numpy(x.T.copy()) for x in (many[:2], many[2:]))
    line("weighted eight-point", lambda: weighted_eight_point(many, ones, out), lambda: eight_point(x0, x1))


if __name__ == "__main__":
    main(sys.argv[1:])
