"""Learned files from checkpoints that the authors' code of OANet, CLNet, NCMNet, ConvMatch and NG-RANSAC wrote.

python scripts/convert_checkpoint.py oanet model_best.pth runs/oanet.safetensors [--side ratio mutual]
    Then: python -m fmtorch.eval pipeline=sift_ratio 'pruner=[ratio,one_to_one,oanet]'
    pruner.oanet.file=runs/oanet.safetensors pruner.oanet.network.coordinates=K, and `side` as given here
python scripts/convert_checkpoint.py ngransac weights_ucn_r1.00.net runs/ngransac.safetensors --side ratio
    Neural-guided RANSAC (Brachmann & Rother, ICCV 2019; BSD 3-clause).
    Then: fmtorch eval pipeline=sift_lc pruner.lc.file=runs/ngransac.safetensors 'pruner.lc.network.side=[ratio]'

Nothing in a checkpoint is executed.
"""

import argparse
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml  # type: ignore[import-untyped]
from torch import Tensor, nn

from fmtorch.core.terminal import console, exits_with_message
from fmtorch.pruning.networks import LC, CLNet, ConvMatch, NCMNet, OANet
from fmtorch.training.export import save_weights

SCALAR = np.float64(0).__reduce__()[0]
NUMBERS: list[Any] = [  # the best figure beside the weights may be one of NumPy's
    np.dtype, type(np.dtype(np.float64)), type(np.dtype(np.float32)), SCALAR, (SCALAR, "numpy.core.multiarray.scalar"),
]  # fmt: skip
NETWORKS: dict[str, tuple[Any, str]] = {  # with the coordinates that the authors' code takes
    "oanet": (OANet, "K"), "clnet": (CLNet, "K"), "ncmnet": (NCMNet, "K"), "convmatch": (ConvMatch, "K"),
    "ngransac": (LC, "size"),
}  # fmt: skip
NAMES = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
UNUSED = re.compile(r"\.right\.0\.|^\d+s[02]\.bias$|num_batches_tracked$")
"""Perceptrons that blocks have always, and use where channels change; biases that context normalisation takes away."""


def authors_key(name: str, key: str) -> str:
    """The authors' name of a parameter of a network."""
    layer, _, kind = key.rpartition(".")
    for pattern, theirs in NAMES[name].items():
        layer = re.sub(pattern, theirs, layer)
    return ".".join(filter(None, (layer, kind)))


def authors_state(name: str, network: nn.Module, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state of a network from that of its authors' code.
    Raises ValueError, with the key, where a tensor is missing, of another size, or superfluous."""
    what = f"no checkpoint of {type(network).__name__}({network.extra_repr()})"
    given = {key.removeprefix("module."): value for key, value in weights.items()}
    state = {}
    for key, value in network.state_dict().items():
        theirs = authors_key(name, key)
        if theirs not in given:
            raise ValueError(f"{what}: {theirs} is missing")
        if given[theirs].numel() != value.numel():
            raise ValueError(f"{what}: {theirs} has {given[theirs].numel()} numbers, not {value.numel()}")
        state[key] = given.pop(theirs).reshape(value.shape)
    if superfluous := [key for key in given if not UNUSED.search(key)]:
        raise ValueError(f"{what}: it has {superfluous[0]}, the network has not")
    return state


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", choices=NETWORKS)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path, help="a file .safetensors")
    parser.add_argument("--side", nargs="*", default=[])
    arguments = parser.parse_args()
    with exits_with_message():
        network_class, coordinates = NETWORKS[arguments.network]
        network: nn.Module = network_class(coordinates=coordinates, side=arguments.side)
        try:
            with torch.serialization.safe_globals(NUMBERS):
                checkpoint = torch.load(arguments.checkpoint, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
            raise ValueError(f"{arguments.checkpoint} holds no tensors: {str(error).splitlines()[0]}") from None
        network.load_state_dict(authors_state(arguments.network, network, checkpoint.get("state_dict", checkpoint)))
        save_weights(network, arguments.out, notes={"origin": f"{arguments.checkpoint.name} of the authors' code"})
        said = f"{arguments.out}: {network_class.__name__}({network.extra_repr()}); log-odds are not calibrated"
        console.print(said, markup=False)


if __name__ == "__main__":
    main()
