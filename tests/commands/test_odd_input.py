"""Commands given what they cannot use: one line that names it, before any work is done."""

import os
import shlex
from pathlib import Path

import cv2
import pytest

from fmtorch import presets
from fmtorch.core import models_dir
from fmtorch.pipeline import build_pipeline
from fmtorch.runs import RunFolder
from tests.commands.test_command_line import ended
from tests.commands.test_match import stereo
from tests.helpers import compose
from tests.processes import run_command

SIFT = ("pipeline=sift_ratio", "features.max_features=800", "estimator.hypotheses=100")


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """A folder with a.png and b.png."""
    for name, image in zip("ab", stereo(120, 160), strict=True):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image[..., ::-1])
    return tmp_path


def refused(monkeypatch: pytest.MonkeyPatch, folder: Path, *words: str) -> str:
    """What `match a.png b.png` ends with."""
    return ended(monkeypatch, folder, "match", "a.png", "b.png", *SIFT, *words)


def test_paths_with_brackets_are_printed_as_they_are(photographs: Path) -> None:
    """Brackets are the markup of the library that prints: `[/x]` would end a style, `[red]` begin one."""
    done = run_command("match", "a.png", "b.png", *SIFT, "output=m[/x] [red]", cwd=photographs)
    assert done.returncode == 0, done.stderr
    assert "m[/x] [red]: result.json" in done.stdout
    assert (photographs / "m[/x] [red]" / "result.json").is_file()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"_target_: x\n  foo: [1\n", "line 2, column 6: mapping values are not allowed here"),
        (b"\xb5\xff\x00 binary", "no text in UTF-8; a preset is a mapping in YAML"),
    ],
)
def test_a_broken_preset_is_named(monkeypatch, photographs, content, said):
    preset = photographs / "conf" / "estimator" / "mine.yaml"
    preset.parent.mkdir(parents=True)
    preset.write_bytes(content)
    end = refused(monkeypatch, photographs, "--config-dir", "conf", "estimator=mine")
    assert end.startswith(f"error: {preset}: {said}")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("pruner.ratio.threshold=nan", "pruner.ratio.threshold=nan; it must be a number of at least 0"),
        ("pruner.ratio.threshold=-1", "pruner.ratio.threshold=-1; it must be a number of at least 0"),
        ("features.max_features=-5", "features.max_features=-5; it must be a whole number of at least 1"),
        ("+foo=1", "no option foo; there are: "),
        ("truth=F.txt", "F.txt: holds 3 numbers"),
        ("truth=I.txt", "I.txt: a matrix of rank three (its determinant is not 0); F has rank two"),
        ("output=a.png", "a.png: File exists"),
        ("pruner=[ratio,lc] pruner.lc.file=bad.onnx", "bad.onnx is no ONNX network that can be run"),
        (
            "features=hardnet features.descriptor={name:hardnet,network:bad.onnx}",
            "bad.onnx is no ONNX network that can be run",
        ),
    ],
)
def test_before_any_work(monkeypatch: pytest.MonkeyPatch, photographs: Path, words: str, said: str) -> None:
    (photographs / "I.txt").write_text("1 0 0  0 1 0  0 0 1")
    (photographs / "F.txt").write_text("1 2 3")
    (photographs / "bad.onnx").write_bytes((models_dir() / "lc_f.onnx").read_bytes()[:5000])
    monkeypatch.setattr("fmtorch.commands.match.match", lambda *_, **__: pytest.fail("the work was begun"))
    end = refused(monkeypatch, photographs, *words.split())
    assert end.startswith("error: ")
    assert said in end
    assert "\n" not in end


def test_only_regular_files_are_read(monkeypatch: pytest.MonkeyPatch, photographs: Path) -> None:
    """A pipe would block for ever, a device fill the memory."""
    os.mkfifo(photographs / "pipe.jpg")
    (photographs / "zero.jpg").symlink_to("/dev/zero")
    for name in ("pipe.jpg", "zero.jpg"):
        end = ended(monkeypatch, photographs, "match", "a.png", name, *SIFT)
        assert end == f"error: {name}: no regular file; it must be an image file"


def test_the_report_is_refused_before_it_is_drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    run = tmp_path / "run"
    RunFolder.open(run, {})
    monkeypatch.setattr("fmtorch.commands.report.gallery", lambda *_: pytest.fail("the work was begun"))
    monkeypatch.setattr("fmtorch.commands.report.named", lambda _: [])
    end = ended(monkeypatch, tmp_path, "report", "runs=run", "output=run")
    assert end == "error: output=run is a folder; it must name a file"


def test_cached_features_take_no_seconds_and_changed_stages_are_named(photographs: Path) -> None:
    first, second = (run_command("match", "a.png", "b.png", *SIFT, cwd=photographs) for _ in range(2))
    rows = [next(line for line in done.stdout.splitlines() if "keypoints" in line) for done in (first, second)]
    assert "cached" not in rows[0]
    assert "cached" in rows[1]
    assert "estimator.hypotheses=100" in second.stdout.splitlines()[0]


@pytest.mark.parametrize("words", [("--config-dir", "my conf"), ("--config-dir=my conf",)])
def test_a_training_says_how_its_file_is_used(words: tuple[str, ...]) -> None:
    """As a prior, with the presets that the training had."""
    pytest.importorskip("lightning")
    from fmtorch.training.run import use_line

    said = use_line("mine", Path("runs/a b.onnx"), ["pruner=mine", *words])
    assert shlex.split(said) == [
        "python", "-m", "fmtorch.eval", "--config-dir", "my conf", "pipeline=sift_ratio", "estimator=fmtorch",
        "pruner=[ratio,one_to_one,mine]", "++pruner.mine.file=runs/a b.onnx", "++pruner.mine.soft=true",
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["lc", "lc_e", "lc_side", "dfe"])
def test_the_line_that_a_training_ends_with_builds_a_pipeline(name: str) -> None:
    pytest.importorskip("lightning")
    from fmtorch.training.run import use_line

    file = models_dir() / f"{presets.load('pruner', name)['file']}.safetensors"
    said = shlex.split(use_line(name, file, [f"pruner={name}"]))
    pruners = build_pipeline(compose("eval", [*said[3:], "cache=off"])).pruners
    assert list(pruners) == ["ratio", "one_to_one", name]
    assert (pruners[name].threshold, pruners[name].prior) == (None, True)
