"""Networks of features: kornia's, shipped ones, ONNX."""

import os
from pathlib import Path

import kornia
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from torch import Tensor, nn

from fmtorch import presets
from fmtorch.core import NetworkFileError, models_dir
from fmtorch.features import ALIKED, DISK, PatchNetwork, XFeat
from fmtorch.features.networks import ARCHITECTURES, DESCRIPTORS, AffNet, HardNet, L2Net, build, load_weights
from scripts.patch_networks.onnx_export import export, quantize
from tests.conftest import oracle, shared_path
from tests.features.scenes import texture
from tests.helpers import same

RTOL = 1e-4  # of unit outputs: float32 sums of up to 8,192 terms in another order
NEIGHBOURS = 1e-5  # what design allows a descriptor to change with its batch
SIZE = (90, 131)  # no multiple of 16


@pytest.fixture(scope="module")
def patches() -> Tensor:
    return torch.from_numpy(oracle("affnet_orinet.npz")["patches"])[:, None].float() / 255


def randomized(network: nn.Module, seed: int = 0) -> nn.Module:
    """A network as after training: statistics that are neither 0 nor 1."""
    generator = torch.Generator().manual_seed(seed)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.2, generator=generator)
            module.running_var.uniform_(0.3, 2, generator=generator)
    return network.eval()


@pytest.mark.parametrize("file", ["AffNet.pth", "AffNetJIT.pt", "OriNet.pth", "OriNetJIT.pt"])
def test_affnet_and_orinet_with_the_authors_weights(patches: Tensor, file: str) -> None:
    name = file[:3].lower() + "net"
    network = build(name).eval()
    load_weights(network, shared_path(f"weights/{file}"))
    expected = oracle("affnet_orinet.npz")
    found = network(patches).detach().numpy()
    np.testing.assert_allclose(found, expected[f"{name}_features"], atol=RTOL)
    authors = found + np.array([1, 0, 1]) if name == "affnet" else found  # (a11, a21, a22)
    np.testing.assert_allclose(authors, expected[f"authors_{name}_jit"], atol=RTOL)


def test_hardnet_is_kornias(tmp_path: Path, patches: Tensor) -> None:
    other = randomized(kornia.feature.HardNet(pretrained=False))
    torch.save({"epoch": 3, "state_dict": other.state_dict()}, tmp_path / "hardnet.pth")
    network = HardNet().eval()
    assert load_weights(network, tmp_path / "hardnet.pth") == {"epoch": 3}
    torch.testing.assert_close(network(patches), other(patches), atol=RTOL, rtol=0)


class PortOfL2Net(nn.Module):
    """L2-Net as ports of the MATLAB release have it: convolutions with bias, batch norms with scale and shift."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        shapes = [(1, 32, 1), (32, 32, 1), (32, 64, 2), (64, 64, 1), (64, 128, 2), (128, 128, 1)]
        for i, o, stride in shapes:
            layers += [nn.Conv2d(i, o, 3, stride, 1), nn.BatchNorm2d(o, eps=1e-10), nn.ReLU()]
        self.features = nn.Sequential(*layers, nn.Conv2d(128, 128, 8), nn.BatchNorm2d(128, eps=1e-10))

    def forward(self, x: Tensor) -> Tensor:
        flat = x.flatten(1)
        flat = (flat - flat.mean(1, keepdim=True)) / (flat.std(1, keepdim=True) + 1e-12)
        return nn.LocalResponseNorm(256, 256.0, 0.5, 0.0)(self.features(flat.reshape(x.shape))).flatten(1)


def test_a_port_of_l2net_is_folded_into_ours(tmp_path: Path, patches: Tensor) -> None:
    # ports number their layers without dropout: 18 is the last convolution there and dropout here
    port = randomized(PortOfL2Net())
    generator = torch.Generator().manual_seed(1)
    for module in port.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 2, generator=generator)
            nn.init.normal_(module.bias, 0, 0.2, generator=generator)
    torch.save(port.state_dict(), tmp_path / "port.pth")
    network = L2Net().eval()
    load_weights(network, tmp_path / "port.pth")
    torch.testing.assert_close(network(patches), port(patches), atol=RTOL, rtol=0)


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_descriptors_have_unit_length_and_ignore_light(name: str, patches: Tensor) -> None:
    network = randomized(build(name))
    found = network(patches)
    torch.testing.assert_close(found.norm(dim=1), torch.ones(len(patches)))
    torch.testing.assert_close(network(0.3 * patches + 0.2), found, atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_constant_patches_are_finite_and_so_are_their_gradients(name: str) -> None:
    network = randomized(build(name))
    out = network(torch.full((2, 1, 32, 32), 0.5))
    out.sum().backward()
    assert torch.isfinite(out).all()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())


def test_files_that_do_not_fit_are_named(tmp_path: Path) -> None:
    torch.save(AffNet().state_dict(), tmp_path / "affnet.pth")
    with pytest.raises(ValueError, match=r"affnet\.pth holds no HardNet"):
        load_weights(HardNet(), tmp_path / "affnet.pth")
    (tmp_path / "garbage.pth").write_bytes(b"not a checkpoint")
    with pytest.raises(ValueError, match=r"garbage\.pth is neither a state_dict nor TorchScript"):
        load_weights(HardNet(), tmp_path / "garbage.pth")
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(ValueError, match=r"list\.pth holds no state_dict"):
        load_weights(HardNet(), tmp_path / "list.pth")
    with pytest.raises(FileNotFoundError, match=r"absent\.pth does not exist"):
        load_weights(HardNet(), tmp_path / "absent.pth")
    with pytest.raises(ValueError, match=f"there are: {', '.join(ARCHITECTURES)}"):
        build("siftnet")


@pytest.fixture(scope="module")
def hardnet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("onnx") / "hardnet.onnx"
    torch.manual_seed(0)
    export(randomized(build("hardnet")), path)
    return path


@pytest.mark.parametrize("name", ["affnet_fast", "orinet"])  # HardNet's is used below, L2-Net's by test_patch_training
def test_onnx_agrees_with_torch_on_real_patches(name: str, tmp_path: Path, patches: Tensor) -> None:
    network = randomized(build(name))
    export(network, tmp_path / "network.onnx")
    found = PatchNetwork(tmp_path / "network.onnx", batch=40)(patches)
    assert found.shape == (64, network.outputs)
    torch.testing.assert_close(found, network(patches).detach(), atol=1e-4, rtol=0)
    assert [f.name for f in tmp_path.iterdir()] == ["network.onnx"]  # one file, weights inside


def test_neighbours_and_batch_size_are_invisible(hardnet: Path, patches: Tensor) -> None:
    expected = PatchNetwork(hardnet)(patches)
    torch.manual_seed(0)
    torch.testing.assert_close(expected, randomized(build("hardnet"))(patches).detach(), atol=1e-4, rtol=0)
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
    plain, int8 = (PatchNetwork(tmp_path / f"absent{precision}.onnx") for precision in ("", ".int8"))
    for use in (lambda n: n(torch.zeros(1, 1, 32, 32)), lambda n: n.identity):
        with pytest.raises(NetworkFileError, match=r"absent\.onnx does not exist: scripts\.patch_networks\.export"):
            use(plain)
        with pytest.raises(NetworkFileError, match=r"absent\.int8\.onnx does not exist: .*=int8.*calibration="):
            use(int8)


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


def untrained(name: str) -> DISK | ALIKED | XFeat:
    torch.manual_seed(0)
    if name == "disk":
        return DISK(max_features=50, score_threshold=-100.0, device="cpu", network=kornia.feature.DISK())
    if name == "xfeat":
        return XFeat(max_features=50, device="cpu", network=kornia.feature.XFeat(detection_threshold=0.0))
    return ALIKED(max_features=50, device="cpu", network=kornia.feature.ALIKED(detection_threshold=0.0))


each = pytest.mark.parametrize("name", ["disk", "aliked", "xfeat"])


@each
@pytest.mark.parametrize("colour", [False, True])
def test_shapes_and_ranges(name: str, colour: bool) -> None:
    image, extractor = texture(0, *SIZE), untrained(name)
    found = extractor(np.stack([image, image[::-1], image], -1) if colour else image)
    if not colour:
        assert same(found, extractor(np.stack([image] * 3, -1)))
    assert 10 < len(found) <= 50
    assert found.image_size.tolist() == list(SIZE)
    assert found.descriptors.shape == (len(found), 64 if name == "xfeat" else 128)
    torch.testing.assert_close(found.descriptors.norm(dim=1), torch.ones(len(found)))
    assert found.scores.shape == (len(found),)
    assert (found.keypoints >= 0).all()
    assert (found.keypoints <= torch.tensor([SIZE[1] - 1.0, SIZE[0] - 1.0])).all()
    assert torch.equal(found.lafs[..., :2], torch.eye(2).expand(len(found), 2, 2))
    for value in (found.lafs, found.scores, found.descriptors):
        value.add_(0)  # an inference tensor could not be changed, nor trained on
        assert not value.requires_grad


class Probe(nn.Module):
    """In place of DISK's network: the heatmap is the red channel, the descriptors are constant."""

    def forward(self, images: Tensor) -> Tensor:
        constant = torch.ones_like(images[:, :1]).expand(-1, 128, -1, -1)
        return torch.cat([constant, images[:, :1]], 1)


DOTS = {(37, 21): 200, (10, 60): 255, (100, 70): 120}  # (x, y): brightness


def dots() -> np.ndarray:
    image = np.zeros((*SIZE, 3), np.uint8)
    for (x, y), value in DOTS.items():
        image[y, x, 0] = value
    return image


def test_disk_keypoints_count_from_the_centre_of_the_first_pixel() -> None:
    found = DISK(network=kornia.feature.DISK(unet=Probe()), device="cpu")(dots())
    points = [(int(x), int(y)) for x, y in found.keypoints.tolist()]
    assert dict(zip(points, (255 * found.scores).round().int().tolist(), strict=True)) == DOTS
    few = DISK(network=kornia.feature.DISK(unet=Probe()), device="cpu", max_features=2)(dots())
    assert sorted(round(255 * s) for s in few.scores.tolist()) == [200, 255]
    nothing = DISK(network=kornia.feature.DISK(unet=Probe()), device="cpu")(np.zeros(SIZE, np.uint8))
    assert (nothing.lafs.shape, nothing.descriptors.shape) == ((0, 2, 3), (0, 128))


def test_aliked_keypoints_count_from_the_centre_of_the_first_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    network = kornia.feature.ALIKED(detection_threshold=0.2)
    dense = lambda image: (torch.ones_like(image[:, :1]).expand(-1, 128, -1, -1), image[:, :1])  # noqa: E731
    monkeypatch.setattr(network, "extract_dense_map", dense)
    found = ALIKED(network=network, device="cpu")(dots())
    centres = found.keypoints.round().int().tolist()
    assert {tuple(centre) for centre in centres} == set(DOTS)
    # A dot is symmetric, so the refinement moves nothing; 1e-4 px is float32 on coordinates that went to [-1, 1].
    assert (found.keypoints - found.keypoints.round()).abs().max() < 1e-4
    few = ALIKED(network=network, device="cpu", max_features=2)(dots())
    assert len(few) == 2
    assert few.scores.min() > 0.7


def test_xfeat_keypoints_count_from_the_centre_of_the_first_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an image that is resized from (120, 152) to (96, 128): a ramp tells where pixels come from."""
    network, ramps, at = kornia.feature.XFeat().eval(), [], torch.tensor([[40, 30], [100, 70]])

    def detected(image: Tensor, top_k: int) -> list[dict[str, Tensor]]:
        resized, high, wide = network._preprocess_tensor(image)
        ramps.append(resized[0, :2, at[:, 1], at[:, 0]].T * 255)
        return [{"keypoints": at * torch.tensor([wide, high]), "scores": torch.ones(2), "descriptors": ramps[0]}]

    monkeypatch.setattr(network, "detectAndCompute", detected)
    y, x = np.mgrid[:120, :152].astype(np.uint8)
    found = XFeat(network=network, device="cpu")(np.stack([x, y, x], -1))
    torch.testing.assert_close(found.keypoints, ramps[0], rtol=0, atol=1e-3)


@each
@pytest.mark.parametrize("shape", [(31, 200), (0, 0), (1, 500, 3), (64, 64, 4)])
def test_images_that_cannot_be(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="at least 32 x 32"):
        untrained(name)(np.zeros(shape, np.uint8))


@each
def test_weights_that_cannot_be_fetched(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cls, file, publisher = {
        "disk": (kornia.feature.DISK, "depth-save.pth", "github.com/cvlab-epfl/disk"),
        "aliked": (kornia.feature.ALIKED, "aliked-n16.pth", "github.com/Shiaoming/ALIKED"),
        "xfeat": (kornia.feature.XFeat, "xfeat.pt", "github.com/verlab/accelerated_features"),
    }[name]
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))

    def offline(*_: object, **__: object) -> None:
        try:
            raise OSError("Name or service not known")
        except OSError as error:
            raise RuntimeError("Failed to load weights from all 2 source(s).") from error

    monkeypatch.setattr(cls, "from_pretrained", offline)
    with pytest.raises(ConnectionError) as told:
        presets.build("features", name)
    for word in ("Name or service not known", publisher, f"copy its {file} to {tmp_path / 'checkpoints' / file}"):
        assert word in str(told.value)


class Runs:
    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (os.environ["RUNS"],)


@pytest.mark.parametrize("known", [True, False])
def test_weights_of_another_file_are_refused_and_run_nothing(known, tmp_path, monkeypatch):
    """A file in the place of the published one, by its digest, and where no digest is known by its code."""
    monkeypatch.setenv("RUNS", str(tmp_path / "run"))
    monkeypatch.setattr("time.sleep", lambda seconds: None)  # between kornia's attempts
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    file = tmp_path / "checkpoints" / ("aliked-n16.pth" if known else "epipolar-save.pth")
    file.parent.mkdir()
    torch.save({"extractor": Runs()}, file)
    options = {} if known else {"weights": "epipolar"}
    said = r"aliked-n16\.pth is not the published aliked-n16\.pth: its SHA-256 is \w+; delete it"
    with pytest.raises((NetworkFileError, ConnectionError), match=said if known else "Weights only load failed"):
        presets.build("features", "aliked" if known else "disk", **options)
    assert not (tmp_path / "run").exists()
