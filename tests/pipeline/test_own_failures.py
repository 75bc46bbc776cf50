"""Parts of a user's own that fail, or return what a stage must not: by their names, files and lines."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from fmtorch.core import Correspondences, Estimate, Features
from fmtorch.core.failures import own_traceback, place_of
from fmtorch.presets import build, instantiate
from tests.helpers import draw, pair, small_pipeline
from tests.processes import run_command

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
    lafs = torch.eye(2, 3).repeat(n, 1, 1) + torch.arange(n)[:, None, None]
    return Features(lafs, torch.ones(n), torch.eye(n), torch.tensor([40, 60]))


def matches(a: Features, b: Features) -> Correspondences:
    return Correspondences(a.keypoints[None], b.keypoints[None], torch.ones(1, len(a), dtype=torch.bool))


def estimate(c: Correspondences, seed: int = 0, slots: int | None = None) -> Estimate:
    b, none = len(c), torch.zeros(len(c), dtype=torch.int64)
    return Estimate(torch.eye(3).repeat(b, 1, 1), c.mask[:, :slots], none == 0, ("",) * b, none)


def outcomes(tmp_path: Path, count: int = 2, **parts: object) -> tuple[Any, list[Any]]:
    given: dict[str, object] = {"features": lambda image: features(), "matcher": matches, "pruners": {}}
    pipeline = small_pipeline(**{**given, "estimator": estimate, **parts})
    images = [draw(tmp_path / f"{i}.png", i) for i in range(2 * count)]
    return pipeline, pipeline.run([pair(f"{i}", images[2 * i], images[2 * i + 1]) for i in range(count)])


def no_keys(c: Correspondences) -> Correspondences:
    return Correspondences(c.x0, c.x1, c.mask)


@pytest.mark.parametrize(
    ("stage", "part", "said"),
    [
        ("features", lambda image: None, r"^features: TypeError: .*<lambda> returned None; it must return Features$"),
        ("matcher", lambda a, b: (a, b), "^matching: TypeError: .* returned a tuple; it must return Correspondences"),
        ("matcher", lambda a, b: Correspondences(a.keypoints[None].half(), b.keypoints[None].half(),
         torch.ones(1, 9, dtype=torch.bool)), "Correspondences of torch.float16; they must be of float32 or float64"),
        ("matcher", lambda a, b: matches(a, b).to("meta"), "Correspondences on meta; they must be on cpu"),
        ("pruners", {"own": lambda c: c.mask}, "^pruning: TypeError: .* returned a Tensor; it must return Correspond"),
        ("pruners", {"own": no_keys}, r"no_keys returned matches without their pairs' keys; use c\.keep\(mask\)"),
        ("pruners", {"own": lambda c: c[:0]}, "Correspondences of 0 pairs; they must be of 1"),
        ("estimator", lambda c, seed: c.x0, "^estimation: TypeError: .* returned a Tensor; it must return Estimate"),
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


def test_errors_of_the_projects_own_have_no_place() -> None:
    with pytest.raises(ValueError, match="no preset") as refusal:
        build("estimator", "ransca")
    assert place_of(refusal.value) == own_traceback(refusal.value) == ""


def test_eval_shows_the_line_and_says_how_to_go_on(tmp_path: Path) -> None:
    (tmp_path / "failing_part.py").write_text(PART)
    (tmp_path / "conf" / "estimator").mkdir(parents=True)
    (tmp_path / "conf" / "estimator" / "mine.yaml").write_text("_target_: failing_part.Part\nbroken: false\n")
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
