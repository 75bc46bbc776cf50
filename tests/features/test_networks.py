"""Patch networks: the authors' weights give the authors' outputs, and other layouts load as what they are."""

from pathlib import Path

import kornia
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from fmtorch.features.networks import ARCHITECTURES, DESCRIPTORS, AffNet, HardNet, L2Net, OriNet, build, load_weights
from tests.conftest import oracle, shared_path

RTOL = 1e-4  # of unit outputs: float32 sums of up to 8,192 terms in another order


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


@pytest.mark.parametrize("file", ["AffNet.pth", "AffNetJIT.pt"])
def test_affnet_with_the_authors_weights(patches: Tensor, file: str) -> None:
    network = AffNet().eval()
    load_weights(network, shared_path(f"weights/{file}"))
    expected = oracle("affnet_orinet.npz")
    found = network(patches).detach().numpy()
    np.testing.assert_allclose(found, expected["affnet_features"], atol=RTOL)
    shape = found + np.array([1, 0, 1])  # (a11, a21, a22)
    np.testing.assert_allclose(shape, expected["authors_affnet_jit"], atol=RTOL)


@pytest.mark.parametrize("file", ["OriNet.pth", "OriNetJIT.pt"])
def test_orinet_with_the_authors_weights(patches: Tensor, file: str) -> None:
    network = OriNet().eval()
    load_weights(network, shared_path(f"weights/{file}"))
    expected = oracle("affnet_orinet.npz")
    found = network(patches).detach().numpy()
    np.testing.assert_allclose(found, expected["orinet_features"], atol=RTOL)
    np.testing.assert_allclose(found, expected["authors_orinet_jit"], atol=RTOL)


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
    with pytest.raises(
        ValueError, match="there are: hardnet, hardnet_fast, l2net, geodesc, affnet, affnet_fast, orinet"
    ):
        build("siftnet")
