"""Pruners that look at images: what pipelines hand them, and how often files are read for it."""

import collections
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fmtorch import data, match, presets
from fmtorch.core import ImagePruner
from fmtorch.data import GivenMatches, read_image
from fmtorch.geometry import sampson
from fmtorch.io import MatchStore
from fmtorch.pipeline import FolderMatches, Pipeline, load_pipeline, match_records
from tests.conftest import shared_path

PRUNERS = "pruner=[ratio,one_to_one,frame_consistency,match_noise,refine_matches]"


def built(cache: str = "off") -> Pipeline:
    pipeline: Pipeline = load_pipeline(
        "sift_fmtorch", overrides=[PRUNERS, f"cache={cache}", "features.max_features=1500"]
    )
    return pipeline


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> collections.Counter[Any]:
    """How often each file is read."""
    counts: collections.Counter[Any] = collections.Counter()

    def counted(source: Any) -> Any:
        counts[source.path] += 1
        return read_image(source)

    monkeypatch.setattr("fmtorch.pipeline.pipeline.read_image", counted)
    return counts


def test_files_are_read_once_and_matches_are_refined(reads: collections.Counter[Any], tmp_path: Any) -> None:
    """Also where features are in the cache, and where matches come with the pair."""
    dataset = data.load("fmbench", root=shared_path("data/Strecha_train"))
    pairs = [dataset[i] for i in range(4)]
    for _ in range(2):  # the second run finds its features in the cache
        reads.clear()
        pipeline = built(str(tmp_path))
        outcomes = pipeline.correspondences(pairs)
        assert set(reads.values()) == {1}
        assert all(outcome.images is None for outcome in outcomes)
    plain = load_pipeline("sift_fmtorch", overrides=[f"cache={tmp_path}", "features.max_features=1500"])
    before = plain.correspondences(pairs)
    gains = []
    for old, new in zip(before, outcomes, strict=True):
        F = torch.from_numpy(new.pair.F)[None]
        first, second = (
            sampson(F, c.x0.double(), c.x1.double()).abs()[0] for c in (old.correspondences, new.correspondences)
        )
        right = first < 1
        gains.append(float(second[right].median() / first[right].median()))
    assert np.median(gains) < 0.85
    c = before[0].correspondences
    given = dataclasses.replace(pairs[0], matches=lambda: GivenMatches(c, (1500, 1500)))
    reads.clear()
    fresh = Pipeline(pipeline.extractor, pipeline.matcher, {"refine": refiner()}, pipeline.estimator)
    refined = fresh.correspondences([given])[0].correspondences
    expected = outcomes[0].correspondences
    assert reads == {pairs[0].image0.path: 1, pairs[0].image1.path: 1}
    assert bool((refined.x1 == expected.x1).all())


def refiner() -> ImagePruner:
    stage: ImagePruner = presets.build("pruner", "refine_matches")
    return stage


def test_two_photographs_are_refined_in_their_reduced_pixels() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (60, 80)).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    image = np.ascontiguousarray(noise[:440, :600]), np.ascontiguousarray(noise[13:453, 21:621])
    result = match(*image, pipeline=built(), longest_side=500)
    assert "refine_matches" in result.counts
    c = result.correspondences
    motion = (c.x0 - c.x1)[0]
    assert float((motion - torch.tensor([21.0, 13.0])).norm(dim=-1).median()) < 0.1


def test_refined_matches_are_exported_as_matches_of_keypoints(tmp_path: Path) -> None:
    """They are at no keypoint any more; those of a run and of a folder are the same as without refinement."""
    dataset = data.load("fmbench", root=shared_path("data/Strecha_train"))
    pair = dataset[0]
    ends = pair.image0.path, pair.image1.path
    journals = []
    for i, overrides in enumerate(([PRUNERS], [])):
        pipeline = load_pipeline("sift_fmtorch", overrides=[*overrides, "cache=off", "features.max_features=500"])
        run, folder = (
            MatchStore(tmp_path / f"run{i}", ends[0].parent),
            MatchStore(tmp_path / f"folder{i}", ends[0].parent),
        )
        run.add(match_records(pipeline, pipeline.run([pair])))
        for _ in FolderMatches(pipeline, folder, 4000, True, 0).each([ends]):
            pass
        journals += [run, folder]
    matches = [journal.pair(*ends).matches for journal in journals]
    assert len(matches[0]) > 50
    assert all(np.array_equal(matches[0], other) for other in matches[1:])
