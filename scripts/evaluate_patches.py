"""How well descriptors tell held-out patches apart: SIFT, RootSIFT-PCA, untrained and trained networks in one table.

python scripts/evaluate_patches.py patches=runs/patch_networks/patches/validation networks=[models/hardnet.onnx]

Networks are ONNX files, or checkpoints of scripts/train_patch_network.py. SIFT sees as much of the surroundings as in
the pipelines, a quarter more than the networks. Figures: see fmtorch.training.patch_metrics.patch_quality; standard
errors of about sqrt(p (1 - p) / pairs).
"""

from __future__ import annotations

import functools
from pathlib import Path

import torch
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf
from rich.table import Table
from torch import Tensor

from fmtorch.core.files import models_dir
from fmtorch.core.terminal import console, exits_with_message
from fmtorch.features.networks import DESCRIPTORS, build, load_weights, read_checkpoint
from fmtorch.features.onnx_network import PatchNetwork
from fmtorch.features.sift import EXTENT, load_projection, project, root_sift, sift_of_patches
from fmtorch.training.patch_metrics import Describe, evaluate_descriptor, patch_quality, validation_pairs
from fmtorch.training.patch_objectives import sample
from fmtorch.training.patch_store import PatchStore

DEFAULTS = {"patches": "???", "networks": [], "pairs": 5000, "seed": 0, "threads": 1}


def sift(pairs: Float[Tensor, "2 n 1 h w"], *, root: bool) -> Float[Tensor, "2 n 128"]:
    """SIFT of patches with their surroundings, of the part of them that `PatchSIFT` sees."""
    whole = pairs.flatten(0, 1)
    seen = sample(whole, EXTENT * torch.eye(2).expand(len(whole), 2, 2))
    described = sift_of_patches(seen)
    return (root_sift(described) if root else described).unflatten(0, pairs.shape[:2])


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
    rooted = sift(pairs, root=True)
    projected = project(rooted.flatten(0, 1), *load_projection(models_dir() / "rootsift_pca.npz"), power=0.5)
    classic = {"SIFT": sift(pairs, root=False), "RootSIFT": rooted, "RootSIFT-PCA": projected.unflatten(0, (2, -1))}
    describers: dict[str, Describe] = {}
    for name in DESCRIPTORS:
        torch.manual_seed(config.seed)
        describers[f"{name}, untrained"] = build(name).eval()
    describers |= {Path(path).name: descriptor_of(Path(path)) for path in config.networks}
    return {name: patch_quality(a, b) for name, (a, b) in classic.items()} | {
        name: evaluate_descriptor(functools.partial(described, f), pairs) for name, f in describers.items()
    }


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
