"""Patch networks as ONNX files, in float32 or quantised to int8, checked against torch."""

from __future__ import annotations

import copy
import tempfile
from pathlib import Path

import onnx
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from fmtorch.features.onnx_network import PatchNetwork
from fmtorch.training.onnx_layout import lay_out
from fmtorch.training.onnx_origin import forget_origin

ATOL = 1e-4  # of torch against ONNX
OPSET = 18


def fused(network: nn.Module) -> nn.Module:
    """A copy for inference: each batch norm inside the convolution before it, no dropout."""
    network = copy.deepcopy(network).eval()
    layers: list[nn.Module] = []
    for layer in network.features.children():  # type: ignore[union-attr]
        if isinstance(layer, nn.BatchNorm2d) and isinstance(layers[-1], nn.Conv2d):
            layers[-1] = fuse_conv_bn_eval(layers[-1], layer)
        elif not isinstance(layer, nn.Dropout):
            layers.append(layer)
    network.features = nn.Sequential(*layers)
    return network


def export(network: nn.Module, path: Path) -> None:
    """Write a network as ONNX, input (N, 1, 32, 32) with N free; ArithmeticError where ONNX Runtime disagrees."""
    small = fused(network)
    example = torch.rand(4, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".tmp")
    program = torch.onnx.export(
        small, (example,), dynamo=True, opset_version=OPSET, input_names=["patches"], output_names=["out"],
        dynamic_shapes={"patches": {0: torch.export.Dim("n", min=1)}}, verbose=False,
    )  # fmt: skip
    assert program is not None
    program.save(str(unfinished))
    _without_origin(unfinished)
    check(network, unfinished, example)
    unfinished.replace(path)


@torch.no_grad()
def check(network: nn.Module, path: Path, patches: Float[Tensor, "n 1 32 32"]) -> None:
    """ArithmeticError where the file's output is further than `ATOL` from the network's."""
    apart = float((PatchNetwork(path)(patches) - network.eval()(patches)).abs().max())
    if not apart <= ATOL:
        raise ArithmeticError(f"{path}: ONNX Runtime differs from torch by {apart:.1e}, more than {ATOL:.0e}")


def quantize(source: Path, path: Path, patches: Float[Tensor, "n 1 32 32"]) -> None:
    """An int8 network (QDQ, weights per channel, convolutions with their ReLU) calibrated on real patches.

    Its convolutions are laid out as ONNX Runtime runs them fastest (`lay_out`).
    """
    from onnxruntime.quantization import (
        CalibrationDataReader,
        CalibrationMethod,
        QuantFormat,
        QuantType,
        quantize_static,
    )
    from onnxruntime.quantization.shape_inference import quant_pre_process

    class Reader(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self.parts = iter(torch.split(patches, 256))

        def get_next(self) -> dict[str, object] | None:
            part = next(self.parts, None)
            return None if part is None else {"patches": part.numpy()}

    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        prepared, unfinished = Path(folder) / "prepared.onnx", path.with_name(path.name + ".tmp")
        quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        quantize_static(
            str(prepared), str(unfinished), Reader(), quant_format=QuantFormat.QDQ, per_channel=True,
            activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8, op_types_to_quantize=["Conv", "Relu"],
            calibrate_method=CalibrationMethod.MinMax,
        )  # fmt: skip
    _without_origin(unfinished)
    lay_out(unfinished)
    unfinished.replace(path)


def _without_origin(path: Path) -> None:
    """Write a file anew without the exporter's notes of source lines."""
    model = onnx.load(path)
    forget_origin(model)
    onnx.save(model, path)
