"""Seconds of patch networks on CPU, interleaved so that all see the same load.

python scripts/benchmark_networks.py networks=[models/hardnet.onnx,models/hardnet.int8.onnx] [patches=2048] [repeats=9]

Minimum and median of the wall time, and the minimum of the process's CPU time, for one thread.
"""

from __future__ import annotations

import statistics
import time

import torch
from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from fmtorch.core.terminal import console, exits_with_message
from fmtorch.features.onnx_network import PatchNetwork


def main() -> None:
    with exits_with_message():
        defaults = OmegaConf.create({"networks": "???", "patches": 2048, "repeats": 9, "batch": 256, "threads": 1})
        config = OmegaConf.merge(defaults, OmegaConf.from_cli())
        assert isinstance(config, DictConfig)
        networks = {str(p): PatchNetwork(str(p), threads=config.threads, batch=config.batch) for p in config.networks}
        patches = torch.rand(config.patches, 1, 32, 32, generator=torch.Generator().manual_seed(0))
        seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in networks}
        for _ in range(config.repeats + 1):
            for name, network in networks.items():
                wall, cpu = time.perf_counter(), time.process_time()
                network(patches)
                seconds[name].append((time.perf_counter() - wall, time.process_time() - cpu))
        table = Table(f"{config.patches} patches", "wall, minimum (ms)", "wall, median (ms)", "CPU, minimum (ms)")
        for name, rows in seconds.items():
            wall, cpu = zip(*rows[1:], strict=True)  # the first run opens the session
            table.add_row(name, *(f"{1000 * t:.0f}" for t in (min(wall), statistics.median(wall), min(cpu))))
        console.print(table)


if __name__ == "__main__":
    main()
