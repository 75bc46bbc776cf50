"""The paper's splits: no sequence in both, and the files of conf/dataset take the same options as the readers."""

import inspect

import pytest

from fmtorch import presets
from fmtorch.data import DataError
from fmtorch.data.scenes import SPLITS, chosen

THERE = ["06", "rgbd_dataset_freiburg1_xyz", "rgbd_dataset_freiburg3_teddy", "Horse", "Train"]


@pytest.mark.parametrize("name", SPLITS)
def test_no_sequence_is_in_both_splits(name: str) -> None:
    train, test = (set(chosen(name, split, None, THERE)) for split in ("train", "test"))
    assert train
    assert test
    assert not train & test
    assert chosen(name, "test", ["other"], THERE) == ["other"]


def test_the_splits_are_the_papers() -> None:
    assert SPLITS["kitti"] == {"test": ("06", "07", "08", "09", "10"), "train": ("00", "01", "02", "03", "04", "05")}
    short = [name.removeprefix("rgbd_dataset_freiburg3_") for name in SPLITS["tum"]["test"]]
    assert short == ["teddy", "large_cabinet", "long_office_household"]
    assert chosen("tum", "train", None, THERE) == ["06", "Horse", "Train", "rgbd_dataset_freiburg1_xyz"]


def test_what_no_split_holds_is_told() -> None:
    with pytest.raises(DataError, match="tum: no sequence in split 'train'"):
        chosen("tum", "train", None, [])
    with pytest.raises(DataError, match="kitti: no sequence in split 'test'"):
        chosen("kitti", "test", [], [])


@pytest.mark.parametrize("name", presets.available("dataset"))
def test_the_preset_has_every_option_with_the_readers_default(name: str) -> None:
    preset = presets.load("dataset", name)
    parameters = inspect.signature(presets.target_of(preset, "dataset")).parameters
    defaults = {key: p.default for key, p in parameters.items() if p.kind is not p.KEYWORD_ONLY}
    assert {key: value for key, value in preset.items() if key != "_target_"} == defaults
