"""Pruners on random, degenerate, small, tied and real input against their definitions, one pair and batches."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.core import Correspondences
from fmtorch.pruning import frame_agreement, gms, lpm, lpm_cost, one_to_one, position_agreement
from fmtorch.pruning.consistency import CURVES, MIN_VOTE, NOISE, SCALES, TOLERANCE, TURNS, WINDOW, WORST_RATIO
from tests.laws import degenerate, scene, scenes, small, with_padding
from tests.reference import consistency
from tests.reference.gms import gms as gms_reference
from tests.reference.local_features import one_to_one as one_to_one_reference
from tests.reference.lpm import passes

SIZE = (640, 960)  # of the images of a scene


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


def pairs(
    real_matches: list[tuple[Correspondences, Tensor]],
) -> Iterator[tuple[str, Correspondences, int, np.ndarray, np.ndarray, np.ndarray]]:
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
                gms(c.x0, c.x1, size0=c.size0, size1=c.size1, mask=c.mask)
            continue
        searched = what.endswith(("random, 0", "planar, 0", "coincident, 0"))
        mask = gms(
            c.x0, c.x1, size0=c.size0, size1=c.size1, mask=c.mask, threshold_factor=3.0, with_rotation=searched,
            with_scale=searched, border="authors" if searched else "opencv",
        )[i]  # fmt: skip
        expected = gms_reference(x0, x1, *sizes, searched, searched, 3.0, authors=searched)  # type: ignore[arg-type]
        expect_mask(mask, slots, expected, what)


def test_lpm(real_matches: list[tuple[Correspondences, Tensor]]) -> None:
    for what, c, i, slots, x0, x1 in pairs(real_matches):
        survivors, costs = passes(x0.astype(np.float64), x1.astype(np.float64))
        expect_mask(lpm(c.x0, c.x1, mask=c.mask)[i], slots, np.isin(np.arange(len(slots)), survivors), what)
        expected = np.ones(c.mask.shape[1])
        expected[slots] = np.mean(costs, 0)
        computed = lpm_cost(c.x0.double(), c.x1.double(), mask=c.mask)[i]
        np.testing.assert_allclose(computed, expected, rtol=1e-12, err_msg=what)


def test_one_to_one(real_matches: list[tuple[Correspondences, Tensor]]) -> None:
    for what, c, i, slots, x0, x1 in pairs(real_matches):
        ratio = c.ratio[i].numpy()[slots]
        expected = one_to_one_reference(x0, x1, np.where(np.isnan(ratio), np.inf, ratio))
        expect_mask(one_to_one(c.x0, c.x1, c.ratio, c.mask)[i], slots, expected, what)


@pytest.mark.parametrize("ratios", [True, False])
def test_agreement_of_few_matches(ratios: bool) -> None:
    for what, c in small().items():
        ratio = c.ratio if ratios else None
        vote = np.maximum(WORST_RATIO - c.ratio[0].double().numpy(), MIN_VOTE) if ratios else np.ones(len(c.mask[0]))
        x0, x1, A0, A1 = (t[0].double().numpy() for t in (c.x0, c.x1, c.lafs0[..., :2], c.lafs1[..., :2]))
        by_frames = consistency.agreement(
            x0, x1, A1 @ np.linalg.inv(A0), vote, CURVES, WINDOW, TOLERANCE, NOISE
        )  # fmt: skip
        similarity = consistency.similarity(x0, x1, CURVES, TURNS, SCALES)
        by_motion = consistency.agreement_of_positions(x0, x1, similarity, vote, CURVES, WINDOW, TOLERANCE, NOISE)
        frames = frame_agreement(c.x0, c.x1, c.lafs0, c.lafs1, ratio, c.mask)[0]
        # float32: coordinates of 1e3 px are rounded to 6e-5 px, against lengths of at least 4 px
        np.testing.assert_allclose(frames, by_frames, rtol=1e-3, atol=1e-5, err_msg=what)
        motion = position_agreement(c.x0, c.x1, ratio, c.mask)[0]
        np.testing.assert_allclose(motion, by_motion, rtol=1e-3, atol=1e-5, err_msg=what)
