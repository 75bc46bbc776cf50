"""The three laws over every registered pruner, prior and estimator."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.core import Correspondences, Estimate, collate
from fmtorch.two_view.known_cameras import KnownCameras
from tests import laws
from tests.variants import OTHER_LIBRARIES, variants

OWN = [n for n in variants("estimator") if not n.startswith(OTHER_LIBRARIES)]
PER_MATCH = ("inliers", "kept", "prior", "noise")
SOFT = [n.partition(":")[0] for n in variants("pruner") if n.endswith(":soft=true")]
HARD = {n for n in SOFT if n != "lc" and "network" in presets.load("pruner", n)}
"""Whose mask is a threshold on the probabilities of their soft form, as that of `lc` is."""
PRUNERS = [n for n in variants("pruner") if n not in HARD]
NOISY = ("fmtorch", "fmtorch_fast", "gc_ransac", "msac")  # are also told the noise of matches


def _results(e: Estimate) -> laws.Result:
    values = {"F": e.matrix, "inliers": e.inliers, "ok": e.ok, "samples": e.samples}
    return {**values, "significance": e.significance} if e.model == "fundamental" else values


def _estimator(name: str) -> laws.Subject:
    estimator = laws.quick(name)
    return laws.Subject(f"estimator={name}", lambda c: _results(estimator(c, seed=5)))


def _pruner(name: str) -> laws.Subject:
    pruner = laws.quick_pruner(name)

    def run(c: Correspondences) -> laws.Result:
        pruned = pruner(laws.calibrated(c))
        fields = {name: getattr(pruned, name) for name in ("prior", "noise")}
        return {"kept": pruned.mask, **{name: value for name, value in fields.items() if value is not None}}

    return laws.Subject(f"pruner={name}", run)


def _noisy(name: str) -> laws.Subject:
    estimator, noise = laws.quick(name), presets.build("pruner", "match_noise")
    return laws.Subject(f"estimator={name} with noise", lambda c: _results(estimator(noise(c), seed=5)))


def _calibrated(name: str, known: str) -> laws.Subject:
    """An estimator that knows cameras; where there is no pose, its values are 7."""
    estimator = KnownCameras(laws.quick(name))

    def run(c: Correspondences) -> laws.Result:
        e = estimator(laws.with_knowledge(c, known), seed=5)
        poses = {"E": e.E, "R": e.R, "t": e.t, "focals": e.focals}
        return _results(e) | {field: torch.nan_to_num(value, 7) for field, value in poses.items() if value is not None}

    return laws.Subject(f"estimator={name}, {known} cameras", run)


def _subjects() -> list[laws.Subject]:
    """Every preset of these groups: a new file in conf/ joins by being there."""
    estimators = [_estimator(n) for n in variants("estimator") if not n.startswith(OTHER_LIBRARIES[1:])]
    cameras = [_calibrated("msac", "exact"), *(_calibrated("fmtorch", known) for known in laws.KNOWLEDGE)]
    return [*estimators, *cameras, *(_pruner(n) for n in PRUNERS), *(_noisy(n) for n in NOISY)]


def _row(result: laws.Result, c: Correspondences, i: int) -> laws.Result:
    """Pair i of a batch, with what is per match reduced to the matches that are not masked."""
    return laws.live_values({name: value[i : i + 1] for name, value in result.items()}, c[i])


def _part(result: laws.Result, rows: list[int], c: Correspondences) -> laws.Result:
    """Rows of a batch, as of `c`, which holds them alone."""
    n = c.mask.shape[1]
    return {name: value[rows, :n] if name in PER_MATCH else value[rows] for name, value in result.items()}


GOOD = [laws.scene(1), laws.scene(2, 60)]
SUBJECTS = _subjects()
PLAIN = [s for s in SUBJECTS if not s.name.endswith("with noise")]
everything = pytest.mark.parametrize("subject", SUBJECTS, ids=[s.name for s in SUBJECTS])


@everything
def test_padding_is_invisible(subject: laws.Subject) -> None:
    """Garbage of three kinds in one batch, of one kind in each pair."""
    garbage = (float("nan"), 1e30, -7.0, float("nan"), 1e30)
    plain = laws.scenes()
    padded = collate([laws.with_padding(plain[i], np.random.default_rng(i), kind) for i, kind in enumerate(garbage)])
    padded_result, expected = subject.run(padded), subject.run(plain)
    for i, kind in enumerate(garbage):
        alone, unpadded = _row(padded_result, padded, i), _row(expected, plain, i)
        laws.assert_same(unpadded, alone, f"{subject.name}, pair {i} with {kind} in masked slots")


@everything
def test_neighbours_are_invisible(subject: laws.Subject) -> None:
    """Pairs of many matches and of few, down to those that determine no model, in one batch; alone; few beside few."""
    counts = (150, 40, 333, *((700,) if subject.name.startswith("estimator") else ()))
    pairs = [laws.scene(i, count) for i, count in enumerate(counts)] + list(laws.small().values())
    together, few = subject.run(collate(pairs)), list(range(len(counts), len(pairs)))
    for rows in (*([i] for i in range(len(counts))), few[:1], few[-1:], few):
        c = collate([pairs[row] for row in rows])
        laws.assert_same(subject.run(c), _part(together, rows, c), f"{subject.name}, pairs {rows}")
    for value in together.values():
        assert not bool(torch.isnan(value.to(torch.float64)).any()), f"{subject.name}: NaN"


@everything
def test_no_pair_takes_its_batch_down(subject: laws.Subject) -> None:
    """Beside degenerate pairs of every kind two good ones stay as they are, and no pair has NaN."""
    kinds = laws.degenerate()
    good = collate(GOOD)
    alone = subject.run(good)

    def beside(names: list[str]) -> laws.Result:
        mixed = subject.run(collate([GOOD[0], *(kinds[kind] for kind in names), GOOD[1]]))
        laws.assert_same(alone, _part(mixed, [0, -1], good), f"{subject.name} beside {', '.join(names)}")
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


@pytest.mark.parametrize("name", OWN)
def test_batch_workers_and_threads_change_nothing(name: str) -> None:
    estimator, pairs = laws.quick(name, 60, 30), [laws.scene(i, 24 + 53 * i % 120) for i in range(8)]

    def run(batch: list[Correspondences]) -> laws.Result:
        return _results(estimator(collate(batch), seed=5))

    threads = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        threaded = run(pairs)
    finally:
        torch.set_num_threads(threads)
    five = _part(threaded, list(range(5)), collate(pairs[:5]))
    laws.assert_same(run(pairs[:5]), five, f"{name}: 5, and 8 in threads")
    with ThreadPoolExecutor(4) as workers:
        for i, alone in enumerate(workers.map(lambda pair: run([pair]), pairs)):
            laws.assert_same(alone, _part(threaded, [i], pairs[i]), f"{name}: pair {i} alone, in one of four workers")
