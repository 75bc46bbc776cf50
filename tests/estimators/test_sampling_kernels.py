"""Samples drawn by the kernel: those of the tensor form, number by number."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from fmtorch.estimators.one_pair import sampling as one_pair
from fmtorch.estimators.one_pair.pair import each_pair
from fmtorch.estimators.one_pair.solvers import MinimalSamples, SevenPoint
from fmtorch.estimators.pairs import normalized_pairs
from fmtorch.estimators.sampling import PriorWeighted, Prosac, Uniform

from fmtorch.core.streams import Stream, mixed_seed
from fmtorch.core.types import Correspondences
from fmtorch.estimators import sampling_kernels, solvers
from fmtorch.estimators.registry import kernel_form
from tests.estimators.draws import drawn
from tests.laws import scene

pytest.importorskip("numba", reason="numba is not installed")


def pair(count: int, prior: str = "given") -> Correspondences:
    c = scene(count, count)
    if prior == "none":
        return c.replace(prior=None)
    if prior == "zero":
        return c.replace(prior=torch.zeros_like(c.x0[..., 0]))
    if prior == "one certain":
        return c.replace(prior=(torch.arange(count) == count // 2).float()[None])
    return c


@pytest.mark.parametrize("prior", ["given", "none", "zero", "one certain"])
@pytest.mark.parametrize("size", [5, 7, 8])
@pytest.mark.parametrize("count", [8, 9, 40, 150, 700, 5000])
def test_weighted_samples(count: int, size: int, prior: str) -> None:
    (pairs,), _ = normalized_pairs(pair(count, prior), 3, 7)
    for sampler in (PriorWeighted(), Uniform()):
        for start, draws in ((0, 300), (700, 41)):
            expected = sampler.draw(pairs, start, draws, size)[:, 0]
            cumulative = sampler.weight(pairs)[0, :count].cumsum(0).numpy()
            for given in (cumulative, np.empty(0, np.int64)):
                if len(given) == 0 and int(cumulative[-1]) != count:
                    continue  # not all weights are one
                out = np.empty((size, draws), np.int64)
                totals = np.full(draws, cumulative[-1])
                seed = mixed_seed(3, Stream.SAMPLING)
                sampling_kernels.draw(given, totals, seed, int(pairs.key[0]), start, out)
                np.testing.assert_array_equal(out, expected.numpy())


@pytest.mark.parametrize("count", [8, 40, 700])
def test_samples_of_prosac(count: int) -> None:
    (pairs,), _ = normalized_pairs(pair(count), 3, 7)
    sampler = Prosac()
    for size in (5, 7, 8):
        expected = sampler.growth(pairs, size)[0, :count].numpy()
        table = np.empty(count, np.int64)
        sampling_kernels.prosac_table(size, sampler.GROWTH, table)
        np.testing.assert_array_equal(table, expected)
        for start in (0, 5000, 250_000):
            samples = sampler.draw(pairs, start, 200, size)[:, 0].numpy()
            newest = np.minimum(np.searchsorted(table, np.arange(start + 1, start + 201)), count - 1)
            others = np.empty((size - 1, 200), np.int64)
            seed, none = mixed_seed(3, Stream.SAMPLING), np.empty(0, np.int64)
            sampling_kernels.draw(none, newest, seed, int(pairs.key[0]), start, others)
            assert pairs.quality is not None
            order = np.argsort(pairs.quality[0, :count].numpy(), kind="stable")
            np.testing.assert_array_equal(order[np.vstack([others, newest])], samples)


def test_prosac_without_a_rank_draws_the_same_uniform_samples() -> None:
    (pairs,), _ = normalized_pairs(pair(100).replace(quality=None, prior=None), 3, 7)
    (one,) = each_pair(pairs)
    expected = Prosac().draw(pairs, 100, 300, 7)[:, 0].numpy()
    np.testing.assert_array_equal(drawn(one_pair.Prosac(Prosac()), one, 100, 300, 7), expected)


@pytest.mark.parametrize("prior", ["given", "none"])
@pytest.mark.parametrize("tensors", [Uniform(), Prosac(), PriorWeighted()])
def test_samples_that_are_drawn_and_solved_in_one_call(tensors: Any, prior: str) -> None:
    (pairs,), _ = normalized_pairs(pair(150, prior), 3, 7)
    (one,) = each_pair(pairs)
    expected = tensors.draw(pairs, 60, 200, 7)[:, 0].numpy()
    solver = SevenPoint(solvers.SevenPoint())
    samples = MinimalSamples(solver, kernel_form(tensors))(one, 60, 200).samples
    np.testing.assert_array_equal(samples, expected)
