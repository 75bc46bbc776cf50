"""Learned pruners as files: safetensors for torch, ONNX for ONNX Runtime, both with the network that they belong to."""

from __future__ import annotations

import contextlib
import copy
import logging
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import save_file
from torch import Tensor, nn

from fmtorch.core.files import replacing
from fmtorch.pruning.networks.files import INPUT, OUTPUT, LearnedFile, OnnxBackbone, stated_network
from fmtorch.pruning.networks.layers import Slots
from fmtorch.pruning.networks.learned import Exportable
from fmtorch.training.onnx_origin import forget_origin

ATOL = 1e-4  # of torch against ONNX, in log-odds
OPSET = 18
EXAMPLE_MATCHES = 300


def save_weights(
    network: nn.Module, path: Path, *, temperature: float = 1.0, notes: Mapping[str, str] | None = None
) -> None:
    """Write a network's weights as safetensors, whole or not at all.

    Args:
        network: any module; one with an attribute `options` states them in the file.
        path: to write to; its folder is made.
        temperature: by which log-odds are divided at inference.
        notes: what else the file is to say.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    state = {key: value.detach().cpu().contiguous() for key, value in network.state_dict().items()}
    with replacing(path) as unfinished:
        save_file(state, unfinished, metadata=_metadata(network, temperature, notes))


def export_onnx(
    network: nn.Module, path: Path, *, temperature: float = 1.0, notes: Mapping[str, str] | None = None
) -> None:
    """Write a network's backbone as ONNX: float `matches` (1, channels, N), N free, to `outputs` (1, K, N).

    Needs the extra `export`. Arguments as of `save_weights`.
    Raises ValueError for a network that is not `Exportable`, ArithmeticError where ONNX Runtime disagrees with torch.
    """
    if not isinstance(network, Exportable):
        raise ValueError(f"{type(network).__name__} has no `backbone`, `input_channels`, `options` and `predict`: "
                         "it cannot be exported to ONNX, and runs with torch alone")  # fmt: skip
    outside = [key for key in network.state_dict() if not key.startswith("backbone.")]
    if outside:
        raise ValueError(f"{', '.join(outside)}: parameters outside the backbone would not be in the ONNX file")
    import onnx

    alone = _OnePair(copy.deepcopy(network.backbone)).eval().cpu().float()
    generator = torch.Generator().manual_seed(0)
    example = torch.rand(1, network.input_channels, EXAMPLE_MATCHES, generator=generator)
    with _quiet():
        program = torch.onnx.export(
            alone, (example,), dynamo=True, opset_version=OPSET, input_names=[INPUT], output_names=[OUTPUT],
            dynamic_shapes={"x": {2: torch.export.Dim("n", min=1)}}, verbose=False,
        )  # fmt: skip
    assert program is not None
    model = program.model_proto
    forget_origin(model)
    onnx.helper.set_model_props(model, _metadata(network, temperature, notes))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as unfinished:
        onnx.save(model, unfinished)
        _check(network, alone, unfinished, torch.rand(1, network.input_channels, 3 * EXAMPLE_MATCHES))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's messages on operators that are not installed and on its own deprecated calls."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        logger.setLevel(level)


class _OnePair(nn.Module):
    """A backbone as a function of one pair's input alone."""

    def __init__(self, backbone: nn.Module) -> None:
        super().__init__()
        self.backbone = backbone

    def forward(self, x: Float[Tensor, "1 channels n"]) -> Float[Tensor, "1 outputs n"]:
        matches = torch.ones_like(x[:, 0]).sum(1)
        return self.backbone(x, Slots(matches, None))  # type: ignore[no-any-return]


@torch.no_grad()
def _check(network: nn.Module, alone: nn.Module, path: Path, x: Tensor) -> None:
    exported = OnnxBackbone(network, path, "")(x, Slots(torch.tensor([float(x.shape[2])]), None))
    apart = float((exported - alone(x)).abs().max())
    if not apart <= ATOL:
        raise ArithmeticError(f"{path}: ONNX Runtime differs from torch by {apart:.1e}, more than {ATOL:.0e}")


def _metadata(network: nn.Module, temperature: float, notes: Mapping[str, str] | None) -> dict[str, str]:
    return LearnedFile(stated_network(network), float(temperature), dict(notes or {})).metadata()
