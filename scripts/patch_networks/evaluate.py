"""How well descriptors tell held-out patches apart, and the time that they take, in one table.

python -m scripts.patch_networks.evaluate patches=runs/patch_networks/patches/validation networks=[models/hardnet.onnx]

SIFT, RootSIFT-PCA, untrained networks, and `networks`: ONNX files, or checkpoints of scripts.patch_networks.train. SIFT
sees as much of the surroundings as in the pipelines, a quarter more than the networks. Figures: see
scripts.patch_networks.objectives.patch_quality; standard errors of about sqrt(p (1 - p) / pairs).

Without `patches` the times alone of `networks` on `pairs` random patches, one thread, interleaved so that all see the
same load: minimum and median of the wall time, and the minimum of the process's CPU time, of `repeats`.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf
from rich.table import Table
from torch import Tensor

from fmtorch.core.files import models_dir
from fmtorch.core.terminal import console, exits_with_message
from fmtorch.features.frames import PatchFunction
from fmtorch.features.networks import DESCRIPTORS, build, load_weights, read_checkpoint
from fmtorch.features.onnx_network import PatchNetwork
from fmtorch.features.sift import EXTENT, load_projection, project, root_sift, sift_of_patches
from scripts.patch_networks.export import FIGURES
from scripts.patch_networks.objectives import evaluate_descriptor, patch_quality, sample
from scripts.patch_networks.stores import PatchStore, validation_pairs

DEFAULTS: dict[str, Any] = {
    "patches": None,
    "networks": [],
    "pairs": 5000,
    "seed": 0,
    "threads": 1,
    "batch": 256,
    "repeats": 9,
}


def sift(pairs: Float[Tensor, "2 n 1 h w"], *, root: bool) -> Float[Tensor, "2 n 128"]:
    """SIFT of patches with their surroundings, of the part of them that `PatchSIFT` sees."""
    whole = pairs.flatten(0, 1)
    described = sift_of_patches(sample(whole, EXTENT * torch.eye(2).expand(len(whole), 2, 2)))
    return (root_sift(described) if root else described).reshape(*pairs.shape[:2], -1)


def network_of(path: str, config: DictConfig) -> PatchFunction:
    """An ONNX file or a checkpoint as a function of patches."""
    if path.endswith(".onnx"):
        return PatchNetwork(path, threads=config.threads, batch=config.batch)
    network = build(str(read_checkpoint(path).get("architecture"))).eval()
    load_weights(network, path)
    return network


def figures(config: DictConfig) -> dict[str, dict[str, float]]:
    """The figures of each descriptor, by name."""
    pairs = validation_pairs(PatchStore.open(config.patches), config.pairs, config.seed)
    rooted = sift(pairs, root=True)
    projected = project(rooted.flatten(0, 1), *load_projection(models_dir() / "rootsift_pca.npz"), power=0.5)
    classic = {
        "SIFT": sift(pairs, root=False),
        "RootSIFT": rooted,
        "RootSIFT-PCA": projected.reshape(2, len(pairs[0]), -1),
    }
    networks: dict[str, PatchFunction] = {}
    for name in DESCRIPTORS:
        torch.manual_seed(config.seed)
        networks[f"{name}, untrained"] = build(name).eval()
    networks |= {Path(path).name: network_of(str(path), config) for path in config.networks}
    found = {name: patch_quality(a, b) for name, (a, b) in classic.items()}
    for name, network in networks.items():
        found[name] = evaluate_descriptor(network, pairs)
    return found


@torch.no_grad()
def times(config: DictConfig) -> dict[str, list[tuple[float, float]]]:
    """Wall and CPU seconds of each network, once for each repeat."""
    networks = {str(path): network_of(str(path), config) for path in config.networks}
    patches = torch.rand(config.pairs, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in networks}
    for _ in range(config.repeats + 1):
        for name, network in networks.items():
            wall, cpu = time.perf_counter(), time.process_time()
            network(patches)
            seconds[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    return {name: rows[1:] for name, rows in seconds.items()}  # the first run opens the session


def main() -> None:
    with exits_with_message():
        config = OmegaConf.merge(OmegaConf.create(DEFAULTS), OmegaConf.from_cli())
        assert isinstance(config, DictConfig)
        torch.set_num_threads(config.threads)
        if config.patches is None:
            table = Table(f"{config.pairs} patches", "wall, minimum (ms)", "wall, median (ms)", "CPU, minimum (ms)")
            for name, rows in times(config).items():
                wall, cpu = zip(*rows, strict=True)
                table.add_row(name, *(f"{1000 * t:.0f}" for t in (min(wall), statistics.median(wall), min(cpu))))
        else:
            keys = ("fpr95", "map", "accuracy")
            table = Table("descriptor", *(FIGURES[key] for key in keys))
            for name, row in figures(config).items():
                table.add_row(name, *(f"{100 * row[key]:.2f}" for key in keys))
        console.print(table)


if __name__ == "__main__":
    main()
