"""Learned files from checkpoints that the authors' code of OANet, CLNet, NCMNet and ConvMatch wrote; none is executed.

python scripts/convert_checkpoint.py oanet model_best.pth runs/oanet.safetensors [--side ratio mutual]
    Then: python -m fmtorch.eval pipeline=sift_ratio 'pruner=[ratio,one_to_one,oanet]'
    pruner.oanet.file=runs/oanet.safetensors pruner.oanet.network.coordinates=K, and `side` as given here
"""

import argparse
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fmtorch.core.terminal import console, exits_with_message
from fmtorch.pruning.networks import CLNet, ConvMatch, NCMNet, OANet
from fmtorch.training.export import save_weights

Names = dict[str, str]  # of layers: ours, and those of the authors' code
SCALAR = np.float64(0).__reduce__()[0]
NUMBERS: list[Any] = [  # the best figure beside the weights may be one of NumPy's
    np.dtype, type(np.dtype(np.float64)), type(np.dtype(np.float32)), SCALAR, (SCALAR, "numpy.core.multiarray.scalar"),
]  # fmt: skip


def joined(*parts: str) -> str:
    return ".".join(filter(None, parts))


def under(ours: str, theirs: str, names: Names) -> Names:
    return {joined(ours, a): joined(theirs, b) for a, b in names.items()}


def numbered(ours: str, theirs: str, count: int, names: Names, first: int = 0) -> Names:
    """Those of `count` layers; the authors count from `first`."""
    return {k: v for i in range(count) for k, v in under(f"{ours}.{i}", f"{theirs}.{first + i}", names).items()}


def context(down: str, filters: str, up: str, count: int) -> Names:
    each = {"norm0": "conv1.1", "linear0": "conv1.3", "norm1": "conv2.0", "linear1": "conv2.2", "norm2": "conv3.2",
            "linear2": "conv3.4"}  # fmt: skip
    pools = {"norm0": f"{down}.conv.1", "linear0": f"{down}.conv.3", "norm1": f"{up}.conv.1", "linear1": f"{up}.conv.3"}
    return under("context", "", pools | numbered("filters", filters, count, each))


NORMED = {"linear": "0", "norm": "1"}
UNUSED = ".right.0."  # perceptrons that their blocks have always, and use where channels change
RECTIFIED = {"linear0": "left.0", "norm0": "left.2", "linear1": "left.4", "norm1": "left.6", "shortcut": "right.0"}
ANNULAR = {"edges": "conv.0", "norm0": "conv.1", "rings.linear": "conv.3", "rings.norm": "conv.4"}


def oanet() -> Names:
    block = {"norm0": "conv.1", "linear0": "conv.3", "norm1": "conv.5", "linear1": "conv.7", "shortcut": "shot_cut"}
    stage = (
        numbered("before", "l1_1", 3, block) | numbered("after", "l1_2", 3, block) | context("down1", "l2", "up1", 3)
    )
    stage |= {"first": "conv1", "last": "output"}
    return under("stages.0", "weights_init", stage) | under("stages.1", "weights_iter.0", stage)


def pruning(embedding: Names, graph: str) -> Names:
    step = under("embedding", "", embedding | under("first", "conv", NORMED)) | under("block", "embed_1.0", RECTIFIED)
    step |= under("graph.perceptron", f"{graph}.conv", NORMED) | {"local_logit": "linear_0", "global_logit": "linear_1"}
    names = under("steps.0", "ds_0", step) | under("steps.1", "ds_1", step) | {"last": "ds_1.linear_2"}
    return names | under("block", "ds_1.embed_2", RECTIFIED)


def clnet() -> Names:
    blocks = numbered("before", "embed_0", 4, RECTIFIED) | numbered("after", "embed_0", 4, RECTIFIED, 5)
    return pruning(blocks | under("annular", "embed_0.4", ANNULAR), "gcn")


def ncmnet() -> Names:
    parts = {"query": "attq", "key": "attk", "value": "attv", "result": "conv"}
    attended = {k: v for ours, theirs in parts.items() for k, v in under(ours, theirs, NORMED).items()} | {"": ""}
    names = numbered("blocks", "embed_00", 3, RECTIFIED)
    for i, n in enumerate("12"):
        each = {"logit": f"mlp{n}"} | under("graph.perceptron", f"gcn{n}.conv", NORMED)
        each |= numbered("blocks", f"embed_0{n}", 3, RECTIFIED) | context(f"down{n}", f"l{n}", f"up{n}", 2)
        for k, m in enumerate("123"):
            twice = m * int(n)  # sce1, sce2, sce3, then sce11, sce22, sce33
            each |= under(f"annular.{k}", f"sce{twice}", ANNULAR) | under(f"interaction.{k}", f"cci{twice}", attended)
        names |= under(f"rounds.{i}", "", each)
    return pruning(names, "gs")


def convmatch() -> Names:
    projection = {"hidden0.linear": "0", "hidden0.norm": "1", "hidden1.linear": "3", "hidden1.norm": "4", "last": "6"}
    attention = {name: f"{name}_filter" for name in ("query", "key", "value")} | {"merge": "mh_filter"}
    attention |= {"hidden.linear": "cat_filter.0", "hidden.norm": "cat_filter.1", "last": "cat_filter.3"}
    layer = under("align", "align", attention) | under("back", "dealign", attention)
    for i in range(6):
        block = f"filter.filter.resnet.{i // 2}.net"
        layer |= {
            f"filter.convolutions.{i}": f"{block}.{3 * (i % 2)}",
            f"filter.norms.{i}": f"{block}.{1 + 3 * (i % 2)}",
        }
    layer |= {"filter.last": "filter.filter.scale.0", "last": "inlier_pre.inlier_pre.12"}
    for i in range(3):
        layer |= {f"hidden.{i}": f"inlier_pre.inlier_pre.{4 * i}", f"norms.{i}": f"inlier_pre.inlier_pre.{4 * i + 2}"}
    names = numbered("layers", "layer_blocks", 6, layer) | under("motion", "init_project.init_project", projection)
    names |= under("position", "pos_embed.position_encoder", projection)
    return under("backbone", "", names | under("grid_position", "grid_pos_embed.position_encoder", projection))


NETWORKS = {"oanet": (OANet, oanet), "clnet": (CLNet, clnet), "ncmnet": (NCMNet, ncmnet),
            "convmatch": (ConvMatch, convmatch)}  # fmt: skip


def authors_state(network: nn.Module, names: Names, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state of a network from that of its authors' code.
    Raises ValueError, with the key, where a tensor is missing, of another size, or superfluous."""
    what = f"no checkpoint of {type(network).__name__}({network.extra_repr()})"
    given = {key.removeprefix("module."): value for key, value in weights.items()}
    given = {key: value for key, value in given.items() if not key.endswith("num_batches_tracked")}
    state = {}
    for key, value in network.state_dict().items():
        layer, _, kind = key.rpartition(".")
        theirs = joined(names[layer], kind)
        if theirs not in given:
            raise ValueError(f"{what}: {theirs} is missing")
        if given[theirs].numel() != value.numel():
            raise ValueError(f"{what}: {theirs} has {given[theirs].numel()} numbers, not {value.numel()}")
        state[key] = given.pop(theirs).reshape(value.shape)
    if superfluous := [key for key in given if UNUSED not in key]:
        raise ValueError(f"{what}: it has {superfluous[0]}, the network has not")
    return state


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", choices=NETWORKS)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path, help="a file .safetensors")
    parser.add_argument("--coordinates", default="K", choices=["K", "size"])
    parser.add_argument("--side", nargs="*", default=[])
    arguments = parser.parse_args()
    with exits_with_message():
        network_class, names = NETWORKS[arguments.network]
        network: nn.Module = network_class(coordinates=arguments.coordinates, side=arguments.side)
        try:
            with torch.serialization.safe_globals(NUMBERS):
                checkpoint = torch.load(arguments.checkpoint, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
            raise ValueError(f"{arguments.checkpoint} holds no tensors: {str(error).splitlines()[0]}") from None
        network.load_state_dict(authors_state(network, names(), checkpoint.get("state_dict", checkpoint)))
        save_weights(network, arguments.out, notes={"origin": f"{arguments.checkpoint.name} of the authors' code"})
        said = f"{arguments.out}: {network_class.__name__}({network.extra_repr()}); log-odds are not calibrated"
        console.print(said, markup=False)


if __name__ == "__main__":
    main()
