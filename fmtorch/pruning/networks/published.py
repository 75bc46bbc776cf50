"""Others' weights for these networks."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

_LAYERS = {"s0": "linear0", "s1": "norm0", "s2": "linear1", "s3": "norm1"}


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
