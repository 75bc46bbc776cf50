"""The command that trains patch networks: what a config of match sets makes of its photographs."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from fmtorch.core.files import conf_dir
from fmtorch.features.networks import build
from fmtorch.features.onnx_network import PatchNetwork
from fmtorch.training.match_set_training import MatchSetTraining
from fmtorch.training.patch_objectives import CovarianceObjective, DescriptorObjective
from fmtorch.training.patch_store import PatchStore
from fmtorch.training.photographs import package_photographs
from fmtorch.training.track_store import TrackStore
from scripts.train_patch_network import cut_tracks, objective_of, training_of

SMALL = (
    "training.tracks.points=80", "training.tracks.planes.views=3", "training.tracks.planes.tilt=10",
    "patches.longest_side=300", "patches.scenes=0", "patches.workers=1", "training.options.batch=16",
    "training.match_sets.matches=8", "training.match_sets.max_similarity=1.0",
)  # fmt: skip


def config(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(conf_dir()), version_base=None):
        return compose("train_patch_network", overrides=["training=geodesc", "images=.", *overrides])


def test_the_preset_has_the_values_of_the_paper() -> None:
    training = config().training
    assert training.match_sets == {"matches": 64, "max_similarity": 0.85}
    assert training.loss == {"name": "geodesc", "ratio": 0.4, "geometric_weight": 0.2}


@pytest.mark.parametrize(("name", "teacher"), [("hardnet_fast", "hardnet.int8.onnx"), ("affnet_fast", "affnet.onnx")])
def test_fast_networks_have_teachers(name: str, teacher: str) -> None:
    objective = objective_of(config(f"training={name}"), torch.device("cpu"))
    assert isinstance(objective, DescriptorObjective | CovarianceObjective)
    assert isinstance(objective.teacher, PatchNetwork)
    assert objective.teacher.path.name == teacher
    with_none = objective_of(config(f"training={name}", "~training.teacher"), torch.device("cpu"))
    assert with_none.teacher is None  # type: ignore[attr-defined]


def test_photographs_become_tracks_and_a_step_of_training(tmp_path: Path) -> None:
    small = config(*SMALL)
    cut_tracks(tmp_path / "tracks", package_photographs()[:2], small, 0)
    store = TrackStore.open(tmp_path / "tracks")
    assert store.description["views"] == 3
    network = build("geodesc")
    run = training_of(small, network, store, {"architecture": "geodesc"}, torch.device("cpu"))
    assert isinstance(run, MatchSetTraining)
    assert run.description["match_sets"] == {"matches": 8, "max_similarity": 1.0}
    run.run(until=1)
    assert len(run.losses) == 1
    with pytest.raises(ValueError, match=r"training\.match_sets needs training\.loss\.name=geodesc"):
        training_of(config(*SMALL, "training.loss.name=hardest_triplet"), network, store, {}, torch.device("cpu"))
    plain = PatchStore(store.patches, store.first, store.description)
    with pytest.raises(ValueError, match=r"training\.match_sets needs .* training\.tracks"):
        training_of(small, network, plain, {}, torch.device("cpu"))
