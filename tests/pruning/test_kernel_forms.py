"""Each pruner's kernel against its tensor form: random, degenerate, small and real input, one pair and batches."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch import presets
from fmtorch.core.types import Correspondences
from fmtorch.jit import kernel as switch
from fmtorch.jit.kernel import F8x2, I8x2, kernel
from fmtorch.pruning import neighbors as knn_kernels
from tests.laws import degenerate, scene, scenes, small, with_padding
from tests.variants import built

pytest.importorskip("numba", reason="numba is not installed")

PRUNERS = (
    "frame_consistency", "gms", "gms:soft=true", "lpm", "lpm:soft=true", "match_noise", "one_to_one",
    "position_consistency", "ratio_prior",
)  # fmt: skip
SEARCHED = {"with_rotation": True, "with_scale": True}


def both_forms(
    c: Correspondences, name: str, monkeypatch: pytest.MonkeyPatch, **options: object
) -> tuple[Correspondences, Correspondences]:
    stage = built("pruner", name, **options)
    monkeypatch.setenv(switch.SWITCH, "on")
    compiled = stage(c)
    monkeypatch.setenv(switch.SWITCH, "off")
    return compiled, stage(c)


def assert_alike(pair: tuple[Correspondences, Correspondences], what: str, rounding: float = 0) -> None:
    """To the bit: both forms do the same to the same numbers, in the same order; rounding: a relative error."""
    compiled, tensors = pair
    assert torch.equal(compiled.mask, tensors.mask), what
    for field in ("prior", "noise"):
        a, b = getattr(compiled, field), getattr(tensors, field)
        if b is None:
            assert a is None, what
            continue
        assert a.dtype == b.dtype, what
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=rounding, atol=0, err_msg=f"{what}: {field}")


def inputs() -> Iterator[tuple[str, Correspondences]]:
    yield "a batch", scenes()
    yield "padding", with_padding(scenes(), np.random.default_rng(0), float("nan"))
    yield "many", scene(5, 3000)
    yield from degenerate().items()
    yield from small().items()
    c = scene(6, 400)  # duplicates and integers: ties everywhere
    points = [(x / 90).round() * 90 for x in (c.x0, c.x1)]
    assert c.quality is not None
    yield "ties", c.replace(x0=points[0], x1=points[1], quality=(c.quality * 10).round() / 10)
    yield "without ratio", scene(7, 100).replace(quality=None)
    yield "negative zero", c.replace(x0=torch.where(torch.rand(c.x0.shape) < 0.5, -0.0, 0.0))


@pytest.mark.parametrize("name", PRUNERS)
def test_both_forms_are_alike(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for what, c in inputs():
        if name != "one_to_one" or c.quality is not None:
            assert_alike(both_forms(c, name, monkeypatch), what)


def test_gms_that_searches_rotations_and_scales(monkeypatch: pytest.MonkeyPatch) -> None:
    for what, c in inputs():
        for name in ("gms", "gms:soft=true"):
            assert_alike(both_forms(c, name, monkeypatch, **SEARCHED, border="authors"), what)


@pytest.mark.parametrize("name", PRUNERS)
def test_both_forms_are_alike_on_real_matches(
    name: str, real_matches: list[tuple[Correspondences, Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for i, (c, _) in enumerate(real_matches):
        assert_alike(both_forms(c, name, monkeypatch), f"pair {i}")


@pytest.mark.parametrize("name", ["position_consistency", "gms:soft=true", "lpm:soft=true", "gms", "lpm", "one_to_one"])
def test_double_precision_is_served(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """GMS and LPM decide alike; agreement is computed in float32, in which points of a curve's cell are rounded."""
    c = scene(3, 300)
    assert c.quality is not None
    c = c.replace(x0=c.x0.double() + 1e-9, x1=c.x1.double(), quality=c.quality.double())
    # Log-odds of up to 12 are the sum of three float32 terms of a size, and their error that of ln P.
    assert_alike(both_forms(c, name, monkeypatch), name, 4 * 12 * 2**-24)


def test_gradients_take_the_tensor_form() -> None:
    c = scene(2, 50)
    x0 = c.x0.clone().requires_grad_()
    for name in ("frame_consistency", "position_consistency"):
        stage = presets.build("pruner", name)
        assert stage(c.replace(x0=x0)).prior.requires_grad
        with torch.no_grad():
            assert not stage(c.replace(x0=x0)).prior.requires_grad


@kernel
def nearest_points(queries: F8x2, points: F8x2, neighbors: I8x2) -> None:
    knn_kernels.search(queries, points, neighbors)


@pytest.mark.parametrize("kind", ["random", "clustered", "integers", "one point", "a line"])
def test_nearest_points_are_those_of_an_exhaustive_search(kind: str) -> None:
    rng = np.random.default_rng(0)
    for n, m, count in ((1, 1, 3), (5, 7, 9), (50, 8, 9), (200, 9, 9), (300, 500, 9), (100, 2000, 5), (3, 0, 4)):
        queries, points = rng.random((n, 2)), rng.random((m, 2))
        if kind == "clustered":
            points, queries = points**9, queries**9
        if kind == "integers":
            points, queries = np.floor(points * 6), np.floor(queries * 6)
        if kind == "one point":
            points[:] = 0.5
        if kind == "a line":
            points[:, 1], queries[:, 1] = points[:, 0] / 2, 0.25
        neighbors = np.empty((n, count), np.int64)
        nearest_points(queries, points, neighbors)
        squared = (points[None, :, 0] - queries[:, None, 0]) ** 2 + (points[None, :, 1] - queries[:, None, 1]) ** 2
        expected = np.full((n, count), -1)
        nearest = np.argsort(squared, 1, kind="stable")[:, :count]
        expected[:, : nearest.shape[1]] = nearest
        np.testing.assert_array_equal(neighbors, expected, f"{n} among {m}")
