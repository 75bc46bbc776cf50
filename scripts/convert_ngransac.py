"""Makes a learned file of `LC` from a checkpoint of neural-guided RANSAC (Brachmann & Rother, ICCV 2019; BSD 3-clause).

python scripts/convert_ngransac.py weights_ucn_r1.00.net runs/ngransac.safetensors
python -m fmtorch.eval pipeline=sift_lc 'pruner.lc.file=runs/ngransac.safetensors' 'pruner.lc.network.side=[ratio]'

The checkpoint is the authors' .net, or an .npz of the same parameters. Nothing in it is executed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from fmtorch.core.terminal import console, exits_with_message
from fmtorch.pruning.networks import LC
from fmtorch.pruning.networks.published import ngransac_state
from fmtorch.training.pruner_export import save_weights


def read(path: Path) -> dict[str, Tensor]:
    """The parameters by the authors' names."""
    if path.suffix == ".npz":
        with np.load(path) as file:
            return {key: torch.from_numpy(file[key]) for key in file.files}
    state = torch.load(path, map_location="cpu", weights_only=True)
    return {str(key): value for key, value in state.items()}


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
