"""Patch networks through ONNX Runtime: they agree with torch, neighbours are invisible, bad files are named."""

from pathlib import Path

import onnx
import pytest
import torch
from onnx import TensorProto, helper
from torch import Tensor

from fmtorch.core import NetworkFileError, models_dir
from fmtorch.features import PatchNetwork
from fmtorch.features.networks import ARCHITECTURES, build
from scripts.patch_networks.onnx_export import export, quantize
from tests.conftest import oracle
from tests.features.test_networks import randomized

NEIGHBOURS = 1e-5  # what design allows a descriptor to change with its batch


@pytest.fixture(scope="module")
def patches() -> Tensor:
    return torch.from_numpy(oracle("affnet_orinet.npz")["patches"])[:, None].float() / 255


@pytest.fixture(scope="module")
def hardnet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("onnx") / "hardnet.onnx"
    export(randomized(build("hardnet")), path)
    return path


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_onnx_agrees_with_torch_on_real_patches(name: str, tmp_path: Path, patches: Tensor) -> None:
    network = randomized(build(name))
    if name == "l2net":
        network.pixel_mean.copy_(patches.mean(0, keepdim=True))
    export(network, tmp_path / "network.onnx")
    found = PatchNetwork(tmp_path / "network.onnx", batch=40)(patches)
    assert found.shape == (64, network.outputs)
    torch.testing.assert_close(found, network(patches).detach(), atol=1e-4, rtol=0)
    assert [f.name for f in tmp_path.iterdir()] == ["network.onnx"]  # one file, weights inside


def test_neighbours_and_batch_size_are_invisible(hardnet: Path, patches: Tensor) -> None:
    expected = PatchNetwork(hardnet)(patches)
    for batch in (1, 7, 64, 300):
        found = PatchNetwork(hardnet, batch=batch)(patches)
        torch.testing.assert_close(found, expected, atol=NEIGHBOURS, rtol=0)
    one = PatchNetwork(hardnet)(patches[5:6])
    torch.testing.assert_close(one, expected[5:6], atol=0, rtol=0)  # the same portion size: the same bits
    garbage = patches.clone()
    garbage[6:] = torch.nan
    torch.testing.assert_close(PatchNetwork(hardnet)(garbage)[:6], expected[:6], atol=0, rtol=0)


def test_other_shapes_of_patches_are_refused(hardnet: Path) -> None:
    for shape in ((2, 1, 64, 64), (2, 3, 32, 32)):
        with pytest.raises(Exception, match=r"\(N, 1, 32, 32\)|jaxtyping|Type-check"):
            PatchNetwork(hardnet)(torch.zeros(shape))
    with pytest.raises(ValueError, match="batch=0"):
        PatchNetwork(hardnet, batch=0)


def test_an_absent_file_is_named_with_what_makes_it(tmp_path: Path) -> None:
    with pytest.raises(NetworkFileError, match=r"absent\.onnx does not exist: scripts\.patch_networks\.export"):
        PatchNetwork(tmp_path / "absent.onnx")(torch.zeros(1, 1, 32, 32))
    for use in (lambda n: n(torch.zeros(1, 1, 32, 32)), lambda n: n.identity):
        with pytest.raises(
            NetworkFileError, match=r"absent\.int8\.onnx does not exist: .*precision=int8.*calibration="
        ):
            use(PatchNetwork(tmp_path / "absent.int8.onnx"))


def test_a_corrupt_file_is_named(hardnet: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.onnx").write_bytes(hardnet.read_bytes()[:100_000])
    (tmp_path / "text.onnx").write_text("404: Not Found")
    (tmp_path / "empty.onnx").write_bytes(b"")
    (tmp_path / "bytes.onnx").write_bytes(hardnet.read_bytes().replace(b"Conv", b"\xe5onv"))  # the error is no text
    for name in ("cut", "text", "empty", "bytes"):
        with pytest.raises(NetworkFileError, match=rf"{name}\.onnx"):
            PatchNetwork(tmp_path / f"{name}.onnx")(torch.zeros(1, 1, 32, 32))


@pytest.mark.parametrize(("shape", "out"), [
    (["n", 1, 64, 64], ["n", 4096]), (["n", 3, 32, 32], ["n", 3072]),
    ([5, 1, 32, 32], [5, 1024]), (["n", 1024], ["n", 1024]),
])  # fmt: skip
def test_a_network_of_another_shape_is_named(shape: list[object], out: list[object], tmp_path: Path) -> None:
    inputs = helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)
    outputs = helper.make_tensor_value_info("y", TensorProto.FLOAT, out)
    graph = helper.make_graph([helper.make_node("Flatten", ["x"], ["y"])], "g", [inputs], [outputs])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10), tmp_path / "w.onnx")
    with pytest.raises(NetworkFileError, match=r"w\.onnx takes .*a patch network takes float \(N, 1, 32, 32\)"):
        PatchNetwork(tmp_path / "w.onnx")(torch.zeros(1, 1, 32, 32))


def test_int8_keeps_descriptors_close_and_the_file_small(hardnet: Path, tmp_path: Path, patches: Tensor) -> None:
    quantize(hardnet, tmp_path / "hardnet.int8.onnx", patches)
    expected, found = (PatchNetwork(p)(patches) for p in (hardnet, tmp_path / "hardnet.int8.onnx"))
    cosine = (expected * found).sum(1)
    assert float(cosine.min()) > 0.9
    assert (tmp_path / "hardnet.int8.onnx").stat().st_size < 0.3 * hardnet.stat().st_size
    nodes = {node.op_type for node in onnx.load(tmp_path / "hardnet.int8.onnx").graph.node}
    assert {"QuantizeLinear", "DequantizeLinear"} <= nodes


def test_files_tell_nothing_of_where_they_were_made(hardnet: Path) -> None:
    """Exporters note the source line of every node, with its path."""
    files = [*models_dir().glob("*.onnx"), hardnet]
    assert len(files) > 6
    for file in files:
        content = file.read_bytes()
        assert not [word for word in (b'.py", line ', b"/home/", b"/root/") if word in content], file
