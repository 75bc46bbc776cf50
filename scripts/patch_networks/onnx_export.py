"""Patch networks as ONNX files, in float32 or quantised to int8, laid out for ONNX Runtime's CPU kernels.

The layout is another, the network the same. A convolution that sees its whole input at once becomes one matrix product
of all patches, which reads its weights once, not once a patch: a fifth of HardNet's time in fp32. In int8 a convolution
is a product of one row a pixel, each of which costs some time however short it is. Where there are few channels, one
row gives the outputs of several pixels beside one another: its kernel is as much wider, with zeros in the columns that
a pixel does not see. Outputs are the same to the last bit in int8 where the processor sums products of bytes exactly
(VNNI; older ones saturate), in fp32 up to the order of a sum.
"""

import copy
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from fmtorch.core.files import replacing
from fmtorch.features.local_feature import PATCH_SHAPE, PatchNetwork
from fmtorch.training.export import expect_equal, onnx_model, without_origin

OUTPUTS = 64  # of a row, channels times pixels, where there are fewer channels than `FEW_CHANNELS`
OUTPUTS_OF_GREY = 128  # where the input has one channel, and a pixel's row is 9 numbers
FEW_CHANNELS = 32


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
    example = torch.rand(4, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    model = onnx_model(fused(network), example, "patches", "out", free_axis=0)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as unfinished, torch.no_grad():
        onnx.save(model, unfinished)
        expect_equal(path, PatchNetwork(unfinished)(example), network.eval()(example))


def quantize(source: Path, path: Path, patches: Float[Tensor, "n 1 32 32"]) -> None:
    """An int8 network (QDQ, weights per channel, convolutions with their ReLU) calibrated on real patches.
    Its convolutions are laid out as ONNX Runtime runs them fastest (`lay_out`)."""
    from onnxruntime import quantization
    from onnxruntime.quantization.shape_inference import quant_pre_process

    class Reader(quantization.CalibrationDataReader):  # type: ignore[misc]
        parts = iter(torch.split(patches, 256))

        def get_next(self) -> dict[str, object] | None:
            part = next(self.parts, None)
            return None if part is None else {"patches": part.numpy()}

    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, replacing(path) as unfinished:
        prepared = Path(folder) / "prepared.onnx"
        quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        quantization.quantize_static(
            str(prepared), str(unfinished), Reader(), quant_format=quantization.QuantFormat.QDQ, per_channel=True,
            activation_type=quantization.QuantType.QUInt8, weight_type=quantization.QuantType.QInt8,
            op_types_to_quantize=["Conv", "Relu"], calibrate_method=quantization.CalibrationMethod.MinMax,
        )  # fmt: skip
        model = without_origin(onnx.load(unfinished))
        onnx.save(model, unfinished)
        lay_out(unfinished)


def lay_out(path: Path) -> None:
    onnx.save(laid_out(onnx.load(path), PATCH_SHAPE[-1]), path)


def laid_out(model: onnx.ModelProto, side: int) -> onnx.ModelProto:
    """The network in another layout: a chain of convolutions, in fp32 or as ``onnxruntime.quantization`` quantises it
    (QDQ), which is not changed. side: height and width of its input."""
    changed = onnx.ModelProto()
    changed.CopyFrom(model)
    graph = _Graph(changed.graph)
    for node in [node for node in changed.graph.node if node.op_type == "Conv"]:
        channels, inputs, _, width = graph.weights(node).shape
        ways, seen = _attributes(node), side
        around = ways["pads"].ints[1] + ways["pads"].ints[3]
        side = int(side + around - width) // int(ways["strides"].ints[1]) + 1
        if side == 1 and width == seen:
            graph.make_product(node)
        elif graph.quantised(node) and (pixels := _pixels(inputs, channels, side)) > 1:
            graph.widen(node, side, pixels)
    del changed.graph.value_info[:]  # shapes within, which were of the layout before
    onnx.checker.check_model(changed)
    return changed


def _pixels(inputs: int, channels: int, side: int) -> int:
    """How many pixels a row should have: a power of two that divides the side, as few as give the outputs wanted."""
    if inputs > 1 and channels >= FEW_CHANNELS:
        return 1
    wanted, pixels = OUTPUTS_OF_GREY if inputs == 1 else OUTPUTS, 1
    while pixels * channels < wanted and side % (2 * pixels) == 0:
        pixels *= 2
    return pixels


class _Graph:
    """The nodes of a chain of convolutions, by what they read and write."""

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.constants = {tensor.name: tensor for tensor in graph.initializer}
        self.writer = {name: node for node in graph.node for name in node.output}

    def quantised(self, convolution: Any) -> bool:
        return convolution.input[1] not in self.constants

    def weights(self, convolution: Any) -> NDArray[Any]:
        """The weights of a convolution as they are kept, (outputs, inputs, height, width)."""
        name = convolution.input[1]
        kept = self.writer[name].input[0] if self.quantised(convolution) else name
        return numpy_helper.to_array(self.constants[kept])

    def widen(self, convolution: Any, side: int, pixels: int) -> None:
        """Have each row of a convolution give several pixels beside one another. side: of the convolution's output."""
        ways, weights = _attributes(convolution), self.weights(convolution)
        step = int(ways["strides"].ints[1])
        channels, inputs, height, width = weights.shape
        wide = np.zeros((pixels, channels, inputs, height, (pixels - 1) * step + width), weights.dtype)
        for pixel, kernel in enumerate(wide):
            kernel[..., pixel * step : pixel * step + width] = weights
        quantised = self.writer[convolution.input[1]]
        self._put(quantised.input[0], wide.reshape(-1, *wide.shape[2:]))
        for name in (*quantised.input[1:], *self.writer[convolution.input[2]].input):
            self._put(name, np.tile(numpy_helper.to_array(self.constants[name]), pixels))
        ways["strides"].ints[1], ways["kernel_shape"].ints[1] = pixels * step, wide.shape[-1]
        reader = self._reader(self._reader(convolution.output[0]).output[0])
        self._insert(reader, "Transpose", perm=[0, 2, 3, 1])
        self._insert(reader, "Reshape", [0, side, side, channels])
        self._insert(reader, "Transpose", perm=[0, 3, 1, 2])  # (n, channels, side, side)

    def make_product(self, convolution: Any) -> None:
        """Write a convolution that sees its whole input at once as a matrix product of all patches."""
        weights, written = self.weights(convolution), convolution.output[0]
        flat = weights.reshape(len(weights), -1)
        if self.quantised(convolution):
            quantised, before = self.writer[convolution.input[1]], self.writer[convolution.input[0]]
            self._put(quantised.input[0], flat.T)  # (inputs, outputs): what ONNX Runtime has an int8 product for
            quantised.attribute[0].i = 1  # the axis of the outputs
            self._insert(before, "Reshape", [0, -1])  # (n, inputs) for (n, channels, height, width)
            written, ways = self._reader(written).output[0], []
        else:
            self._put(convolution.input[1], flat)
            self._insert(convolution, "Reshape", [0, -1])
            ways = [helper.make_attribute("transB", 1)]
        convolution.op_type = "Gemm"
        del convolution.attribute[:]
        convolution.attribute.extend(ways)
        self._insert(self._reader(written), "Reshape", [0, len(weights), 1, 1])

    def _reader(self, name: str) -> Any:
        (reader,) = [node for node in self.graph.node if name in node.input]
        return reader

    def _insert(self, reader: Any, operator: str, *constants: list[int], **attributes: Any) -> None:
        """Put an operator between a node and what it reads first; constants: what the operator reads beside that."""
        output = f"{reader.input[0]}_{operator}"
        inputs = [reader.input[0], *(f"{output}_{i}" for i in range(len(constants)))]
        for name, values in zip(inputs[1:], constants, strict=True):
            self.graph.initializer.append(numpy_helper.from_array(np.array(values, np.int64), name))
        inserted = helper.make_node(operator, inputs, [output], output, **attributes)
        self.graph.node.insert(list(self.graph.node).index(reader), inserted)
        reader.input[0] = output

    def _put(self, name: str, values: NDArray[Any]) -> None:
        self.constants[name].CopyFrom(numpy_helper.from_array(np.ascontiguousarray(values), name))


def _attributes(node: Any) -> dict[str, Any]:
    return {attribute.name: attribute for attribute in node.attribute}
