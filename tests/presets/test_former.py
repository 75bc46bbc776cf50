"""Presets under their old names: every door says where they went, and what it says composes and is the same."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import fmtorch
from fmtorch import presets
from fmtorch.commands.list import HEADINGS, listed
from fmtorch.commands.report import named
from fmtorch.core.resources import conf_dir
from fmtorch.presets.composition import composed
from fmtorch.presets.former import FORMER, moved
from fmtorch.storage import RunFolder
from tests.helpers import compose
from tests.laws import scene
from tests.processes import run_command

OLD = [(group, name) for group, names in FORMER.items() for name in names]


@pytest.mark.parametrize(("group", "name"), OLD)
def test_what_stands_for_an_old_name_composes(group: str, name: str) -> None:
    now = FORMER[group][name]
    assert name not in presets.available(group)
    assert now.name in presets.available(group)
    chosen = f"pruner=[{now.name}]" if group == "pruner" else f"{group}={now.name}"
    config = compose("match", (chosen, *now.overrides))
    presets.expect_stages(config)
    for word in now.overrides:
        option, _, value = word.partition("=")
        if option in presets.STAGES:
            assert presets.plain(config[option]) == presets.load(option, value)


@pytest.mark.parametrize(("group", "name"), OLD)
def test_python_says_where_an_old_name_went(group: str, name: str) -> None:
    message = f"^{re.escape(moved(group, name) or '')}$"
    with pytest.raises(ValueError, match=message):
        presets.load(group, name)
    if group == "pipeline":
        with pytest.raises(ValueError, match=message):
            presets.pipeline(name)


def test_every_door_says_it_in_one_line(tmp_path: Path) -> None:
    c = scene(0, 30)
    with pytest.raises(ValueError, match=r"^opencv_usac_magsac is now opencv with method=usac_magsac$"):
        fmtorch.find_fundamental(c.x0, c.x1, estimator="opencv_usac_magsac")
    with pytest.raises(ValueError, match=r"^sift_msac is now sift_ratio with estimator=msac$"):
        fmtorch.match("a.jpg", "b.jpg", pipeline="sift_msac")
    with pytest.raises(ValueError, match=r"^irls_huber is now irls with kernel=huber$"):
        fmtorch.verify(tmp_path / "database.db", estimator="irls_huber")
    with pytest.raises(ValueError, match=r"^gms_soft is now gms with soft=true$"):
        presets.build("pruner", "gms_soft")


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("eval", ["pipeline=sift_gms_paper"], "sift_gms_paper is now paper/sift_gms"),
        ("eval", ["pruner=[ratio,gms_soft]"], "gms_soft is now gms with pruner.gms.soft=true"),
        (
            "match",
            ["a.jpg", "b.jpg", "estimator=fmtorch_max"],
            "fmtorch_max is now fmtorch, as accurate in half the time",
        ),
        ("verify", ["a.db", "estimator=opencv_lmeds"], "opencv_lmeds is now opencv with estimator.method=lmeds"),
        ("train", ["pruner=lc_soft"], "lc_soft is now lc with pruner.lc.soft=true"),
    ],
)
def test_commands_say_it_in_one_line(command: str, words: list[str], message: str, tmp_path: Path) -> None:
    done = run_command(command, *words, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr == f"error: {message}\n"


def test_a_users_own_preset_of_an_old_name_is_taken(tmp_path: Path) -> None:
    (tmp_path / "estimator").mkdir()
    (tmp_path / "estimator" / "irls_huber.yaml").write_text("_target_: fmtorch.estimators.opencv\nmethod: lmeds\n")
    assert presets.load("estimator", "irls_huber", tmp_path)["method"] == "lmeds"
    pipeline = presets.pipeline("sift_ratio", overrides=["estimator=irls_huber"], config_dir=tmp_path)
    assert pipeline.estimator.name == "OpenCV FM_LMEDS"


def test_the_list_has_the_papers_presets_last_under_a_heading() -> None:
    for group in ("pipeline", "estimator"):
        lines = listed(group)
        heading = lines.index(f"  {HEADINGS['paper']}:")
        assert [line.split()[0] for line in [*lines[:heading], *lines[heading + 1 :]]] == presets.available(group)
        assert all(line.startswith("  paper/") for line in lines[heading + 1 :])
        assert not any("paper/" in line.split()[0] for line in lines[:heading])
    assert not any(HEADINGS["paper"] in line for line in listed("pruner"))


def test_preset_files_are_where_their_names_say() -> None:
    for group in presets.STAGES:
        for name in presets.available(group):
            assert (conf_dir() / group / f"{name}.yaml").is_file()


def test_options_of_one_pruner_do_not_hinder_another_in_its_place() -> None:
    config = compose("match", ("pipeline=sift_lc_fmtorch", "pruner=[ratio,lpm]"))
    presets.expect_stages(config)
    assert [next(iter(entry)) for entry in presets.stages(config)["pruner"]] == ["ratio", "lpm"]


def test_runs_of_old_names_are_read(tmp_path: Path) -> None:
    """A stored configuration is rebuilt from its own values, of which the name is none."""
    soft = {"_target_": "fmtorch.pruning.GMS", "prune": False, "threshold_factor": 4.0,
            "calibration": presets.load("pruner", "gms")["calibration"]}  # fmt: skip
    huber = {**presets.load("estimator", "irls"), "kernel": "huber", "threshold": 0.3}
    now = presets.stages(compose("match", ("pipeline=paper/sift_gms",)))
    stored = {**now, "pipeline": "sift_gms_paper", "pruner": [{"gms_soft": soft}], "estimator": huber}
    config = composed(stored)
    assert config["pruner"]["gms_soft"]["soft"] is True
    presets.expect_buildable(config["pruner"]["gms_soft"], "pruner.gms_soft")
    assert presets.closest("estimator", huber) == ("irls", {"kernel": "huber", "threshold": 0.3})
    assert presets.pipeline_stages("sift_gms_paper") == now
    folder = RunFolder.open(tmp_path / "run", {**stored, "seed": 0, "dataset": {}})
    assert json.loads((tmp_path / "run" / "run.json").read_text())["config"]["pipeline"] == "sift_gms_paper"
    assert RunFolder.load(folder.path).identity == folder.identity
    with pytest.raises(ValueError, match="no run holds results yet"):
        named([RunFolder.load(folder.path)])


def test_old_names_stand_nowhere_else() -> None:
    """Neither in code nor in pages; the changelog tells what was."""
    root = Path(__file__).resolve().parents[2]
    words = re.compile(r"(?<![\w/])(" + "|".join(sorted({name for _, name in OLD}, key=len, reverse=True)) + r")(?!\w)")
    folders = [root / name for name in ("conf", "docs", "fmtorch", "models", "scripts", "tests")]
    files = [path for folder in folders for path in folder.rglob("*") if path.suffix in (
        ".py", ".yaml", ".md", ".txt", ".csv", ".json", ".ipynb", ".svg")]  # fmt: skip
    own = {Path(__file__), root / "fmtorch" / "presets" / "former.py"}
    mentions = {
        str(path.relative_to(root)): sorted(set(words.findall(path.read_text(encoding="utf-8"))))
        for path in [*files, root / "README.md", root / "CONTRIBUTING.md"]
        if path not in own and words.search(path.read_text(encoding="utf-8"))
    }
    assert mentions == {}
