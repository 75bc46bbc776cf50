"""Trains HardNet, L2-Net or AffNet on corresponding patches of photographs.

python scripts/train_patch_network.py training=hardnet images=FOLDER photographs.held_out=[SUBFOLDER]
python scripts/train_patch_network.py training=affnet images=FOLDER photographs=permissive training.options.minutes=20

The patches are cut once into <out>/patches; delete that folder after a change of photographs or of `patches`. The
checkpoint <out>/<name>.pt carries what the model card says; resume=true goes on from it; scripts/export_onnx.py makes
the ONNX network and the card.
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
from fmtorch.core.resources import conf_dir
from fmtorch.core.terminal import console, exits_with_message
from fmtorch.features.networks import build, load_weights
from fmtorch.features.networks.layers import PATCH_SIZE
from fmtorch.presets import plain
from fmtorch.training.correspondences import Tolerance
from fmtorch.training.patch_loop import PatchTraining, TrainingOptions
from fmtorch.training.patch_losses import LOSSES
from fmtorch.training.patch_metrics import middle, validation_pairs
from fmtorch.training.patch_objectives import CovarianceObjective, DescriptorObjective, Objective, ShapeObjective
from fmtorch.training.patch_store import PatchStore, build_store
from fmtorch.training.photographs import list_photographs, package_photographs, split
from fmtorch.training.scenes import training_scenes
from fmtorch.training.warps import ViewRange


def stores(config: DictConfig) -> tuple[PatchStore, PatchStore]:
    """Training and validation patches, cut now where they are not there yet."""
    found = []
    for i, name in enumerate(("train", "validation")):
        folder = Path(config.out) / "patches" / name
        if not folder.exists():
            chosen_by = config.photographs
            sources = None if chosen_by.sources is None else list(chosen_by.sources)
            photographs = list_photographs(config.images, sources, chosen_by.excluded)
            photographs += package_photographs() if config.package_images else []
            chosen = split(photographs, chosen_by.held_out)[i]
            console.print(f"cutting patches of {len(chosen)} photographs into {folder}")
            options: dict[str, Any] = plain(config.patches)
            limits, tolerance = options.pop("limits"), Tolerance(**options.pop("tolerance"))
            limits = ViewRange(**{**limits, "scale": tuple(limits["scale"])})
            options["seed"] += i
            count = options.pop("scenes")
            options["scenes"] = training_scenes(count, options["views"], options["seed"]) if name == "train" else []
            build_store(folder, chosen, limits=limits, tolerance=tolerance, **options)
        found.append(PatchStore.open(folder))
    return found[0], found[1]


def objective_of(config: DictConfig, device: torch.device) -> Objective:
    """The loss of a config: on descriptors, or on shapes as a trained descriptor sees them."""
    loss = plain(config.training.loss)
    name = loss.pop("name")
    if name == "hard_negative_constant":
        descriptor = build("hardnet").to(device).eval().requires_grad_(False)
        load_weights(descriptor, loss.pop("descriptor"))
        return ShapeObjective(descriptor, **loss)
    if name == "affine_covariance":
        return CovarianceObjective(**loss)
    if name not in LOSSES:
        raise ValueError(
            f"training.loss.name={name}; there are: {', '.join(LOSSES)}, hard_negative_constant, affine_covariance"
        )
    return DescriptorObjective(functools.partial(LOSSES[name], **loss))


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
        objective = objective_of(config, device)
        description = {
            "architecture": training["architecture"], "network": training["network"], "loss": training["loss"],
            "validation_data": validation.description, "licences": plain(config.photographs.sources),
        }  # fmt: skip
        checkpoint = Path(config.out) / f"{config.name}.pt"
        run = PatchTraining(network, objective, train, TrainingOptions(**training["options"]), description, device)
        if config.resume:
            run.resume(checkpoint)
        elif checkpoint.exists():
            raise ValueError(f"{checkpoint} exists: resume=true goes on from it, another name= starts anew")
        pairs = validation_pairs(validation, config.validation_pairs).to(device)
        untrained = build(training["architecture"]).to(device).eval()
        figures = {"untrained": objective.evaluate(untrained, pairs)}
        console.print(f"{len(train)} points; untrained: {figures['untrained']}")
        run.run(checkpoint=checkpoint, log=console.print)
        figures["trained"] = objective.evaluate(network.eval(), pairs)
        console.print(f"trained, {run.step} steps in {run.seconds / 60:.1f} minutes: {figures['trained']}")
        run.save(checkpoint, validation=figures)


if __name__ == "__main__":
    main()
