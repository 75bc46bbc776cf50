"""Makes an ONNX file, and its model card, from a checkpoint of a patch network.

python scripts/export_onnx.py checkpoint=runs/patch_networks/hardnet.pt                      -> models/hardnet.onnx, .md
python scripts/export_onnx.py checkpoint=HardNet++.pth architecture=hardnet name=hardnetpp
python scripts/export_onnx.py checkpoint=... precision=int8 calibration=runs/patch_networks/patches/train

checkpoint: of scripts/train_patch_network.py, kornia's and the authors' .pth, or TorchScript. Needs the extra `export`.
precision=int8 quantises weights per channel and activations by what `calibration` patches show.
validation=FOLDER of patches adds the ONNX file's own figures to the card.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from fmtorch.core.files import models_dir
from fmtorch.core.terminal import console, exits_with_message
from fmtorch.features.networks import DESCRIPTORS, build, load_weights, read_checkpoint
from fmtorch.features.onnx_network import PatchNetwork, network_file
from fmtorch.training.model_card import model_card
from fmtorch.training.onnx_export import export, quantize
from fmtorch.training.onnx_layout import lay_out
from fmtorch.training.patch_metrics import evaluate_descriptor, middle, validation_pairs
from fmtorch.training.patch_store import PatchStore

DEFAULTS = {
    "checkpoint": "???", "architecture": None, "name": None, "precision": "fp32", "folder": None,
    "calibration": None, "calibration_patches": 2048, "validation": None, "pairs": 5000, "seed": 0, "threads": 1,
    "licence": None,
}  # fmt: skip


def calibration_patches(folder: str, count: int, seed: int) -> Tensor:
    """Real patches of training points."""
    return middle(validation_pairs(PatchStore.open(folder), count, seed)[0])


def main() -> None:
    with exits_with_message():
        config = OmegaConf.merge(OmegaConf.create(DEFAULTS), OmegaConf.from_cli())
        assert isinstance(config, DictConfig)
        torch.set_num_threads(config.threads)
        content = read_checkpoint(config.checkpoint)
        architecture = config.architecture or content.get("architecture")
        if architecture is None:
            raise ValueError(f"{config.checkpoint} does not say what it is: give architecture=")
        name = config.name or architecture
        network = build(str(architecture)).eval()
        load_weights(network, config.checkpoint)
        folder = models_dir() if config.folder is None else Path(config.folder)
        path = folder / network_file(name, config.precision).name
        if config.precision == "fp32":
            export(network, path)
            lay_out(path)
        else:
            if config.calibration is None:
                raise ValueError("precision=int8 needs calibration=FOLDER of patches, e.g. <out>/patches/train")
            with tempfile.TemporaryDirectory() as temporary:
                export(network, Path(temporary) / "fp32.onnx")
                patches = calibration_patches(config.calibration, config.calibration_patches, config.seed)
                quantize(Path(temporary) / "fp32.onnx", path, patches)
        figures = None
        if config.validation is not None and architecture in DESCRIPTORS:
            pairs = validation_pairs(PatchStore.open(config.validation), config.pairs)
            figures = evaluate_descriptor(PatchNetwork(path), pairs)
        card = path.with_suffix(".md")
        card.write_text(model_card(path, str(architecture), config.precision, content, figures, config.licence))
        console.print(f"{path} ({path.stat().st_size} bytes), {card}")


if __name__ == "__main__":
    main()
