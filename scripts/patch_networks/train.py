"""Trains HardNet, L2-Net, GeoDesc or AffNet on corresponding patches of photographs.

python -m scripts.patch_networks.train training=hardnet images=FOLDER photographs.held_out=[SUBFOLDER]
python -m scripts.patch_networks.train training=affnet images=FOLDER photographs=permissive training.options.minutes=20

The patches are cut once into <out>/patches, those of known geometry (training=geodesc) into <out>/tracks; delete that
folder after a change of photographs, of `patches` or of `training.tracks`. The checkpoint <out>/<name>.pt carries what
the model card says; resume=true goes on from it; scripts.patch_networks.export makes the ONNX network and the card.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from torch import nn

from fmtorch import presets
from fmtorch.core.files import conf_dir
from fmtorch.core.terminal import console, exits_with_message
from fmtorch.features.networks import build, load_weights
from fmtorch.features.onnx_network import PatchNetwork, network_file
from fmtorch.presets import plain
from fmtorch.training.planes import PlaneViews, list_photographs
from scripts.patch_networks import objectives, stores
from scripts.patch_networks.objectives import (
    LOSSES,
    CovarianceObjective,
    DescriptorObjective,
    Objective,
    ShapeObjective,
)
from scripts.patch_networks.patches import Tolerance, Warps, training_scenes
from scripts.patch_networks.stores import Cutting, PatchStore, build_store
from scripts.patch_networks.training import MatchSetTraining, PatchTraining, TrainingOptions


def opened_stores(config: DictConfig) -> list[PatchStore]:
    """Training and validation patches, cut now where they are not there yet."""
    opened, given = [], config.photographs
    for side, name in enumerate(("train", "validation")):
        tracks = side == 0 and "tracks" in config.training
        folder = Path(config.out) / ("tracks" if tracks else "patches") / name
        if not folder.exists():
            photographs = list_photographs(config.images, given.sources and list(given.sources), given.excluded)
            photographs += stores.package_photographs() if config.package_images else []
            chosen = stores.split(photographs, given.held_out)[side]
            console.print(f"cutting patches of {len(chosen)} photographs into {folder}")
            patches, cutting = config.patches, cutting_of(config, tracks)
            count, seed = 0 if side else patches.scenes, patches.seed + side
            scenes = training_scenes(count, cutting.views.views, seed)
            build_store(folder, chosen, cutting, seed=seed, scenes=scenes, workers=patches.workers)
        opened.append(PatchStore.open(folder))
    return opened


def cutting_of(config: DictConfig, tracks: bool) -> Cutting:
    """How a config cuts patches: of warped photographs, or of photographs as planes, with their geometry."""
    patches: dict[str, Any] = plain(config.patches)
    limits = plain(config.training.tracks)["planes"] if tracks else {**patches["limits"], "views": patches["views"]}
    limits = {name: tuple(value) if isinstance(value, list) else value for name, value in limits.items()}
    points = config.training.tracks.points if tracks else patches["points"]
    views = PlaneViews(**limits) if tracks else Warps(**limits)
    return Cutting(views, points, Tolerance(**patches["tolerance"]), patches["longest_side"])


def objective_of(config: DictConfig, device: torch.device) -> Objective:
    """The loss of a config: on descriptors, or on shapes as a trained descriptor sees them."""
    loss, taught = plain(config.training.loss), dict[str, Any]()
    if "teacher" in config.training:
        teacher = config.training.teacher
        taught = {"teacher": PatchNetwork(network_file(teacher.network, teacher.precision)), "weight": teacher.weight}
    name = loss.pop("name")
    if name == "hard_negative_constant":
        descriptor = build("hardnet").to(device).eval().requires_grad_(False)
        load_weights(descriptor, loss.pop("descriptor"))
        return ShapeObjective(descriptor, **loss)
    if name == "affine_covariance":
        return CovarianceObjective(**loss, **taught)
    if name not in LOSSES:
        names = ", ".join((*LOSSES, "hard_negative_constant", "affine_covariance"))
        raise ValueError(f"training.loss.name={name}; there are: {names}")
    return DescriptorObjective(functools.partial(LOSSES[name], **loss), **taught)


def training_of(
    config: DictConfig, network: nn.Module, store: PatchStore, description: dict[str, Any], device: torch.device
) -> PatchTraining:
    """The training of a config: on points of the whole store, or on match sets."""
    training = plain(config.training)
    options = TrainingOptions(**training["options"])
    if "match_sets" not in training:
        return PatchTraining(network, objective_of(config, device), store, options, description, device)
    loss = training["loss"]
    if loss.pop("name") != "geodesc":
        raise ValueError("training.match_sets needs training.loss.name=geodesc")
    description = {**description, "match_sets": training["match_sets"]}
    criterion = functools.partial(objectives.geodesc, **loss)
    return MatchSetTraining(network, criterion, store, options, description, device, **training["match_sets"])


def set_pixel_mean(network: nn.Module, store: PatchStore) -> None:
    """L2-Net's mean patch, from training patches spread evenly over the store."""
    if hasattr(network, "pixel_mean"):
        some = torch.from_numpy(store.patches[:: max(1, len(store.patches) // 20000)].copy())
        network.pixel_mean.copy_(objectives.middle(some).float().mean(0) / 255)  # type: ignore[operator]


@hydra.main(version_base=None, config_path=str(conf_dir()), config_name="train_patch_network")
def main(config: DictConfig) -> None:
    """The command."""
    with exits_with_message("interrupted; resume=true goes on from the last checkpoint"):
        torch.set_num_threads(config.threads)
        device = presets.resolve_device(config.device)
        train, validation = opened_stores(config)
        training = plain(config.training)
        torch.manual_seed(training["options"]["seed"])
        network = build(training["architecture"], **training["network"])
        set_pixel_mean(network, train)
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        description: dict[str, Any] = {
            k: training[k] for k in ("architecture", "network", "loss", "teacher") if k in training
        }
        description |= {"validation_data": validation.description, "licences": plain(config.photographs.sources)}
        checkpoint = Path(config.out) / f"{config.name}.pt"
        run = training_of(config, network, train, description, device)
        if config.resume:
            run.resume(checkpoint)
        elif checkpoint.exists():
            raise ValueError(f"{checkpoint} exists: resume=true goes on from it, another name= starts anew")
        pairs = stores.validation_pairs(validation, config.validation_pairs).to(device)
        untrained = build(training["architecture"]).to(device).eval()
        figures = {"untrained": run.objective.evaluate(untrained, pairs)}
        console.print(f"{len(train)} points; untrained: {figures['untrained']}")
        run.run(checkpoint=checkpoint, log=console.print)
        figures["trained"] = run.objective.evaluate(network.eval(), pairs)
        console.print(f"trained, {run.step} steps in {run.seconds / 60:.1f} minutes: {figures['trained']}")
        run.save(checkpoint, validation=figures)


if __name__ == "__main__":
    main()
