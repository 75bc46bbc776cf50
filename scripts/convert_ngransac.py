"""Makes a learned file of `LC` from a checkpoint of neural-guided RANSAC (Brachmann & Rother, ICCV 2019; BSD 3-clause).

python scripts/convert_ngransac.py weights_ucn_r1.00.net runs/ngransac.safetensors
python -m fmtorch.eval pipeline=sift_lc 'pruner.lc.file=runs/ngransac.safetensors' 'pruner.lc.network.side=[ratio]'

The checkpoint is the authors' .net, or an .npz of the same parameters. Nothing in it is executed.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from fmtorch.core.terminal import console, exits_with_message
from fmtorch.pruning.networks import LC
from fmtorch.training.export import save_weights

_LAYERS = {"s0": "linear0", "s1": "norm0", "s2": "linear1", "s3": "norm1"}


def read(path: Path) -> dict[str, Tensor]:
    """The parameters by the authors' names."""
    if path.suffix == ".npz":
        with np.load(path) as file:
            return {key: torch.from_numpy(file[key]) for key in file.files}
    state = torch.load(path, map_location="cpu", weights_only=True)
    return {str(key): value for key, value in state.items()}


def ngransac_state(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state of `LC` from that of the network of Brachmann & Rother, "Neural-guided RANSAC", ICCV 2019.

    Their network is LC with 12 blocks, coordinates="size" and side=["ratio"]. Its layers are p_in, 0s0 to 11s3 and
    p_out; the biases of s0 and s2, which context normalisation takes away, are left out.
    Raises ValueError for a name that is none of these.
    """
    state = {}
    for key, value in weights.items():
        layer, _, kind = key.rpartition(".")
        block, position = layer[:-2], layer[-2:]
        if layer not in ("p_in", "p_out") and not (block.isdecimal() and position in _LAYERS):
            raise ValueError(f"{key} is no parameter of a network of neural-guided RANSAC")
        if kind == "num_batches_tracked" or (kind == "bias" and position in ("s0", "s2")):
            continue
        name = f"blocks.{block}.{_LAYERS[position]}" if position in _LAYERS else layer
        state[f"backbone.{name}.{kind}"] = value.flatten(1) if value.dim() == 4 else value
    return state


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path, help="a file .safetensors")
    arguments = parser.parse_args()
    with exits_with_message():
        network = LC(side=["ratio"])
        network.load_state_dict(ngransac_state(read(arguments.checkpoint)))
        save_weights(network, arguments.out, notes={"origin": "vislearn/ngransac, BSD 3-clause"})
        console.print(f"{arguments.out}: LC with side=[ratio]; log-odds are not calibrated", markup=False)


if __name__ == "__main__":
    main()
