"""Pipelines: stages in a row, pruners that look at images, pictures, failures of own parts."""

from __future__ import annotations

import collections
import dataclasses
import json
import pickle
import re
import sys
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import pytest
import torch

import fmtorch
from fmtorch import data, match, presets
from fmtorch.core import Correspondences, Estimate, Features, own_traceback, place_of
from fmtorch.data import GivenMatches, ImagePair, ImageSource, read_image
from fmtorch.geometry import sampson
from fmtorch.io import MatchStore
from fmtorch.pipeline import FolderMatches, Memo, Pipeline, folder_workers, load_pipeline, match_records
from fmtorch.presets import instantiate
from tests.conftest import shared_path
from tests.helpers import draw, pair, write_file
from tests.helpers import small_pipeline as pipeline
from tests.laws import scene
from tests.processes import run_command


@pytest.fixture
def pairs(tmp_path: Path) -> list[ImagePair]:
    a, b = draw(tmp_path / "a.png", 0), draw(tmp_path / "b.png", 0, shift=12)
    c, d = draw(tmp_path / "c.png", 1), draw(tmp_path / "d.png", 1, shift=7)
    flat = tmp_path / "flat.png"
    cv2.imwrite(str(flat), np.full((240, 320), 128, np.uint8))
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"\xff\xd8\xff\xe0 not a picture")
    return [
        pair("good", a, b),
        pair("flat", a, ImageSource("flat", flat)),
        pair("good too", c, d),
        pair("broken", ImageSource("broken", broken), b),
        pair("absent", a, ImageSource("absent", tmp_path / "absent.png")),
        pair("known", a, b, problem="pairs.txt, line 3: F is NaN"),
    ]


def test_failures_are_outcomes_with_reasons(pairs: list[ImagePair]) -> None:
    outcomes = pipeline().run(pairs)
    by_name = {o.pair.identity: o for o in outcomes}
    assert [o.pair.identity for o in outcomes] == [p.identity for p in pairs]
    for name in ("good", "good too"):
        estimate = by_name[name].estimate
        assert bool(estimate.ok[0])
        assert by_name[name].reason == ""
        assert set(by_name[name].seconds) == {"features", "matching", "pruning", "estimation"}
    assert by_name["flat"].reason == "no keypoints in image 1"
    assert "broken.jpg" in by_name["broken"].reason
    assert "absent.png" in by_name["absent"].reason
    assert by_name["known"].reason == "pairs.txt, line 3: F is NaN"


def test_an_estimator_that_says_nothing_of_significance_is_judged(pairs: list[ImagePair]) -> None:
    own = presets.build("estimator", "lmeds", hypotheses=200)

    def silent(c: Correspondences, seed: int = 0) -> Estimate:
        return own(c, seed).replace(significance=None)

    outcomes = [pipeline(estimator=estimator).run(pairs[:3]) for estimator in (own, silent)]
    for first, second in zip(*outcomes, strict=True):
        if first.estimate is not None and second.estimate is not None:
            assert torch.equal(first.estimate.significance, second.estimate.significance)
    assert [o.estimate is not None and bool(o.estimate.related[0]) for o in outcomes[1]] == [True, False, True]


def test_batches_change_nothing(pairs: list[ImagePair]) -> None:
    together = pipeline().run(pairs, seed=3)
    for each, outcome in zip(pairs, together, strict=True):
        (alone,) = pipeline().run([each], seed=3)
        assert alone.reason == outcome.reason
        if alone.estimate is not None and outcome.estimate is not None:
            assert torch.equal(alone.estimate.F, outcome.estimate.F)
            assert int(alone.estimate.inliers.sum()) == int(outcome.estimate.inliers.sum())


@pytest.mark.parametrize("stage", ["pruning", "estimation"])
def test_a_stage_that_raises_fails_only_the_culprit(pairs: list[ImagePair], stage: str) -> None:
    named = {"pruning": ("pruner", "ratio"), "estimation": ("estimator", "lmeds")}[stage]
    inner = presets.build(*named, **({"hypotheses": 200} if stage == "estimation" else {}))

    def raising(c: Correspondences, seed: int = 0) -> Any:
        if pairs[0].key in c.keys.tolist():
            raise RuntimeError("no, not this one")
        return inner(c)

    parts = {"pruners": {"bad": raising}} if stage == "pruning" else {"estimator": raising}
    outcomes = pipeline(**parts).run([pairs[0], pairs[2]])
    assert outcomes[0].reason.startswith(f"{stage}: RuntimeError: no, not this one (test_pipeline.py:")
    assert outcomes[0].estimate is None
    assert outcomes[1].reason == ""
    assert outcomes[1].estimate is not None


def test_memo_computes_once_among_threads_and_forgets_the_oldest() -> None:
    memo: Memo[int, int] = Memo(2)
    calls: list[int] = []
    started, release = threading.Event(), threading.Event()

    def slow() -> int:
        calls.append(0)
        started.set()
        release.wait(5)
        return 7

    results: list[int] = []
    threads = [threading.Thread(target=lambda: results.append(memo.get(0, slow))) for _ in range(3)]
    threads[0].start()
    started.wait(5)
    for thread in threads[1:]:
        thread.start()
    release.set()
    for thread in threads:
        thread.join()
    assert (results, len(calls), memo.get(1, lambda: 1)) == ([7, 7, 7], 1, 1)
    assert memo.get(2, lambda: 2) == 2
    assert memo.get(0, lambda: 8) == 8  # 0 was forgotten


PRUNERS = "pruner=[ratio,one_to_one,frame_consistency,match_noise,refine_matches]"


def built(cache: str = "off") -> Pipeline:
    return load_pipeline("sift_fmtorch", overrides=[PRUNERS, f"cache={cache}", "features.max_features=1500"])


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> collections.Counter[Any]:
    counts: collections.Counter[Any] = collections.Counter()

    def counted(source: Any) -> Any:
        counts[source.path] += 1
        return read_image(source)

    monkeypatch.setattr("fmtorch.pipeline.pipeline.read_image", counted)
    return counts


def test_files_are_read_once_and_matches_are_refined(reads: collections.Counter[Any], tmp_path: Any) -> None:
    """Also where features are in the cache, and where matches come with the pair."""
    dataset = data.load("fmbench", root=shared_path("data/Strecha_train"))
    pairs = [dataset[i] for i in range(2)]
    for _ in range(2):  # the second run finds its features in the cache
        reads.clear()
        pipeline = built(str(tmp_path))
        outcomes = pipeline.correspondences(pairs)
        assert set(reads.values()) == {1}
        assert all(kept is None for outcome in outcomes for kept in (outcome.images, outcome.estimate))
    plain = load_pipeline("sift_fmtorch", overrides=[f"cache={tmp_path}", "features.max_features=1500"])
    before = plain.correspondences(pairs)
    gains = []
    for old, new in zip(before, outcomes, strict=True):
        F = torch.from_numpy(new.pair.F)[None]
        both = (old.correspondences, new.correspondences)
        first, second = (sampson(F, c.x0.double(), c.x1.double()).abs()[0] for c in both)
        right = first < 1
        gains.append(float(second[right].median() / first[right].median()))
    assert np.median(gains) < 0.85
    c = before[0].correspondences
    given = dataclasses.replace(pairs[0], matches=lambda: GivenMatches(c, (1500, 1500)))
    reads.clear()
    refine = {"refine": presets.build("pruner", "refine_matches")}
    fresh = Pipeline(pipeline.extractor, pipeline.matcher, refine, pipeline.estimator)
    refined = fresh.correspondences([given])[0].correspondences
    expected = outcomes[0].correspondences
    assert reads == {pairs[0].image0.path: 1, pairs[0].image1.path: 1}
    assert bool((refined.x1 == expected.x1).all())


def test_two_photographs_are_refined_in_their_reduced_pixels() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (60, 80)).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    image = np.ascontiguousarray(noise[:440, :600]), np.ascontiguousarray(noise[13:453, 21:621])
    result = match(*image, pipeline=built(), longest_side=500)
    assert "refine_matches" in result.counts
    c = result.correspondences
    motion = (c.x0 - c.x1)[0]
    assert float((motion - torch.tensor([21.0, 13.0])).norm(dim=-1).median()) < 0.1


def test_refined_matches_are_exported_as_matches_of_keypoints(tmp_path: Path) -> None:
    """They are at no keypoint any more; those of a run and of a folder are the same as without refinement."""
    pair = data.load("fmbench", root=shared_path("data/Strecha_train"))[0]
    ends = pair.image0.path, pair.image1.path
    journals = []
    for i, overrides in enumerate(([PRUNERS], [])):
        own = [*overrides, f"cache={tmp_path}", "features.max_features=500"]
        pipeline = load_pipeline("sift_fmtorch", overrides=own)
        run, folder = (MatchStore(tmp_path / f"{name}{i}", ends[0].parent) for name in ("run", "folder"))
        run.add(match_records(pipeline, pipeline.run([pair])))
        for _ in FolderMatches(pipeline, folder, folder_workers(pipeline), 4000, True, 0).each([ends]):
            pass
        journals += [run, folder]
    matches = [journal.pair(*ends).matches for journal in journals]
    assert len(matches[0]) > 50
    assert all(np.array_equal(matches[0], other) for other in matches[1:])


@pytest.fixture(scope="module")
def result() -> fmtorch.MatchResult:
    pair = data.load("stereo")[0]
    images = [PIL.Image.fromarray(data.read_image(image)) for image in (pair.image0, pair.image1)]
    return fmtorch.match(*images, pipeline="sift_fmtorch", longest_side=400)


def test_a_result_is_one_line_or_a_picture(result: fmtorch.MatchResult) -> None:
    assert repr(result).startswith(f"MatchResult({len(result.inliers)} matches, {int(result.inliers.sum())} inliers")
    assert len(repr(result)) < 120
    assert "data:image/jpeg;base64," in result._repr_html_()
    pictures = [result.draw(what) for what in ("matches", "pruning", "epipolar")]
    assert all(picture.dtype == np.uint8 and picture.shape[2] == 3 for picture in pictures)
    assert not np.array_equal(pictures[0], pictures[1])


def test_a_result_is_saved_as_the_command_saves_it(result: fmtorch.MatchResult, tmp_path: Path) -> None:
    names = result.save(tmp_path / "out", report={"note": "mine"})
    assert sorted(names) == sorted(path.name for path in (tmp_path / "out").iterdir())
    stored = json.loads((tmp_path / "out" / "result.json").read_text())
    assert np.array_equal(stored["F"], result.F)
    assert stored["note"] == "mine"
    picture = cv2.imread(str(tmp_path / "out" / "matches.png"))
    assert np.array_equal(picture[..., ::-1], result.draw())


def test_pillow_images_are_arrays(result: fmtorch.MatchResult) -> None:
    pair = data.load("stereo")[0]
    images = [data.read_image(image) for image in (pair.image0, pair.image1)]
    again = fmtorch.match(*images, pipeline="sift_fmtorch", longest_side=400)
    assert torch.equal(again.F, result.F)
    with pytest.raises(ValueError, match="image0 is a Pillow image of mode F; it must be of 8 bits"):
        fmtorch.match(PIL.Image.new("F", (9, 9)), PIL.Image.new("L", (9, 9)))


def test_matches_and_epipolar_lines_are_drawn_of_what_find_fundamental_takes_and_gives(tmp_path: Path) -> None:
    c = scene(0, 60)
    path = tmp_path / "a.png"
    PIL.Image.new("RGB", (960, 640)).save(path)
    estimate = fmtorch.find_fundamental(c.x0, c.x1)
    image = np.zeros((640, 960), np.uint8)
    drawn = fmtorch.draw_matches(path, image, c.x0, c.x1, estimate.inliers)
    of_opencv = [list(x[0].numpy()[:, None]) for x in (c.x0, c.x1)]  # as a loop over its points makes them
    assert np.array_equal(drawn, fmtorch.draw_matches(image, image, *of_opencv, estimate.inliers))
    assert np.array_equal(drawn, fmtorch.draw_matches(image, image, c.x0[0].numpy(), c.x1[0], estimate.inliers[0]))
    lines = fmtorch.draw_epipolar_lines(path, image, c.x0[0], c.x1[0], estimate.F)
    assert lines.any()
    with pytest.raises(ValueError, match=r"x0 has shape \(3, 60\); it must be \(N, 2\)"):
        fmtorch.draw_matches(image, image, np.zeros((3, 60)), c.x1[0])
    assert fmtorch.draw_matches(image, image, c.x0 * 1e9, c.x1).any()
    with pytest.raises(TypeError, match="height is 'x'; it must be a whole number"):
        fmtorch.draw_matches(image, image, c.x0, c.x1, height="x")


def test_estimates_are_one_line_and_a_table_of_pairs() -> None:
    c = scene(0, 60)
    estimate = fmtorch.find_fundamental([c.x0[0], c.x0[0, :5]], [c.x1[0], c.x1[0, :5]])
    assert repr(estimate[0]).startswith(f"Estimate(fundamental, {int(estimate.inliers.sum())} inliers, significance")
    assert repr(estimate[1]) == f"Estimate(no fundamental matrix: {estimate.reason[1]})"
    assert repr(estimate).startswith("Estimate(2 pairs: 1 ok, 1 related, 0 to ")
    assert estimate._repr_html_().count("<tr>") == 3
    assert len(repr(c)) < 500


def test_a_record_is_the_same_after_its_file(tmp_path: Path) -> None:
    c = scene(0, 60)
    K = torch.tensor([[800.0, 0, 480], [0, 800, 320], [0, 0, 1]])
    estimate = fmtorch.find_essential(c.x0, c.x1, K, K, covariance=True, pair_type=True)
    path = tmp_path / "estimate.safetensors"
    estimate.save(path)
    for kind in (fmtorch.Estimate, fmtorch.PoseEstimate):
        again = kind.load(path)
        assert again.reason == estimate.reason
        for name, value in vars(estimate).items():
            if torch.is_tensor(value):
                torch.testing.assert_close(getattr(again, name), value, rtol=0, atol=0, equal_nan=True)
    with pytest.raises(ValueError, match=r"holds PoseEstimate; Correspondences\.load reads Correspondences"):
        fmtorch.Correspondences.load(path)
    with pytest.raises(FileNotFoundError, match=r"nowhere.estimate\.safetensors"):
        estimate.save(tmp_path / "nowhere" / "estimate.safetensors")
    with pytest.raises(ValueError, match=r"e\.npz: save\(\) writes the format of safetensors; the name must end with"):
        estimate.save(tmp_path / "e.npz")


def test_a_file_with_code_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "estimate.pt"
    path.write_bytes(pickle.dumps(print))
    with pytest.raises(ValueError, match=r"estimate\.pt is no file that save\(\) wrote"):
        fmtorch.Estimate.load(path)


PART = """
class Part:
    def __init__(self, broken: bool = False) -> None:
        if broken:
            raise KeyError("weights")

    def __call__(self, *given, seed=0):
        return helper(*given)


def helper(*given):
    return {}["missing"]
"""


def features(n: int = 9) -> Features:
    lafs = torch.eye(2, 3).repeat(n, 1, 1) + 4 * torch.arange(n)[:, None, None]
    return Features(lafs, torch.ones(n), torch.eye(n), torch.tensor([40, 60]))


def matches(a: Features, b: Features) -> Correspondences:
    return Correspondences(a.keypoints[None], b.keypoints[None], torch.ones(1, len(a), dtype=torch.bool))


def estimate(c: Correspondences, seed: int = 0, slots: int | None = None) -> Estimate:
    b, none = len(c), torch.zeros(len(c), dtype=torch.int64)
    return Estimate(torch.eye(3).repeat(b, 1, 1), c.mask[:, :slots], none == 0, ("",) * b, none)


def outcomes(tmp_path: Path, count: int = 2, **parts: object) -> tuple[Any, list[Any]]:
    given: dict[str, object] = {"features": lambda image: features(), "matcher": matches, "pruners": {}}
    stages = pipeline(**{**given, "estimator": estimate, **parts})
    images = [draw(tmp_path / f"{i}.png", i) for i in range(2 * count)]
    return stages, stages.run([pair(f"{i}", images[2 * i], images[2 * i + 1]) for i in range(count)])


def swapped_sizes(a: Features, b: Features) -> Correspondences:
    sizes = torch.tensor([[600, 10]])
    return matches(a, b).replace(size0=sizes, size1=sizes)


@pytest.mark.parametrize(
    ("stage", "part", "said"),
    [
        ("features", lambda image: None, r"^features: WrongPart: .*<lambda> returned None; it must return Features$"),
        ("matcher", lambda a, b: (a, b), "^matching: WrongPart: .* returned a tuple; it must return Correspondences"),
        ("matcher", lambda a, b: Correspondences(a.keypoints[None].half(), b.keypoints[None].half(),
         torch.ones(1, 9, dtype=torch.bool)), "Correspondences of torch.float16; they must be of float32 or float64"),
        ("matcher", lambda a, b: matches(a, b).to("meta"), "Correspondences on meta; they must be on cpu"),
        ("matcher", lambda a, b: matches(a, b).replace(score=torch.full((1, 9), 80.0)),
         r"<lambda> returned matches that cannot be: score .*\[0, 1\]"),
        ("matcher", swapped_sizes, "swapped_sizes returned matches that cannot be: size0 is .* of x0 lie outside"),
        ("pruners", {"own": lambda c: c.mask}, "^pruning: WrongPart: .* returned a Tensor; it must return Corresp"),
        ("pruners", {"own": lambda c: Correspondences(c.x0, c.x1, c.mask)},
         r"<lambda> returned matches without their pairs' keys; use c\.keep\(mask\)"),
        ("pruners", {"own": lambda c: c[:0]}, "Correspondences of 0 pairs; they must be of 1"),
        ("pruners", {"own": lambda c: Correspondences(c.x0[:, :5], c.x1[:, :5], c.mask[:, :5], key=c.key)},
         r"returned matches of shape \(1, 5\); it must be that of the mask, \(1, 9\)"),
        ("pruners", {"own": lambda c: c.replace(x0=c.x0.sub_(1))}, "WrongPart: .*<lambda> changes what it is given"),
        ("features", lambda image: image.sort(0), "WrongPart: .*<lambda> changes what it is given, which others use"),
        ("estimator", 5, r"WrongPart: builtins.int cannot be called; it must have __call__\(c, seed=0\)"),
        ("estimator", lambda c, seed: estimate(c).replace(ok=torch.tensor([False])), "<lambda> gives no reason$"),
        ("estimator", lambda c, seed: c.x0, "^estimation: WrongPart: .* returned a Tensor; it must return Estimate"),
        ("features", lambda: None, r"WrongPart: .*<lambda> \(test_pipeline.py:\d+\) takes \(\); .* with \(image\)$"),
        ("matcher", lambda a: a, r"\(test_pipeline.py:\d+\) takes \(a\); it is called with \(features0, features1\)$"),
        ("estimator", lambda c: estimate(c), r"\(test_pipeline.py:\d+\) takes \(c\); it is called with \(c, seed=0\)$"),
        ("estimator", lambda c, seed: sys.exit(4), r"ended the program: sys.exit\(4\) \(test_pipeline.py:\d+, in "),
        ("estimator", lambda c, seed: estimate(c, slots=5), r"inliers of shape \(1, 5\); .* of the mask, \(1, 9\)"),
    ],
)  # fmt: skip
def test_what_a_stage_must_not_return_is_named(stage: str, part: object, said: str, tmp_path: Path) -> None:
    _, done = outcomes(tmp_path, **{stage: part})
    for outcome in done:
        assert not outcome.solved
        assert re.search(said, outcome.reason), outcome.reason


def test_a_part_that_fails_on_batches_alone_is_noticed(tmp_path: Path) -> None:
    pipeline, done = outcomes(tmp_path, estimator=lambda c, seed: estimate(c[0]))
    assert not any(outcome.reason for outcome in done)
    ((said, trace),) = pipeline.tracebacks.items()
    assert said.startswith("of a batch of 2 pairs, though of each alone it does not: estimation: ValueError: ")
    assert trace == ""  # it returned something wrong, and raised nothing


def test_tracebacks_are_those_of_the_users_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "failing_part.py").write_text(PART)
    monkeypatch.syspath_prepend(str(tmp_path))
    part = instantiate({"_target_": "failing_part.Part"}, "estimator")
    pipeline, done = outcomes(tmp_path, estimator=part)
    assert {outcome.reason for outcome in done} == {"estimation: KeyError: 'missing' (failing_part.py:12, in helper)"}
    (trace,) = pipeline.tracebacks.values()
    assert [line.strip() for line in trace.splitlines() if line.startswith("  File")] == [
        f'File "{tmp_path / "failing_part.py"}", line {line}, in {name}'
        for line, name in ((8, "__call__"), (12, "helper"))
    ]
    assert trace.endswith("KeyError: 'missing'")
    with pytest.raises(KeyError):
        outcomes(tmp_path, estimator=part, debug=True)
    with pytest.raises(ValueError, match="estimator: KeyError: 'weights'") as refusal:
        instantiate({"_target_": "failing_part.Part", "broken": True}, "estimator")
    assert place_of(refusal.value) == "failing_part.py:5, in __init__"
    with pytest.raises(ValueError, match="no preset") as refusal:  # errors of the project's own have no place
        presets.build("estimator", "ransca")
    assert place_of(refusal.value) == own_traceback(refusal.value) == ""


def test_eval_shows_the_line_and_says_how_to_go_on(tmp_path: Path) -> None:
    (tmp_path / "failing_part.py").write_text(PART)
    write_file(tmp_path / "conf" / "estimator" / "mine.yaml", "_target_: failing_part.Part\nbroken: false\n")
    words = ("--config-dir", "conf", "pipeline=sift_ratio", "estimator=mine", "dataset=stereo", "output=run")
    ended = run_command("eval", *words, cwd=tmp_path)
    assert ended.returncode == 1
    assert 'failing_part.py", line 12, in helper' in ended.stderr
    assert "fmtorch/pipeline" not in ended.stderr
    assert "an edit of your parts makes a new run" in ended.stderr
    for word in ("debug=true", "debug=pdb"):  # of which the pair's row of before counts for nothing
        ended = run_command("eval", *words, word, cwd=tmp_path)
        assert ended.returncode == 1
        assert "fmtorch/pipeline" in ended.stderr
        assert ("failing_part.py(12)helper()" in ended.stdout) == (word == "debug=pdb")
    ended = run_command("eval", *words, "estimator.broken=true", cwd=tmp_path)
    assert "error: estimator: KeyError: 'weights' (failing_part.py:5, in __init__)" in ended.stderr
    assert "fmtorch/" not in ended.stderr
