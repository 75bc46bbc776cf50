"""Trains HardNet, L2-Net, GeoDesc or AffNet on corresponding patches of photographs.

python scripts/train_patch_network.py training=hardnet images=FOLDER photographs.held_out=[SUBFOLDER]
python scripts/train_patch_network.py training=affnet images=FOLDER photographs=permissive training.options.minutes=20

The patches are cut once into <out>/patches, those of known geometry (training=geodesc) into <out>/tracks; delete that
folder after a change of photographs, of `patches` or of `training.tracks`. The checkpoint <out>/<name>.pt carries what
the model card says; resume=true goes on from it; scripts/export_onnx.py makes the ONNX network and the card.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from torch import nn

from fmtorch import presets
from fmtorch.core.files import conf_dir
from fmtorch.core.terminal import console, exits_with_message
from fmtorch.features.networks import PATCH_SIZE, build, load_weights
from fmtorch.features.onnx_network import PatchNetwork, network_file
from fmtorch.presets import plain
from fmtorch.training.correspondences import Tolerance
from fmtorch.training.geodesc_loss import geodesc
from fmtorch.training.match_set_training import MatchSetTraining
from fmtorch.training.patch_loop import PatchTraining, TrainingOptions
from fmtorch.training.patch_losses import LOSSES
from fmtorch.training.patch_metrics import middle, validation_pairs
from fmtorch.training.patch_objectives import CovarianceObjective, DescriptorObjective, Objective, ShapeObjective
from fmtorch.training.patch_store import PatchStore, build_store
from fmtorch.training.photographs import Photograph, list_photographs, package_photographs, split
from fmtorch.training.planes import PlaneViews
from fmtorch.training.scenes import training_scenes
from fmtorch.training.track_store import TrackStore, build_track_store
from fmtorch.training.warps import ViewRange


def stores(config: DictConfig) -> tuple[PatchStore, PatchStore]:
    """Training and validation patches, cut now where they are not there yet."""
    opened: list[PatchStore] = []
    for i, name in enumerate(("train", "validation")):
        tracks = name == "train" and "tracks" in config.training
        folder = Path(config.out) / ("tracks" if tracks else "patches") / name
        if not folder.exists():
            chosen_by = config.photographs
            sources = None if chosen_by.sources is None else list(chosen_by.sources)
            photographs = list_photographs(config.images, sources, chosen_by.excluded)
            photographs += package_photographs() if config.package_images else []
            chosen = split(photographs, chosen_by.held_out)[i]
            console.print(f"cutting patches of {len(chosen)} photographs into {folder}")
            cut = cut_tracks if tracks else cut_patches
            cut(folder, chosen, config, i)
        opened.append((TrackStore if tracks else PatchStore).open(folder))
    return opened[0], opened[1]


def cut_patches(folder: Path, photographs: Sequence[Photograph], config: DictConfig, side: int) -> None:
    """Cut patches of warped photographs, and for training (side 0) of rendered scenes."""
    options: dict[str, Any] = plain(config.patches)
    limits, tolerance = options.pop("limits"), Tolerance(**options.pop("tolerance"))
    limits = ViewRange(**{**limits, "scale": tuple(limits["scale"])})
    options["seed"] += side
    count = options.pop("scenes")
    options["scenes"] = training_scenes(count, options["views"], options["seed"]) if side == 0 else []
    build_store(folder, photographs, limits=limits, tolerance=tolerance, **options)


def cut_tracks(folder: Path, photographs: Sequence[Photograph], config: DictConfig, side: int) -> None:
    """Cut patches with their geometry, of photographs as planes and of rendered scenes."""
    patches, tracks = plain(config.patches), plain(config.training.tracks)
    ranges: dict[str, Any] = tracks.pop("planes")
    planes = PlaneViews(**{name: tuple(v) if isinstance(v, list) else v for name, v in ranges.items()})
    seed = patches["seed"] + side
    common = {"tolerance": Tolerance(**patches["tolerance"]), "workers": patches["workers"], "seed": seed}
    scenes = training_scenes(patches["scenes"], planes.views, seed)
    build_track_store(
        folder, photographs, planes=planes, scenes=scenes, longest_side=patches["longest_side"], **common, **tracks
    )


def objective_of(config: DictConfig, device: torch.device) -> Objective:
    """The loss of a config: on descriptors, or on shapes as a trained descriptor sees them."""
    loss = plain(config.training.loss)
    name = loss.pop("name")
    taught = teacher_of(config)
    if name == "hard_negative_constant":
        descriptor = build("hardnet").to(device).eval().requires_grad_(False)
        load_weights(descriptor, loss.pop("descriptor"))
        return ShapeObjective(descriptor, **loss)
    if name == "affine_covariance":
        return CovarianceObjective(**loss, **taught)
    if name not in LOSSES:
        raise ValueError(
            f"training.loss.name={name}; there are: {', '.join(LOSSES)}, hard_negative_constant, affine_covariance"
        )
    return DescriptorObjective(functools.partial(LOSSES[name], **loss), **taught)


def teacher_of(config: DictConfig) -> dict[str, Any]:
    """The options of an objective that has a teacher; none without one."""
    if "teacher" not in config.training:
        return {}
    teacher = config.training.teacher
    return {"teacher": PatchNetwork(network_file(teacher.network, teacher.precision)), "weight": teacher.weight}


def training_of(
    config: DictConfig, network: nn.Module, store: PatchStore, description: dict[str, Any], device: torch.device
) -> PatchTraining:
    """The training of a config: on points of the whole store, or on match sets."""
    training = plain(config.training)
    options = TrainingOptions(**training["options"])
    if "match_sets" not in training:
        return PatchTraining(network, objective_of(config, device), store, options, description, device)
    loss = training["loss"]
    if loss.pop("name") != "geodesc" or not isinstance(store, TrackStore):
        raise ValueError("training.match_sets needs training.loss.name=geodesc and training.tracks")
    description = {**description, "match_sets": training["match_sets"]}
    criterion = functools.partial(geodesc, **loss)
    return MatchSetTraining(network, criterion, store, options, description, device, **training["match_sets"])


def set_pixel_mean(network: nn.Module, store: PatchStore) -> None:
    """L2-Net's mean patch, from training patches spread evenly over the store."""
    if hasattr(network, "pixel_mean"):
        some = torch.from_numpy(store.patches[:: max(1, len(store.patches) // 20000)].copy())
        network.pixel_mean.copy_(middle(some, PATCH_SIZE).float().mean(0) / 255)


@hydra.main(version_base=None, config_path=str(conf_dir()), config_name="train_patch_network")
def main(config: DictConfig) -> None:
    """The command."""
    with exits_with_message("interrupted; resume=true goes on from the last checkpoint"):
        torch.set_num_threads(config.threads)
        device = presets.resolve_device(config.device)
        train, validation = stores(config)
        training = plain(config.training)
        torch.manual_seed(training["options"]["seed"])
        network = build(training["architecture"], **training["network"])
        set_pixel_mean(network, train)
        network = network.to(memory_format=torch.channels_last)
        description = {
            "architecture": training["architecture"], "network": training["network"], "loss": training["loss"],
            "validation_data": validation.description, "licences": plain(config.photographs.sources),
        }  # fmt: skip
        if "teacher" in training:
            description["teacher"] = training["teacher"]
        checkpoint = Path(config.out) / f"{config.name}.pt"
        run = training_of(config, network, train, description, device)
        if config.resume:
            run.resume(checkpoint)
        elif checkpoint.exists():
            raise ValueError(f"{checkpoint} exists: resume=true goes on from it, another name= starts anew")
        pairs = validation_pairs(validation, config.validation_pairs).to(device)
        untrained = build(training["architecture"]).to(device).eval()
        figures = {"untrained": run.objective.evaluate(untrained, pairs)}
        console.print(f"{len(train)} points; untrained: {figures['untrained']}")
        run.run(checkpoint=checkpoint, log=console.print)
        figures["trained"] = run.objective.evaluate(network.eval(), pairs)
        console.print(f"trained, {run.step} steps in {run.seconds / 60:.1f} minutes: {figures['trained']}")
        run.save(checkpoint, validation=figures)


if __name__ == "__main__":
    main()
