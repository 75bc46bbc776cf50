"""How well descriptors tell held-out patches apart: SIFT, RootSIFT, untrained and trained networks in one table.

python scripts/evaluate_patches.py patches=runs/patch_networks/patches/validation networks=[models/hardnet.onnx]

Networks are ONNX files, or checkpoints of scripts/train_patch_network.py. Figures: see
fmtorch.training.patch_metrics.patch_quality; standard errors of about sqrt(p (1 - p) / pairs).
"""

from __future__ import annotations

import functools
from pathlib import Path

import kornia
import torch
from omegaconf import DictConfig, OmegaConf
from rich.table import Table
from torch import Tensor

from fmtorch.command import console, exits_with_message
from fmtorch.features.networks import build, load_weights
from fmtorch.features.networks.checkpoints import read_checkpoint
from fmtorch.features.onnx_network import PatchNetwork
from fmtorch.training.patch_metrics import Describe, evaluate_descriptor, validation_pairs
from fmtorch.training.patch_store import PatchStore

DEFAULTS = {"patches": "???", "networks": [], "pairs": 5000, "seed": 0, "threads": 1}


def sift(*, root: bool) -> Describe:
    """SIFT of a patch of its frame, of unit length (kornia's, 4 x 4 cells of 8 directions)."""
    return kornia.feature.SIFTDescriptor(32, rootsift=root).eval()  # type: ignore[no-any-return]


def descriptor_of(path: Path) -> Describe:
    """An ONNX file or a checkpoint as a function of patches."""
    if path.suffix == ".onnx":
        return PatchNetwork(path)
    network = build(str(read_checkpoint(path).get("architecture"))).eval()
    load_weights(network, path)
    return network


def described(describe: Describe, patches: Tensor) -> Tensor:
    return torch.nn.functional.normalize(describe(patches).float(), dim=1)


def evaluate(config: DictConfig) -> dict[str, dict[str, float]]:
    """The figures of each descriptor, by name."""
    pairs = validation_pairs(PatchStore.open(config.patches), config.pairs, config.seed)
    describers: dict[str, Describe] = {"SIFT": sift(root=False), "RootSIFT": sift(root=True)}
    for name in ("hardnet", "l2net"):
        torch.manual_seed(config.seed)
        describers[f"{name}, untrained"] = build(name).eval()
    describers |= {Path(path).name: descriptor_of(Path(path)) for path in config.networks}
    return {name: evaluate_descriptor(functools.partial(described, f), pairs) for name, f in describers.items()}


def main() -> None:
    with exits_with_message():
        config = OmegaConf.merge(OmegaConf.create(DEFAULTS), OmegaConf.from_cli())
        assert isinstance(config, DictConfig)
        torch.set_num_threads(config.threads)
        figures = evaluate(config)
        table = Table("descriptor", "FPR at 95 % recall (%)", "mAP (%)", "nearest is right (%)")
        for name, row in figures.items():
            table.add_row(name, *(f"{100 * row[key]:.2f}" for key in ("fpr95", "map", "accuracy")))
        console.print(table)


if __name__ == "__main__":
    main()
