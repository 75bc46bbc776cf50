"""Networks in the layout that ONNX Runtime runs fastest: the same outputs."""

from pathlib import Path

import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor

from fmtorch.core import models_dir
from fmtorch.features import PatchNetwork
from fmtorch.features.networks import ARCHITECTURES, build
from scripts.patch_networks.onnx_export import export, laid_out, quantize
from tests.features.test_networks import randomized

NAMES = [name for name in ARCHITECTURES if name != "orinet"]
SHIPPED = [(name, f"{name}{precision}.onnx") for name in NAMES for precision in ("", ".int8")]


@pytest.fixture(scope="module")
def patches() -> Tensor:
    """Noise, ramps, a constant patch and one of extreme values."""
    generator = torch.Generator().manual_seed(3)
    noise = torch.rand(40, 1, 32, 32, generator=generator)
    ramp = torch.linspace(0, 1, 32).expand(1, 1, 32, 32)
    extreme = (torch.rand(20, 1, 32, 32, generator=generator) > 0.5).float()
    return torch.cat([noise, ramp, ramp.transpose(2, 3), torch.full((1, 1, 32, 32), 0.5), extreme])


@pytest.fixture(autouse=True)
def exact_int8(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums of int8 products in 32 bits on every processor.

    Without VNNI, ONNX Runtime otherwise adds them in pairs in 16 bits, where they saturate; which are pairs depends on
    the layout.
    """

    class Exact(onnxruntime.SessionOptions):  # type: ignore[misc, unused-ignore]
        def __init__(self) -> None:
            super().__init__()
            self.add_session_config_entry("session.x64quantprecision", "1")

    monkeypatch.setattr(onnxruntime, "SessionOptions", Exact)


def exported(name: str, folder: Path, patches: Tensor) -> tuple[Path, Path]:
    """A network of random weights in fp32 and int8, in the layouts that torch and the quantisation leave."""
    fp32, int8 = folder / "fp32.onnx", folder / "int8.onnx"
    export(randomized(build(name)), fp32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scripts.patch_networks.onnx_export.lay_out", lambda path: None)
        quantize(fp32, int8, patches)
    return fp32, int8


@pytest.mark.parametrize("name", ["l2net", "affnet"])  # one that ends in a normalisation, one in Tanh
def test_the_outputs_are_the_same(name: str, tmp_path: Path, patches: Tensor) -> None:
    for path, atol in zip(exported(name, tmp_path, patches), (1e-5, 0.0), strict=True):
        model = onnx.load(path)
        onnx.save(laid_out(model, 32), tmp_path / "laid_out.onnx")
        assert model == onnx.load(path)  # what was given is not changed
        for batch in (1, 64):
            expected = PatchNetwork(path, batch=batch)(patches)
            found = PatchNetwork(tmp_path / "laid_out.onnx", batch=batch)(patches)
            assert float(expected.nan_to_num().std()) > 0
            torch.testing.assert_close(found, expected, atol=atol, rtol=0, equal_nan=True)  # L2-Net of constant patches


@pytest.mark.parametrize(("name", "file"), SHIPPED)
def test_shipped_networks_are_laid_out(name: str, file: str) -> None:
    convolutions = sum(isinstance(layer, torch.nn.Conv2d) for layer in build(name).modules())
    operators = [node.op_type for node in onnx.load(models_dir() / file).graph.node]
    assert (operators.count("Gemm"), operators.count("Conv")) == (1, convolutions - 1)
