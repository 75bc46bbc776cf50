"""Preset files: where they are, how they are read, what they build."""

import functools
import re
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

import fmtorch
from fmtorch import presets
from fmtorch.commands import job
from fmtorch.core import Correspondences, conf_dir
from fmtorch.data import GivenMatches, ImagePair, ImageSource
from fmtorch.pipeline import Pipeline, build_pipeline, load_pipeline
from tests.helpers import compose
from tests.laws import scene

RATIO = "pruner.ratio.families"


@pytest.fixture
def own(tmp_path: Path) -> Path:
    (tmp_path / "estimator").mkdir()
    return tmp_path / "estimator" / "own.yaml"


def test_numbers_dates_and_references_are_read_as_commands_read_them(own: Path) -> None:
    own.write_text("_target_: a.B\na: 1e-3\nb: -2.5E+4\nc: 2024-01-31\nd: 1e\ne: ${a}\nf: {g: .5e1}\n")
    read = presets.load("estimator", "own", own.parents[1])
    values = {"a": 1e-3, "b": -25000.0, "c": "2024-01-31", "d": "1e", "e": 1e-3, "f": {"g": 5.0}}
    assert read == {"_target_": "a.B", **values}


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


def test_a_preset_that_describes_no_part_says_why(own: Path) -> None:
    for target, message in (
        ("fmtorch.estimators.Ransac2", "module fmtorch.estimators has no Ransac2; there are: Ransac, "),
        ("math", "_target_=math is a module; it must name a class or a function"),
        ("os.cpu_count", "estimator=own: os.cpu_count returned "),
        ("fmtorch.estimators.Ransac\nscore: ???", "estimator=own: score is missing"),
    ):
        own.write_text(f"_target_: {target}\n")
        with pytest.raises(ValueError, match=re.escape(message)):
            presets.build("estimator", "own", own.parents[1])


def test_a_users_own_preset_comes_before_the_projects(own: Path) -> None:
    for name in ("irls", "own"):
        own.with_name(f"{name}.yaml").write_text("_target_: fmtorch.estimators.opencv\nmethod: lmeds\n")
    folder = own.parents[1]
    assert presets.load("estimator", "irls", folder)["method"] == "lmeds"
    pipeline = load_pipeline("sift_ratio", overrides=["estimator=own"], config_dir=folder)
    assert pipeline.estimator.name == "OpenCV FM_LMEDS"


@pytest.mark.parametrize(("pipeline", "pruners"), [("sift_lc_fmtorch", ["ratio", "lpm"]), ("sift_gms", ["ratio"])])
def test_options_of_a_pruner_that_others_replace_go_with_it(pipeline: str, pruners: list[str]) -> None:
    config = compose("match", (f"pipeline={pipeline}", f"pruner=[{','.join(pruners)}]"))
    presets.expect_stages(config)
    assert [next(iter(entry)) for entry in presets.stages(config)["pruner"]] == pruners


def matches(seed: int) -> GivenMatches:
    """Forty matches whose ratios lie between 0 and 1."""
    generator = torch.Generator().manual_seed(seed)
    x0, x1, ratio = (torch.rand(1, 40, *size, generator=generator) for size in ((2,), (2,), ()))
    size = torch.tensor([[480, 640]])
    mask = torch.ones(1, 40, dtype=torch.bool)
    return GivenMatches(Correspondences(600 * x0, 600 * x1, mask, size0=size, size1=size, ratio=ratio), (40, 40))


def ratios(pipeline: Pipeline, pairs: list[ImagePair]) -> list[torch.Tensor]:
    """The ratios of the matches that are left of each pair."""
    left = [outcome.correspondences for outcome in pipeline.correspondences(pairs)]
    return [c.ratio[c.mask] for c in left]


def test_each_pair_of_a_batch_gets_the_options_of_its_family() -> None:
    options = ["pruner.ratio.threshold=0.5", f"+{RATIO}.wide.threshold=0.7", f"+{RATIO}.CPC.threshold=0.9"]
    pipeline = load_pipeline("paper/sift_ratio", overrides=options)
    image, families = ImageSource("image", Path("image.jpg")), ("KITTI", "orbit", "CPC", "mine", "Strecha")
    own = [(str(i), family, functools.partial(matches, i)) for i, family in enumerate(families)]
    pairs = [ImagePair(name, family, "scene", image, image, np.eye(3), matches=given) for name, family, given in own]
    limits = (0.5, 0.7, 0.9, 0.5, 0.7)
    for pair, kept, limit in zip(pairs, ratios(pipeline, pairs), limits, strict=True):
        given = matches(int(pair.identity)).correspondences.ratio
        assert torch.equal(kept, given[given < limit])
        assert torch.equal(kept, ratios(pipeline, [pair])[0])


def test_gms_tries_scales_on_wide_baselines_alone() -> None:
    for name in ("sift_gms", "paper/hesaffnet_gms"):
        pipeline = load_pipeline(name, overrides=["+pruner.gms.families.mine.with_scale=true"])
        options = {f: pipeline.pruners_of(f)["gms"]._options for f in ("TUM", "CPC", "mine", "other")}  # type: ignore[attr-defined]
        scale = {family: own["with_scale"] for family, own in options.items()}
        assert scale == {"TUM": False, "CPC": True, "mine": True, "other": False}
        assert {own["threshold_factor"] for own in options.values()} == {4.0}
        usual = load_pipeline(name, overrides=["pruner.gms.families=null"])
        assert not usual.pruners_of("CPC")["gms"]._options["with_scale"]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("overrides", "scale"),
    [
        ("pruner.gms.with_scale=false", (False, False, False)),
        ("pruner.gms={with_scale:false}", (False, False, False)),
        ("pruner.gms.with_scale=true", (True, True, True)),
        ("pruner.gms.threshold_factor=6.0", (False, True, True)),
        ("pruner.gms.with_scale=false +pruner.gms.families.CPC.with_scale=true", (False, False, True)),
        ("pruner.gms.with_scale=false +pruner.gms.families.CPC={with_scale:true}", (False, False, True)),
        ("pruner.gms.with_scale=false pruner.gms.families.wide.with_scale=true", (False, True, True)),
        ("pruner.gms.with_scale=false +pruner.gms.families.wide.threshold_factor=6.0", (False, False, False)),
        ("pruner.gms.with_scale=true pruner.gms.families=null", (True, True, True)),
    ],
)
def test_an_option_that_is_given_explicitly_holds_for_all_families(overrides, scale, monkeypatch):
    words = ("pipeline=sift_gms", *overrides.split(" "))
    expected = dict(zip(("KITTI", "Strecha", "CPC"), scale, strict=True))

    def scales(config: DictConfig) -> dict[str, bool]:
        pipeline = build_pipeline(config)
        return {family: pipeline.pruners_of(family)["gms"]._options["with_scale"] for family in expected}  # type: ignore[attr-defined]

    assert scales(compose("match", words)) == expected
    with hydra.initialize_config_dir(str(conf_dir()), version_base=None):  # as a command
        composed = hydra.compose("match", list(words), return_hydra_config=True)
    monkeypatch.setattr(HydraConfig, "get", lambda: composed.hydra)
    seen: list[dict[str, bool]] = []
    job(lambda config: seen.append(scales(config)))(composed)
    assert seen == [expected]


def test_they_are_part_of_the_stages_of_a_run_and_come_back_from_them() -> None:
    stages = presets.stages(compose("match", ("pipeline=paper/sift_gms",)))
    assert stages["pruner"][1]["gms"]["families"] == {"wide": {"with_scale": True}}
    assert presets.composed(stages)["pruner"]["gms"]["families"] == {"wide": {"with_scale": True}}


@pytest.mark.parametrize(
    ("override", "said"),
    [
        (f"+{RATIO}.wide.angle=1", r"pruner\.ratio\.families\.wide: no option angle"),
        (f"+{RATIO}.CPC.threshold=high", r"pruner\.ratio\.families\.CPC.*threshold=high"),
        (f"+{RATIO}=[CPC]", r"pruner\.ratio\.families=.*must be a mapping of families to options"),
        (f"+{RATIO}.CPC=0.9", r"pruner\.ratio\.families=.*must be a mapping of families to options"),
    ],
)
def test_what_is_wrong_with_them_is_said(override: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        presets.expect_stages(compose("match", ("pipeline=paper/sift_ratio", override)))
