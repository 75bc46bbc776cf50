"""Pruners of `PRESET@PRUNER+PRUNER` that look at the images get them."""

from __future__ import annotations

import pytest
import torch

from fmtorch.core.types import Correspondences
from fmtorch.data import load, read_image, to_grey
from fmtorch.data.construction import keypoints, ratio_matches
from fmtorch.presets import build as preset
from scripts.benchmark.specs import build, informed, pruned_by, pruners_of


def test_a_pruner_that_looks_at_images_is_given_those_of_the_pair() -> None:
    pair = load("stereo")[0]
    grey = [to_grey(read_image(image)) for image in (pair.image0, pair.image1)]
    x0, x1 = (torch.from_numpy(x)[None, :200].float() for x in ratio_matches(*map(keypoints, grey)))
    sizes = [torch.tensor([image.shape]) for image in grey]
    c = Correspondences(x0, x1, torch.ones(x0.shape[:2], dtype=torch.bool), size0=sizes[0], size1=sizes[1])
    spec = "lmeds@refine_matches"
    refined = pruned_by(pruners_of(spec), pair, c)
    moved = (refined.x1 - c.x1).norm(dim=-1)
    assert refined.noise is not None
    assert 0.5 < float((moved > 0).float().mean()) <= 1
    expected = preset("estimator", "lmeds")(refined, 3)
    assert torch.equal(informed(spec)(pair, c, 3).F, expected.F)
    with pytest.raises(ValueError, match="refine_matches needs the images"):
        build(spec)(c, 3)
