"""The five-point algorithm and its focal lengths by kernels, against the tensor form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from fmtorch.estimators.focal import prior
from fmtorch.estimators.focal.cameras import CentredPairs
from fmtorch.estimators.focal.hypotheses import FocalSamples
from fmtorch.estimators.focal.hypotheses_kernels import draw_depths
from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs

from fmtorch.core.streams import Stream, mixed_seed
from fmtorch.geometry.arithmetic import exponential
from fmtorch.geometry.five_point_kernels import five_point
from tests.laws import degenerate, scene, small

pytest.importorskip("numba", reason="numba is not installed")

SEED, START, SAMPLES = 3, 100, 203  # not whole lanes


def pairs() -> dict[str, NormalizedPairs]:
    given = {"random": scene(1, 300), "other sizes": scene(2, 300), **degenerate(), **small()}
    given["other sizes"] = given["other sizes"].replace(size1=torch.tensor([[960, 960]]))
    made = {name: normalized_pairs(c, SEED, 7)[0] for name, c in given.items()}
    return {name: some[0] for name, some in made.items() if some}


def depths(pair: NormalizedPairs, centred: CentredPairs) -> np.ndarray:
    mean, deviation = math.log(prior.USUAL_FOCAL), prior.FOCAL_DEVIATION
    numbers = np.array([mean, deviation, prior.RATIO_DEVIATION / 2, prior.SAME_CAMERA_SHARE], np.float64)
    out, seed = np.empty((2, SAMPLES)), mixed_seed(SEED, Stream.FOCAL)
    same, longest = bool(centred.same_size[0]), centred.longest[:, 0].contiguous().numpy()
    draw_depths(prior.NORMAL.numpy(), numbers, same, longest, seed, int(pair.key[0]), START, out)
    return out


def test_models_are_those_of_the_tensor_form() -> None:
    for name, pair in pairs().items():
        n, centred = int(pair.count[0]), CentredPairs(pair)
        depth = depths(pair, centred)
        focal = prior.draw_focal_lengths(pair, centred.same_size, START, SAMPLES)
        np.testing.assert_array_equal(depth, (exponential(focal) * centred.longest[..., None])[:, 0].numpy())
        rng = np.random.default_rng(0)
        sample = np.stack([rng.permutation(n)[:5] for _ in range(SAMPLES)], 1)
        points = np.ascontiguousarray(centred.points[:, 0, :n].numpy())
        F, draw = np.empty((10 * SAMPLES, 9), np.float32), np.empty(10 * SAMPLES, np.int64)
        count = five_point(points, sample, depth, centred.offset[:, 0].contiguous().numpy(), F, draw)
        assert np.isfinite(F[:count]).all()
        assert (np.diff(draw[:count]) >= 0).all()
        if name not in ("random", "other sizes", "all outliers", "20 random"):
            continue
        index = torch.from_numpy(sample)[:, None]
        expected = FocalSamples(lambda *_, index=index: index)(pair, START, SAMPLES)
        models = expected.F[:, 0][:, expected.valid[0]].T.numpy()
        assert len(models) == count > 50
        # Models of nearly double roots are unstable; the others equal to the rounding of float32.
        apart = np.abs(F[:count] - models).max(1)
        assert np.quantile(apart, 0.95) < 1e-6, name
        assert np.quantile(apart, 0.99) < 1e-3, name


def test_models_explain_their_samples() -> None:
    pair = pairs()["random"]
    centred = CentredPairs(pair)
    sample = np.stack([np.random.default_rng(s).permutation(300)[:5] for s in range(SAMPLES)], 1)
    F, draw = np.empty((10 * SAMPLES, 9), np.float32), np.empty(10 * SAMPLES, np.int64)
    points = np.ascontiguousarray(centred.points[:, 0, :300].numpy())
    count = five_point(points, sample, depths(pair, centred), centred.offset[:, 0].contiguous().numpy(), F, draw)
    own = pair.points[:, 0].numpy()[:, sample[:, draw[:count]]]
    x0, x1 = (np.concatenate([x, np.ones((1, 5, count))]) for x in (own[:2], own[2:]))
    residual = np.einsum("isk,kij,jsk->ks", x1, F[:count].astype(np.float64).reshape(-1, 3, 3), x0)
    assert np.abs(residual).max() < 1e-5  # float32 models of points of about 1
