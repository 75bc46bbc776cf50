"""The three laws over every registered pruner, prior and estimator."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.compiling import switch
from fmtorch.core.types import Correspondences, collate
from fmtorch.estimators import graph_cut, irls, scores, solvers
from fmtorch.estimators.focal import hypotheses
from fmtorch.geometry import sampson_objective
from scripts.benchmark.memory import OTHER_LIBRARIES
from tests.laws import (
    Result,
    Subject,
    assert_same,
    calibrated,
    degenerate,
    live_values,
    quick,
    quick_pruner,
    scene,
    scenes,
    small,
    with_padding,
)

OWN = [n for n in presets.available("estimator") if not n.startswith(OTHER_LIBRARIES)]
PER_MATCH = ("inliers", "kept", "prior", "noise")
NOISY = ("fmtorch", "fmtorch_fast", "fmtorch_max", "gc_ransac", "msac")  # are also told the noise of matches
COMPILED = (  # pruners of two forms: a kernel, and tensors
    "frame_consistency", "gms", "gms_soft", "lpm", "lpm_soft", "match_noise", "one_to_one", "position_consistency",
)  # fmt: skip
KERNEL_FORM = (  # wholes of kernels
    "fmtorch", "fmtorch_fast", "fmtorch_max", "gc_ransac", "irls_magsac", "lmeds", "lmeds_eight_point", "magsac",
    "msac", "ransac", "ransac_eight_point", "usac",
)  # fmt: skip
TILES = [  # what bounds memory and fills caches, and must change no result
    (solvers, "CPU_SAMPLES", 150), (hypotheses, "CPU_SAMPLES", 150), (scores, "CPU_TILE", 1000),
    (graph_cut, "CPU_TILE", 1000),
    (irls, "TILE", 1000), (sampson_objective, "TILE_ELEMENTS", 1), (sampson_objective, "TILE_MODELS", 3),
]  # fmt: skip


def _estimator(name: str, kernel: bool = True) -> Subject:
    estimator = quick(name)

    def run(c: Correspondences) -> Result:
        with pytest.MonkeyPatch.context() as environment:
            if not kernel:
                environment.setenv(switch.SWITCH, "off")
            e = estimator(c, seed=5)
        return {"F": e.F, "inliers": e.inliers, "ok": e.ok, "draws": e.draws, "significance": e.significance}

    return Subject(f"estimator={name}" + ("" if kernel else " without kernels"), run)


def _pruner(name: str, kernel: bool = True) -> Subject:
    pruner = quick_pruner(name)

    def run(c: Correspondences) -> Result:
        with pytest.MonkeyPatch.context() as environment:
            if not kernel:
                environment.setenv(switch.SWITCH, "off")
            pruned = pruner(calibrated(c))
        told = {name: getattr(pruned, name) for name in ("prior", "noise")}
        return {"kept": pruned.mask, **{name: value for name, value in told.items() if value is not None}}

    return Subject(f"pruner={name}" + ("" if kernel else " without kernels"), run)


def _noisy(name: str) -> Subject:
    estimator, noise = quick(name), presets.build("pruner", "match_noise")

    def run(c: Correspondences) -> Result:
        e = estimator(noise(c), seed=5)
        return {"F": e.F, "inliers": e.inliers, "ok": e.ok, "draws": e.draws, "significance": e.significance}

    return Subject(f"estimator={name} with noise", run)


def _subjects() -> list[Subject]:
    """Every preset of these groups: a new file in conf/ joins by being there."""
    estimators = [_estimator(n) for n in presets.available("estimator") if not n.startswith(OTHER_LIBRARIES[1:])]
    estimators += [_estimator(n, kernel=False) for n in KERNEL_FORM]
    pruners = [*(_pruner(n) for n in presets.available("pruner")), *(_pruner(n, kernel=False) for n in COMPILED)]
    return [*estimators, *pruners, *(_noisy(n) for n in NOISY)]


def _row(result: Result, c: Correspondences, i: int) -> Result:
    """Pair i of a batch, with what is per match reduced to the matches that are not masked."""
    return live_values({name: value[i : i + 1] for name, value in result.items()}, c[i])


GOOD = [scene(1), scene(2, 60)]
SUBJECTS = _subjects()
PLAIN = [s for s in SUBJECTS if not s.name.endswith("with noise")]
everything = pytest.mark.parametrize("subject", SUBJECTS, ids=[s.name for s in SUBJECTS])


@everything
def test_padding_is_invisible(subject: Subject) -> None:
    """Garbage of three kinds in one batch, of one kind in each pair."""
    garbage = (float("nan"), 1e30, -7.0, float("nan"), 1e30)
    padded = collate([with_padding(scenes()[i], np.random.default_rng(i), kind) for i, kind in enumerate(garbage)])
    found, expected = subject.run(padded), subject.run(scenes())
    for i, kind in enumerate(garbage):
        alone, whole = _row(found, padded, i), _row(expected, scenes(), i)
        assert_same(whole, alone, f"{subject.name}, pair {i} with {kind} in masked slots")


@everything
def test_neighbours_are_invisible(subject: Subject) -> None:
    pairs = [scene(i, count) for i, count in enumerate((150, 40, 333, 90, 150, 140, 700))]
    together = subject.run(collate(pairs))
    for i, pair in enumerate(pairs):
        alone = subject.run(pair)
        n = pair.mask.shape[1]
        shared = {k: v[i : i + 1, :n] if k in PER_MATCH else v[i : i + 1] for k, v in together.items()}
        assert_same(alone, shared, f"{subject.name}, pair {i}")


@everything
def test_no_pair_takes_its_batch_down(subject: Subject) -> None:
    """Beside degenerate pairs of every kind two good ones stay as they are, and no pair has NaN."""
    kinds = degenerate()
    n = max(pair.mask.shape[1] for pair in GOOD)
    alone = subject.run(collate(GOOD))

    def beside(some: list[str]) -> Result:
        mixed = subject.run(collate([GOOD[0], *(kinds[kind] for kind in some), GOOD[1]]))
        kept = {k: v[[0, -1], :n] if k in PER_MATCH else v[[0, -1]] for k, v in mixed.items()}
        assert_same(alone, kept, f"{subject.name} beside {', '.join(some)}")
        return mixed

    try:
        mixed = beside(list(kinds))
    except AssertionError:
        for kind in kinds:  # which of them it is
            beside([kind])
        raise
    for i, kind in enumerate(["good", *kinds, "good"]):
        for value in mixed.values():
            assert not bool(torch.isnan(value[i].to(torch.float64)).any()), f"{subject.name}: NaN for {kind}"
        if "prior" in mixed:
            prior = mixed["prior"][i]
            assert 0 <= float(prior.min()) <= float(prior.max()) <= 1, f"{subject.name}: prior for {kind}"
        if "noise" in mixed:
            noise = mixed["noise"][i]
            assert 0 < float(noise.min()) <= float(noise.max()), f"{subject.name}: noise for {kind}"


@pytest.mark.parametrize("subject", PLAIN, ids=[s.name for s in PLAIN])
def test_few_matches_alone_and_in_a_batch(subject: Subject) -> None:
    pairs = small()
    together = subject.run(collate(list(pairs.values())))
    for i, (kind, pair) in enumerate(pairs.items()):
        n = pair.mask.shape[1]
        shared = {k: v[i : i + 1, :n] if k in PER_MATCH else v[i : i + 1] for k, v in together.items()}
        assert_same(subject.run(pair), shared, f"{subject.name}: {kind}")
    for value in together.values():
        assert not bool(torch.isnan(value.to(torch.float64)).any()), f"{subject.name}: NaN"


@pytest.mark.parametrize("name", OWN)
def test_hopeless_pairs_have_a_reason(name: str) -> None:
    estimator, kinds = quick(name, 100), degenerate()
    for kind in ("empty", "one match", "all points equal", "NaN", "infinite"):
        estimate = estimator(kinds[kind])
        assert not bool(estimate.ok[0]), kind
        assert estimate.reason[0], kind
        assert not bool(estimate.inliers.any()), kind


@pytest.mark.parametrize("name", OWN)
def test_batch_workers_threads_and_tiles_change_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    estimator = quick(name, 60, 30)
    pairs = [scene(i, 24 + 53 * i % 120) for i in range(24)]

    def run(some: list[Correspondences]) -> Result:
        e = estimator(collate(some), seed=5)
        return {"F": e.F, "inliers": e.inliers, "ok": e.ok, "draws": e.draws, "significance": e.significance}

    def first(result: Result, pairs: int, matches: int) -> Result:
        return {k: v[:pairs, :matches] if k == "inliers" else v[:pairs] for k, v in result.items()}

    threads = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        whole = run(pairs)
    finally:
        torch.set_num_threads(threads)
    seven = run(pairs[:7])
    n = seven["inliers"].shape[1]
    assert_same(seven, first(whole, 7, n), f"{name}: a batch of 7, and one of 24 in four threads")
    with ThreadPoolExecutor(4) as workers:
        for i, alone in enumerate(workers.map(lambda pair: run([pair]), pairs[:7])):
            n_alone = pairs[i].mask.shape[1]
            shared = {k: v[i : i + 1, :n_alone] if k == "inliers" else v[i : i + 1] for k, v in seven.items()}
            assert_same(alone, shared, f"{name}: pair {i} alone, in one of four workers")
    for module, constant, value in TILES:
        monkeypatch.setattr(module, constant, value)
    assert_same(run(pairs[:7]), seven, f"{name}: other tiles")
