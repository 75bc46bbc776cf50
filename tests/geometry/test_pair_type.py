"""Evidence for the kinds of pairs: the reference, the decision, the laws."""

import numpy as np
import pytest
import torch

from fmtorch.core import PAIR_TYPES
from fmtorch.geometry.pair_type import classified, pair_evidence
from tests.geometry.scenes import SIZE, K, batch, draw
from tests.reference import significance as reference
from tests.reference.solvers import sampson

SIDE = float(np.sqrt(SIZE[0] * SIZE[1]))


@pytest.mark.parametrize("kind", PAIR_TYPES)
@pytest.mark.parametrize("known", [False, True])
def test_against_the_definitions(kind: str, known: bool) -> None:
    drawn = draw(kind, 0, 80)
    rng = np.random.default_rng(0)
    n, P = rng.uniform(0.7, 1.5, 80), rng.uniform(0, 1, 80)
    precision = np.diag([np.inf, np.inf]) if known else np.array([[2500.0, -1000], [-1000, 1500]])
    given = batch([drawn]) | {
        "noise": torch.from_numpy(n)[None],
        "prior": torch.from_numpy(P)[None],
        "focal_precision": torch.from_numpy(precision)[None],
    }
    evidence = pair_evidence(**given)
    line = np.abs(sampson(drawn.F, drawn.x0, drawn.x1)) / n
    plane = reference.plane_distances(drawn.H, drawn.x0, drawn.x1) / n
    s = min(reference.noise(P, line, 1, SIDE), reference.noise(P, plane, 2, SIDE))
    of_line, of_plane = reference.density(line, s, 1, SIDE), reference.density(plane, s, 2, SIDE)
    np.testing.assert_allclose(float(evidence.noise[0]), s, rtol=1e-6)
    both, shares = reference.log_likelihood(P, of_plane, of_line)
    # exp by its approximant is good to 1e-9 of a density of some thousands.
    np.testing.assert_allclose(float(evidence.line[0]), reference.log_likelihood(P, of_line)[0], atol=1e-4)
    np.testing.assert_allclose(float(evidence.plane[0]), reference.log_likelihood(P, of_plane)[0], atol=1e-4)
    np.testing.assert_allclose(float(evidence.both[0]), both, atol=1e-4)
    np.testing.assert_allclose([float(evidence.on_plane[0]), float(evidence.on_line[0])], shares[1:], atol=1e-5)
    copy = reference.copy(plane, drawn.x0, drawn.x1, s, n)
    distances = reference.plane_distances(copy, drawn.x0, drawn.x1) / n
    expected = reference.log_likelihood(P, reference.density(distances, s, 2, SIDE))[0]
    np.testing.assert_allclose(float(evidence.copy[0]), expected, atol=1e-4)
    np.testing.assert_allclose(evidence.scaled[0].numpy(), [copy[0, 0], copy[0, 2], copy[1, 2]], rtol=1e-6)
    if kind == "rotation":  # where it fits there is one optimum
        turned, R, cost = reference.rotation(drawn.H, drawn.x0, drawn.x1, K, K, precision, s, n)
        distances = reference.plane_distances(turned, drawn.x0, drawn.x1) / n
        expected = reference.log_likelihood(P, reference.density(distances, s, 2, SIDE))[0] - cost
        # At an optimum: what a step that gains less than 1e-4 leaves of it.
        np.testing.assert_allclose(float(evidence.rotation[0]), expected, atol=0.05)
        np.testing.assert_allclose(evidence.R[0].numpy(), R, atol=1e-4)
        assert known == bool((evidence.log_focal == 0).all())


@pytest.mark.parametrize("kind", PAIR_TYPES)
def test_kinds_of_synthetic_pairs(kind: str) -> None:
    """Of perfect models, at three levels of noise and of wrong matches, 20 pairs each."""
    for noise in (0.2, 0.5, 1.5):
        for wrong in (0.0, 0.3, 0.6):
            pairs = batch([draw(kind, seed, 150, wrong, noise) for seed in range(20)])
            kinds = classified(pair_evidence(**pairs))
            right = int((kinds == PAIR_TYPES.index(kind)).sum())
            assert right >= 19, (noise, wrong, [PAIR_TYPES[i] for i in kinds.tolist()])


def test_matches_off_the_plane_make_a_pair_general() -> None:
    planar = classified(pair_evidence(**batch([draw("planar", seed) for seed in range(30)])))
    general = classified(pair_evidence(**batch([draw("planar", seed, off_plane=30) for seed in range(30)])))
    assert [PAIR_TYPES[i] for i in planar.tolist()].count("planar") >= 29
    assert [PAIR_TYPES[i] for i in general.tolist()].count("general") >= 29


def test_no_unit_is_special() -> None:
    """Images twice as large, noise and all, are of the same kinds by the same evidence."""
    pairs = batch([draw(kind, 3, noise=0.5) for kind in PAIR_TYPES if kind != "unrelated"])
    twice = dict(pairs)
    grow = torch.diag(torch.tensor([2.0, 2, 1], dtype=torch.float64))
    shrink = torch.linalg.inv(grow)
    for name in ("x0", "x1", "size0", "size1"):
        twice[name] = 2 * pairs[name]
    twice |= {"F": shrink @ pairs["F"] @ shrink, "H": grow @ pairs["H"] @ shrink}
    twice |= {"K0": grow @ pairs["K0"], "K1": grow @ pairs["K1"]}
    single, doubled = pair_evidence(**pairs), pair_evidence(**twice)
    for name in ("line", "plane", "both", "copy"):
        torch.testing.assert_close(getattr(single, name), getattr(doubled, name), rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(2 * single.noise, doubled.noise)
    assert torch.equal(classified(single), classified(doubled))


def test_threads_change_nothing() -> None:
    many = batch([draw(PAIR_TYPES[i % 5], i, 60) for i in range(40)])
    alone, threads = pair_evidence(**many), torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        parallel = pair_evidence(**many)
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(parallel, alone, strict=True))


def test_hopeless_pairs_are_unrelated_or_general() -> None:
    bad = batch([draw("general", i, 60) for i in range(9)])
    bad["F"][0], bad["H"][1], bad["mask"][2] = 0, 0, False
    bad["F"][3, 0, 0], bad["H"][4, 0, 0] = torch.nan, torch.inf
    bad["K0"] = bad["K0"].index_fill(0, torch.tensor([5]), torch.nan)
    bad["x0"][6], bad["x1"][6] = 5.0, 7.0
    bad["K1"] = bad["K1"].clone()
    bad["K1"][7] = torch.tensor([[1.0, 2, 3], [2, 4, 6], [0, 0, 1]])
    evidence = pair_evidence(**bad)
    assert not any(bool(value.isnan().any()) for value in evidence)
    kinds = [PAIR_TYPES[i] for i in classified(evidence).tolist()]
    assert kinds[2] == "unrelated"
    assert kinds[1] == kinds[4] == kinds[5] == kinds[7] == kinds[8] == "general"
    assert classified(pair_evidence(**{k: v[:0] for k, v in bad.items()})).shape == (0,)
