"""The parts of docs/guides/own_parts.md, saved in an empty folder, are evaluated by its command, together and alone."""

import json
import re
import shlex
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from fmtorch import data
from fmtorch.core import Estimator, FeatureExtractor, Matcher, Pruner
from tests.laws import scene
from tests.processes import run_command

SOURCE = Path(__file__).resolve().parents[2]
PAGE = (SOURCE / "docs" / "guides" / "own_parts.md").read_text(encoding="utf-8")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The page's files, and the photographs and pairs that it leaves to the reader."""
    for name, content in re.findall(r"```(?:python|yaml)\n# (\S+)\n(.*?)```", PAGE, flags=re.DOTALL):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    pair = data.load("stereo")[0]
    for name, source in (("left.png", pair.image0), ("right.png", pair.image1)):
        shutil.copyfile(source.path, tmp_path / name)
    there = {"scene": "motorcycle", "image0": "left.png", "image1": "right.png", "F": pair.F.ravel().tolist()}
    back = {"scene": "motorcycle", "image0": "right.png", "image1": "left.png", "F": pair.F.T.ravel().tolist()}
    (tmp_path / "pairs.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (there, back)))
    return tmp_path


def test_every_part_is_evaluated(folder: Path) -> None:
    (command,) = re.findall(r"```bash\n(.*?)```", PAGE, flags=re.DOTALL)
    words = shlex.split(command)
    assert words[:2] == ["fmtorch", "eval"]
    ended = run_command("eval", *words[2:], "output=run", cwd=folder)
    assert ended.returncode == 0, ended.stderr
    rows = [row for part in (folder / "run" / "pairs").glob("*.parquet") for row in pq.read_table(part).to_pylist()]
    assert sorted(row["pair"] for row in rows) == ["left.png right.png", "right.png left.png"]
    assert all(row["ok"] and row["corrs"] >= 8 and row["nsgd"] < 0.05 for row in rows), [
        (row["reason"], row["corrs"], row["nsgd"]) for row in rows
    ]
    identity = (folder / "run" / "run.json").read_text()
    for target in ("my_features.ORB", "my_matcher.MutualMatcher", "my_pruner.UsualMotion", "my_estimator.Refitted"):
        assert target in identity


@pytest.mark.parametrize(
    ("group", "protocol"),
    [("features", FeatureExtractor), ("matcher", Matcher), ("pruner", Pruner), ("estimator", Estimator)],
)
def test_each_is_built_by_name_in_python(
    group: str, protocol: type, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fmtorch import presets

    monkeypatch.syspath_prepend(str(folder))
    assert isinstance(presets.build(group, "mine", config_dir=folder / "my_conf"), protocol)


@pytest.mark.parametrize("score", ["Welsch", "Triweight"])
def test_a_score_a_sampler_and_a_rule(score: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fmtorch import find_fundamental

    monkeypatch.syspath_prepend(str(folder))
    preset = folder / "my_conf" / "estimator" / "robust.yaml"
    preset.write_text(preset.read_text().replace("my_robust.Welsch", f"my_robust.{score}"))
    c = scene(1, 300, outliers=0.3)
    estimate = find_fundamental(c.x0, c.x1, ratio=c.ratio, estimator="robust", config_dir=folder / "my_conf")
    assert bool(estimate.ok[0])
    assert int(estimate.inliers.sum()) > 180  # of 210
