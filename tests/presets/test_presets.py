"""Preset files: where they are, how they are read, what they build."""

from pathlib import Path

import pytest

import fmtorch
from fmtorch import presets
from fmtorch.core import conf_dir
from fmtorch.pipeline import load_pipeline
from fmtorch.presets import compose
from tests.laws import scene


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A file of a user's own."""
    (tmp_path / "estimator").mkdir()
    return tmp_path / "estimator" / "own.yaml"


def test_numbers_dates_and_references_are_read_as_commands_read_them(own: Path) -> None:
    own.write_text("_target_: a.B\na: 1e-3\nb: -2.5E+4\nc: 2024-01-31\nd: 1e\ne: ${a}\nf: {g: .5e1}\n")
    read = presets.load("estimator", "own", own.parents[1])
    assert read == {
        "_target_": "a.B",
        "a": 1e-3,
        "b": -25000.0,
        "c": "2024-01-31",
        "d": "1e",
        "e": 1e-3,
        "f": {"g": 5.0},
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\na: 2\n", "line 2, column 1: found duplicate key a; a preset is a mapping in YAML"),
        ("a: [1\nb: 2\n", "line 2, column 2: "),
        ("a: ${nowhere}\n", "Interpolation key 'nowhere' not found"),
        ("- 1\n", "a preset is a mapping with a `_target_`, the dotted name of what it builds"),
    ],
)
def test_what_is_wrong_names_file_and_place(text: str, message: str, own: Path) -> None:
    own.write_text(text)
    with pytest.raises(ValueError, match="own") as refused:
        presets.load("estimator", "own", own.parents[1])
    assert str(refused.value).startswith(f"{own}: {message}")


@pytest.mark.parametrize("target", ["no_such_package.A", "fmtorch.estimators.Nothing", "math.pi.real.nothing"])
def test_a_target_that_cannot_be_imported_is_named(target: str, own: Path) -> None:
    own.write_text(f"_target_: {target}\n")
    c = scene(0, 30)
    with pytest.raises(ValueError, match=f"^estimator=own: _target_={target} cannot be imported: "):
        fmtorch.find_fundamental(c.x0, c.x1, estimator="own", config_dir=own.parents[1])


def test_a_users_own_preset_comes_before_the_projects(own: Path) -> None:
    for name in ("irls", "own"):
        own.with_name(f"{name}.yaml").write_text("_target_: fmtorch.estimators.opencv\nmethod: lmeds\n")
    folder = own.parents[1]
    assert presets.load("estimator", "irls", folder)["method"] == "lmeds"
    pipeline = load_pipeline("sift_ratio", overrides=["estimator=own"], config_dir=folder)
    assert pipeline.estimator.name == "OpenCV FM_LMEDS"


def test_preset_files_are_where_their_names_say() -> None:
    for group in presets.STAGES:
        for name in presets.available(group):
            assert (conf_dir() / group / f"{name}.yaml").is_file()


def test_options_of_one_pruner_do_not_hinder_another_in_its_place() -> None:
    config = compose("match", ("pipeline=sift_lc_fmtorch", "pruner=[ratio,lpm]"))
    presets.expect_stages(config)
    assert [next(iter(entry)) for entry in presets.stages(config)["pruner"]] == ["ratio", "lpm"]
