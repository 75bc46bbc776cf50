"""Pruners in general: known answers, edge cases, input of any size, match noise."""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

import fmtorch
from fmtorch import presets, pruning
from fmtorch.core import Correspondences, Features
from fmtorch.matching import NearestNeighborMatcher
from fmtorch.pruning.consistency import CURVES, MIN_VOTE, NOISE, SCALES, TOLERANCE, TURNS, WINDOW, WORST_RATIO
from tests.geometry.scenes import scene as matched_scene
from tests.laws import calibrated, degenerate, quick_pruner, scene, scenes, small, with_padding
from tests.processes import run_command
from tests.reference import consistency, gms, local_features, lpm
from tests.test_laws import PRUNERS
from tests.variants import built

SIZE = (640, 960)  # of the images of a scene
NUMBERS = {"usual": 4.06, "radius": 15.0, "slope": 0.65}
PER_MATCH = ("x0", "x1", "ratio", "prior", "lafs0", "lafs1", "mutual")


def test_ratio_is_strict_and_refuses_nan() -> None:
    ratio = torch.tensor([[0.0, 0.79, 0.8, 1.0, math.nan]])
    assert pruning.ratio_test(ratio, 0.8).tolist() == [[True, True, False, False, False]]
    assert pruning.ratio_test(ratio, 0.8, torch.tensor([[False, True, True, True, True]])).sum() == 1


@pytest.mark.parametrize("seed", range(2))
def test_ratio_and_mutual_stages_equal_their_definitions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d0, d1 = rng.random((30, 8), np.float32), rng.random((24 + seed, 8), np.float32)
    d1[:10] = d0[:10] + rng.normal(0, 0.05, (10, 8))

    def features(descriptors: np.ndarray) -> Features:
        n = len(descriptors)
        lafs = torch.zeros(n, 2, 3)
        lafs[:, :, 2] = torch.from_numpy(rng.random((n, 2)))
        return Features(lafs, torch.ones(n), torch.from_numpy(descriptors), torch.tensor([9, 9]))

    matches = NearestNeighborMatcher()(features(d0), features(d1))
    ratio, both = pruning.RatioTest(0.8)(matches).mask[0], pruning.MutualCheck()(matches).mask[0]
    np.testing.assert_array_equal(ratio, local_features.ratio_test(d0, d1, 0.8))
    np.testing.assert_array_equal(both, local_features.mutual(d0, d1))
    assert 0 < int(ratio.sum()) < 30
    assert 0 < int(both.sum()) < 30
    order = matches.compact()
    assert torch.equal(pruning.MutualCheck()(order).count(), both.sum()[None])


@settings(max_examples=80, deadline=None)
@given(st.data(), st.integers(0, 12))
def test_one_to_one_equals_the_definition(data: st.DataObject, n: int) -> None:
    coordinates, ratios = st.sampled_from([0.0, -0.0, 0.1, 1.5]), st.sampled_from([0.25, 0.5, math.inf])
    x0, x1 = (data.draw(arrays(np.float32, (n, 2), elements=coordinates)) for _ in range(2))
    ratio = data.draw(arrays(np.float32, (n,), elements=ratios))
    mask = pruning.one_to_one(*(torch.from_numpy(a)[None] for a in (x0, x1, ratio)))
    np.testing.assert_array_equal(mask[0], local_features.one_to_one(x0, x1, ratio))


def test_stages_are_their_functions_need_their_fields_and_keep_the_rest() -> None:
    c = scene(0, 20)
    c = c.replace(x0=c.x0.flip(1).where(c.mutual[..., None], c.x0[:, :1]))  # several matches at one place
    ratio, unique = pruning.ratio_test(c.ratio, 0.5), pruning.one_to_one(c.x0, c.x1, c.ratio)
    stages = [(pruning.RatioTest(0.5), "ratio", ratio), (pruning.OneToOne(), "ratio", unique)]
    for stage, field, expected in (*stages, (pruning.MutualCheck(), "mutual", c.mutual)):
        out = stage(c)
        assert torch.equal(out.mask, expected)
        assert torch.equal(out.x0, c.x0)
        with pytest.raises(ValueError, match=f"needs `{field}`"):
            stage(c.replace(**{field: None}))


def edge_cases() -> dict[str, Correspondences]:
    c, single = scene(0, 300), scene(0, 1)
    right, bottom = float(SIZE[1] - 1), float(SIZE[0] - 1)
    inside = [[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]]
    border = torch.tensor([*inside, [right + 1, bottom + 1], [-0.5, -0.5], [right + 50, 7.0], [3.0, -90.0]])
    on_border = border.repeat(40, 1)[:300][None]
    one_cell = c.x0 / 100 + 200
    return {
        "no slots": single.replace(**{f: getattr(single, f)[:, :0] for f in ("mask", *PER_MATCH)}),
        "one cell": c.replace(x0=one_cell, x1=one_cell + 5),
        "on and outside the border": c.replace(x0=on_border, x1=on_border.flip(1)),
    }  # fmt: skip


@pytest.mark.parametrize("name", PRUNERS)
@pytest.mark.parametrize("case", edge_cases())
def test_edge_case(name: str, case: str) -> None:
    c = edge_cases()[case]
    pruned = quick_pruner(name)(calibrated(c))
    assert pruned.mask.shape == c.mask.shape
    assert not (pruned.mask & ~c.mask).any()
    if pruned.prior is not None and pruned.prior is not c.prior:
        assert ((pruned.prior >= 0) & (pruned.prior <= 1)).all()
        assert not pruned.prior[~c.mask].any()


@pytest.mark.parametrize("name", ["gms", "lpm", "gms:soft=true", "lpm:soft=true", "position_consistency"])
def test_matches_that_all_move_alike_in_one_cell_are_kept(name: str) -> None:
    c = edge_cases()["one cell"].replace(ratio=None, lafs0=None, lafs1=None, prior=None)
    pruned = built("pruner", name)(c)
    assert pruned.mask.all()
    if name not in ("gms", "lpm"):
        assert pruned.prior.min() > 0.5


# The soft form of code does the same work; clnet and ncmnet compare all matches, a part at a time, in minutes.
MOST = [name for name in PRUNERS if name != "code" and not name.startswith(("clnet", "ncmnet"))]
MANY = """
import sys, torch
from tests.laws import calibrated, quick_pruner, scene
from tests.processes import peak_memory

torch.set_num_threads(1)
many, before = calibrated(scene(1, 50_000)), peak_memory()
for name in sys.argv[1:]:
    stage = quick_pruner(name)
    framed = {} if name == "frame_consistency" else {"lafs0": None, "lafs1": None}  # the scene's frames are random
    pruned = stage(many.replace(**framed))
    assert 0 < int(pruned.mask.sum()) <= 50_000, name
    assert pruned.prior is None or bool(torch.isfinite(pruned.prior).all()), name
    print(name, peak_memory() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
def test_many_matches_in_bounded_memory(tmp_path: Path) -> None:
    """50,000 matches: a table of pairs of matches would take 2.5 GB even at a byte each."""
    result = run_command("-c", MANY, *MOST, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    growth = {line.split()[0]: int(line.split()[1]) for line in result.stdout.splitlines()}
    assert list(growth) == MOST
    assert max(growth.values()) < 0.8e9, growth


def inputs() -> Iterator[tuple[str, Correspondences]]:
    yield "a batch", scenes()
    yield "padding", with_padding(scenes(), np.random.default_rng(0), float("nan"))
    yield from degenerate().items()
    yield from small().items()
    c = scene(6, 400)  # duplicates and integers: ties everywhere
    points = [(x / 90).round() * 90 for x in (c.x0, c.x1)]
    yield "ties", c.replace(x0=points[0], x1=points[1], ratio=(c.ratio * 10).round() / 10)
    signs = torch.rand(c.x0.shape, generator=torch.Generator().manual_seed(0)) < 0.5
    yield "negative zero", c.replace(x0=torch.where(signs, -0.0, 0.0))
    yield "double precision", scene(3, 300).replace(x0=scene(3, 300).x0.double() + 1e-9, x1=scene(3, 300).x1.double())


def pairs(real_matches: list[tuple[Correspondences, Tensor]]) -> Iterator[Any]:
    """Every pair of the inputs: its name, its batch and place there, and slots, x0, x1 of its finite matches."""
    for what, c in [*inputs(), *((f"real pair {i}", c) for i, (c, _) in enumerate(real_matches))]:
        finite = c.mask & torch.isfinite(c.x0).all(-1) & torch.isfinite(c.x1).all(-1)
        for i, here in enumerate(finite):
            yield f"{what}, {i}", c, i, here.numpy().nonzero()[0], c.x0[i][here].numpy(), c.x1[i][here].numpy()


def expect_mask(mask: Tensor, slots: np.ndarray, expected: np.ndarray, what: str) -> None:
    whole = np.zeros(len(mask), bool)
    whole[slots] = expected
    np.testing.assert_array_equal(mask.numpy(), whole, what)


def test_gms(real_matches: list[tuple[Correspondences, Tensor]]) -> None:
    for what, c, i, slots, x0, x1 in pairs(real_matches):
        sizes = (SIZE, SIZE) if "real" not in what else tuple(tuple(s[i].tolist()) for s in (c.size0, c.size1))  # type: ignore[index]
        if what.startswith("huge"):
            with pytest.raises(ValueError, match="lie outside such an image"):
                pruning.gms(c.x0, c.x1, size0=c.size0, size1=c.size1, mask=c.mask)
            continue
        searched = what.endswith(("random, 0", "planar, 0", "coincident, 0"))
        mask = pruning.gms(
            c.x0, c.x1, size0=c.size0, size1=c.size1, mask=c.mask, threshold_factor=3.0, with_rotation=searched,
            with_scale=searched, border="authors" if searched else "opencv",
        )[i]  # fmt: skip
        expected = gms.gms(x0, x1, sizes, searched, 3.0, authors=searched)  # type: ignore[arg-type]
        expect_mask(mask, slots, expected, what)


def test_lpm(real_matches: list[tuple[Correspondences, Tensor]]) -> None:
    for what, c, i, slots, x0, x1 in pairs(real_matches):
        survivors, costs = lpm.passes(x0.astype(np.float64), x1.astype(np.float64))
        expect_mask(pruning.lpm(c.x0, c.x1, mask=c.mask)[i], slots, np.isin(np.arange(len(slots)), survivors), what)
        expected = np.ones(c.mask.shape[1])
        expected[slots] = np.mean(costs, 0)
        computed = pruning.lpm_cost(c.x0.double(), c.x1.double(), mask=c.mask)[i]
        np.testing.assert_allclose(computed, expected, rtol=1e-12, err_msg=what)


def test_one_to_one(real_matches: list[tuple[Correspondences, Tensor]]) -> None:
    for what, c, i, slots, x0, x1 in pairs(real_matches):
        ratio = c.ratio[i].numpy()[slots]
        expected = local_features.one_to_one(x0, x1, np.where(np.isnan(ratio), np.inf, ratio))
        expect_mask(pruning.one_to_one(c.x0, c.x1, c.ratio, c.mask)[i], slots, expected, what)


def turned(c: Correspondences, angle: float, scale: float) -> Correspondences:
    R = scale * torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return c.replace(x1=c.x1 @ R.T)


@pytest.mark.parametrize("ratios", [True, False])
def test_agreement(ratios: bool) -> None:
    motions = itertools.product((1, 2, 5, 60), ((0.0, 1.0), (2.0, 0.6)))
    several = [(f"{count}, turned by {turn[0]}", turned(scene(1, count), *turn)) for count, turn in motions]
    for what, c in (*small().items(), *several):
        ratio = c.ratio if ratios else None
        vote = np.maximum(WORST_RATIO - c.ratio[0].double().numpy(), MIN_VOTE) if ratios else np.ones(len(c.mask[0]))
        x0, x1, A0, A1 = (t[0].double().numpy() for t in (c.x0, c.x1, c.lafs0[..., :2], c.lafs1[..., :2]))
        by_frames = consistency.agreement(x0, x1, A1 @ np.linalg.inv(A0), vote, CURVES, WINDOW, TOLERANCE, NOISE)
        similarity = consistency.similarity(x0, x1, CURVES, TURNS, SCALES)
        by_motion = consistency.agreement(x0, x1, similarity, vote, CURVES, WINDOW, TOLERANCE, NOISE)
        frames = pruning.frame_agreement(c.x0, c.x1, c.lafs0, c.lafs1, ratio, c.mask)[0]
        # float32: coordinates of 1e3 px are rounded to 6e-5 px, against lengths of at least 4 px
        np.testing.assert_allclose(frames, by_frames, rtol=1e-3, atol=1e-5, err_msg=what)
        motion = pruning.position_agreement(c.x0, c.x1, ratio, c.mask)[0]
        np.testing.assert_allclose(motion, by_motion, rtol=1e-3, atol=1e-5, err_msg=what)


def test_is_its_formula() -> None:
    rng = np.random.default_rng(0)
    lafs0, lafs1 = (torch.from_numpy(rng.normal(size=(2, 50, 2, 3)) * 20) for _ in range(2))
    ratio, prior = (torch.from_numpy(rng.random((2, 50))) for _ in range(2))
    noise = pruning.match_noise(lafs0, lafs1, ratio, prior, **NUMBERS)
    scales = torch.stack([lafs[..., :2].det().abs().sqrt() for lafs in (lafs0, lafs1)])
    expected = (1 + scales.amax(0) / 15) * (1 + 0.65 * ratio) ** 2 * prior.clamp(0.02) ** -0.25 / 4.06
    torch.testing.assert_close(noise, expected, rtol=1e-9, atol=0)
    inputs = [x[:1, :8].clone().requires_grad_() for x in (lafs0, lafs1, ratio, prior)]
    assert torch.autograd.gradcheck(lambda *x: pruning.match_noise(*x, **NUMBERS), inputs)


def test_matches_without_frames_are_left_as_they_are_and_what_is_unknown_is_usual() -> None:
    stage = presets.build("pruner", "match_noise")
    c = scene(0, 50)
    assert stage(c.replace(lafs0=None, lafs1=None)).noise is None
    lafs = c.lafs0.clone()
    lafs[:, 3] = float("nan")
    noise = stage(c.replace(lafs0=lafs)).noise
    assert float(noise[0, 3]) == 1
    assert bool(torch.isfinite(noise).all())
    alone = stage(c.replace(ratio=None, prior=None)).noise
    assert bool((alone[c.mask] > 0).all())


def test_known_noise_makes_estimates_more_exact() -> None:
    size, errors = torch.tensor([[800, 1000]]), []
    for seed in range(6):
        rng, exact = np.random.default_rng(seed), matched_scene(120, seed)
        noise = torch.from_numpy(np.where(rng.random(120) < 0.5, 0.3, 3.0))
        x0, x1 = (x + torch.from_numpy(0.3 * rng.normal(size=(120, 2))) * noise[:, None] for x in (exact.x0, exact.x1))
        row = []
        for known in (None, noise):
            estimate = fmtorch.find_fundamental(x0, x1, noise=known)
            row.append(float(fmtorch.metrics.nsgd(exact.F[None], estimate.F, size, size)))
        errors.append(row)
    without, with_noise = np.median(errors, 0)
    assert with_noise < 0.6 * without
