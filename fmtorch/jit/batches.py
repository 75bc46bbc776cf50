"""The door from batched tensors to kernels, which see the arrays of one pair."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fmtorch.jobs.execution import available, mapped

PAIRS_OF_A_THREAD = 8  # at least; a thread takes as long to begin as a kernel for a pair


def for_each_pair(
    function: Callable[..., None],
    tensors: Sequence[Tensor | None],
    *constants: Any,
    out: Tensor,
    kind: torch.dtype = torch.float32,
    group: Callable[..., Any] | None = None,
) -> Tensor:
    """`out` (B, ...) after function(row of each tensor, constants, row of out) for each of B pairs.
    Rows are C-contiguous arrays, floating ones of type `kind`; of what is not known (None) an empty one. group: the
    NamedTuple in which the function takes the rows. Pairs are shared out among threads. What is on another device is
    copied to the CPU, and `out`, which is there, comes back on the device of the first tensor; it is on no graph."""
    results = out.numpy()
    arrays = [_array(t, kind, len(results)) for t in tensors]

    def run_pairs(pairs: range) -> None:
        for pair in pairs:
            rows = [array[pair] for array in arrays]
            function(*(rows if group is None else [group(*rows)]), *constants, results[pair])

    parts = max(1, min(available(), len(results) // PAIRS_OF_A_THREAD))
    mapped(run_pairs, [range(first, len(results), parts) for first in range(parts)])
    return out.to(next(t.device for t in tensors if t is not None))


def _array(tensor: Tensor | None, kind: torch.dtype, pairs: int) -> np.ndarray:
    if tensor is None:
        return np.empty((pairs, 0), torch.empty(0, dtype=kind).numpy().dtype)
    if tensor.is_floating_point() and tensor.dtype != kind:
        tensor = tensor.to(kind)
    return as_array(tensor.cpu().contiguous())


def as_array(tensor: Tensor) -> np.ndarray:
    """A tensor on the CPU as an array, a view, on no graph."""
    return (tensor.detach() if tensor.requires_grad else tensor).numpy()
