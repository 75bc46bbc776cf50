"""What the patch networks share: the trunk of convolutions and the normalisation of patches."""

import math
import pickle
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

PATCH_SIZE = 32
Layout = Sequence[tuple[int, int]]  # channels and stride of each 3 x 3 convolution before the last


def l2net_layout(width: int) -> Layout:
    """L2-Net's six 3 x 3 convolutions (Tian, Fan, Wu, CVPR 2017, fig. 2).
    width: channels of the first pair of convolutions; of the second twice, the third four times that, by stride 2."""
    return (width, 1), (width, 1), (2 * width, 2), (2 * width, 1), (4 * width, 2), (4 * width, 1)


def standardize(patches: Float[Tensor, "n 1 h w"], eps: float) -> Float[Tensor, "n 1 h w"]:
    """Each patch with zero mean and unit (sample) standard deviation; a constant patch becomes zero.
    The statistics are constants for the gradient, as in the authors' code: gradients through them are noise."""
    mean = patches.mean(dim=(1, 2, 3), keepdim=True).detach()
    centred = patches - mean
    count = patches.shape[-1] * patches.shape[-2]
    std = (centred.square().sum(dim=(1, 2, 3), keepdim=True) / (count - 1)).sqrt().detach()
    return centred / (std + eps)


def trunk(layout: Layout, dropout: float, outputs: int, *, bias: bool = False) -> list[nn.Module]:
    """Convolutions of 3 x 3 with batch norm and ReLU, then one over the whole of what is left.
    Batch norms have no learned scale or shift. bias: of the last convolution."""
    layers: list[nn.Module] = []
    channels = 1
    for out, stride in layout:
        convolution = nn.Conv2d(channels, out, kernel_size=3, stride=stride, padding=1, bias=False)
        layers += [convolution, nn.BatchNorm2d(out, affine=False), nn.ReLU(inplace=True)]
        channels = out
    side = PATCH_SIZE // math.prod(stride for _, stride in layout)
    return [*layers, nn.Dropout(dropout), nn.Conv2d(channels, outputs, kernel_size=side, bias=bias)]


def orthogonal_(features: nn.Module, gain: float = 0.6) -> None:
    """The authors' initialisation: orthogonal weights, biases of 0.01."""
    for module in features.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.orthogonal_(module.weight, gain=gain)
            if module.bias is not None:
                nn.init.constant_(module.bias, 0.01)


def as_float32(features: nn.Module, x: Tensor) -> Tensor:
    """The trunk's output as (N, D) float32, whatever the precision of autocast."""
    out: Tensor = features(x.to(memory_format=torch.channels_last))
    return out.flatten(1).float()


class HardNet(nn.Module):
    """HardNet (Mishchuk, Mishkin, Radenovic, Matas, NIPS 2017): L2-Net's layout, hardest-in-batch triplets.
    The state_dict is that of the authors' release and of kornia.feature.HardNet. Each patch is standardised inside."""

    outputs = 128
    layout: Layout = l2net_layout(32)
    eps = 1e-6  # added to the deviation of a patch

    def __init__(self, dropout: float = 0.3) -> None:
        super().__init__()
        layers = trunk(self.layout, dropout, self.outputs)
        self.features = nn.Sequential(*layers, nn.BatchNorm2d(self.outputs, affine=False))
        orthogonal_(self.features)

    def forward(self, patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n 128"]:
        """Descriptors of unit length; a zero vector stays zero, with a finite gradient."""
        x = as_float32(self.features, standardize(patches, self.eps))
        return x / (x.square().sum(dim=1, keepdim=True) + 1e-10).sqrt()


class HardNetFast(HardNet):
    """HardNet with less than a quarter of its multiplications.
    The first convolution has stride 2 already, the widest has 64 channels."""

    layout: Layout = ((32, 2), (32, 1), (64, 2), (64, 1), (64, 1))


class L2Net(HardNet):
    """L2-Net (Tian, Fan, Wu, CVPR 2017).
    Unlike HardNet's, its input loses the mean patch of the training set (`pixel_mean`) before each patch is
    standardised, and its output passes local response normalisation over all channels: division by the length."""

    eps = 1e-12
    pixel_mean: Tensor

    def __init__(self, dropout: float = 0.1) -> None:
        super().__init__(dropout)
        self.register_buffer("pixel_mean", torch.zeros(1, 1, PATCH_SIZE, PATCH_SIZE))

    def forward(self, patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n 128"]:
        """Descriptors of unit length (the release's normalisation with kappa 0, alpha 1 and beta 1/2)."""
        return super().forward(patches - self.pixel_mean)


class GeoDesc(HardNet):
    """GeoDesc (Luo et al., ECCV 2018): L2-Net's layout without a batch norm after the last convolution.
    Each patch is standardised, as in the authors' code (lzx551402/tfmatch, cnn_wrapper/descnet.py); no dropout."""

    def __init__(self) -> None:
        super().__init__(dropout=0.0)
        self.features = nn.Sequential(*list(self.features)[:-1])


class _FrameNetwork(nn.Module):
    """A few numbers of each patch, each in (-1, 1)."""

    outputs: int
    layout: Layout = l2net_layout(16)
    eps = 1e-6
    padding = 0  # of the last convolution

    def __init__(self, dropout: float = 0.25) -> None:
        super().__init__()
        *layers, last = trunk(self.layout, dropout, self.outputs, bias=True)
        last.padding = (self.padding, self.padding)  # type: ignore[assignment]
        self.features = nn.Sequential(*layers, last, nn.Tanh(), nn.AdaptiveAvgPool2d(1))
        orthogonal_(self.features)

    def forward(self, patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n d"]:
        return as_float32(self.features, standardize(patches, self.eps))


class AffNet(_FrameNetwork):
    """AffNet (Mishkin, Radenovic, Matas, ECCV 2018): three numbers of an affine shape, each in (-1, 1).
    The shape of an output x is the lower-triangular [[1 + x0, 0], [x1, 1 + x2]] in the patch's own coordinates, up to
    scale; x = 0 is a circle. The state_dict is that of the authors' release and of kornia's LAFAffNetShapeEstimator."""

    outputs = 3

    def __init__(self, dropout: float = 0.25) -> None:
        super().__init__(dropout)
        nn.init.zeros_(self.features[-3].bias)  # type: ignore[arg-type]


class AffNetFast(AffNet):
    """AffNet with less than a quarter of its multiplications.
    The first convolution has stride 2 already, the widest has 32 channels."""

    layout: Layout = ((16, 2), (16, 1), (32, 2), (32, 1), (32, 1))


class OriNet(_FrameNetwork):
    """OriNet (Mishkin, Radenovic, Matas, ECCV 2018): a vector (y, x) in (-1, 1)^2 whose atan2 is the orientation.
    The angle is in kornia's convention. The state_dict is that of the authors' release and of kornia.feature.OriNet."""

    outputs, eps = 2, 1e-8
    padding = 1  # nine positions, whose tanh is averaged


ARCHITECTURES: dict[str, type[nn.Module]] = {
    "hardnet": HardNet, "hardnet_fast": HardNetFast, "l2net": L2Net, "geodesc": GeoDesc,
    "affnet": AffNet, "affnet_fast": AffNetFast, "orinet": OriNet,
}  # fmt: skip
DESCRIPTORS = ("hardnet", "hardnet_fast", "l2net", "geodesc")


def build(architecture: str, **options: Any) -> nn.Module:
    """An untrained network; options as its class takes them. Raises ValueError for an unknown name."""
    if architecture not in ARCHITECTURES:
        raise ValueError(f"no patch network {architecture!r}; there are: {', '.join(ARCHITECTURES)}")
    return ARCHITECTURES[architecture](**options)


def read_checkpoint(path: Path | str) -> dict[str, Any]:
    """A checkpoint as a dictionary with a ``state_dict``; nothing in the file is executed.
    A bare state_dict, TorchScript and {"state_dict": ...} with whatever stands beside it are read.
    Raises FileNotFoundError, or ValueError naming the file where it is none of these."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist")
    try:
        script = _is_script(path)
        content: Any = _script_state(path) if script else torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, KeyError) as error:
        raise ValueError(f"{path} is neither a state_dict nor TorchScript: {error}") from error
    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        return dict(content)
    if isinstance(content, Mapping) and content and all(isinstance(value, Tensor) for value in content.values()):
        return {"state_dict": dict(content)}
    raise ValueError(f"{path} holds no state_dict")


def _is_script(path: Path) -> bool:
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def _script_state(path: Path) -> dict[str, Tensor]:
    """The state_dict of TorchScript; in old files the statistics of batch norms are attributes and no buffers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        script = torch.jit.load(str(path), map_location="cpu")  # type: ignore[no-untyped-call]
    state = dict(script.state_dict())
    for name, module in script.named_modules():
        for key in ("running_mean", "running_var"):
            if isinstance(getattr(module, key, None), Tensor):
                state.setdefault(f"{name}.{key}", getattr(module, key))
    return state


def load_weights(network: nn.Module, path: Path | str) -> dict[str, Any]:
    """Load a file into a network, strictly; returns what the file says beside the weights.
    Convolutions with a bias and batch norms with scale and shift, as ports of L2-Net have them, are folded into batch
    norms without. Raises ValueError with the keys that do not fit."""
    content = read_checkpoint(path)
    state = _folded({str(k).removeprefix("module."): v for k, v in content.pop("state_dict").items()}, network)
    try:
        network.load_state_dict(state, strict=True)
    except RuntimeError as error:
        raise ValueError(f"{path} holds no {type(network).__name__}: {error}") from error
    return content


def _folded(state: dict[str, Tensor], network: nn.Module) -> dict[str, Tensor]:
    """The same function in the keys of `network`: b, gamma and beta of a layer move into the running statistics.
    gamma (x + b - m) / sqrt(v + e) + beta = (x - m') / sqrt(v' + e') with v' + e' = (v + e) / gamma^2 and
    m' = m - b - beta sqrt(v + e) / gamma."""
    expected = network.state_dict()
    state = {k: v for k, v in _with_dropout(state).items() if k in expected or not k.endswith("num_batches_tracked")}
    for name, module in network.named_modules():
        if not isinstance(module, nn.BatchNorm2d):
            continue
        stem, _, index = name.rpartition(".")
        before = f"{stem}.{int(index) - 1}" if f"{stem}.{int(index) - 1}.weight" in expected else ""
        bias = state.pop(f"{before}.bias", None) if f"{before}.bias" not in expected else None
        gamma, beta = state.pop(f"{name}.weight", None), state.pop(f"{name}.bias", None)
        if (bias is None and gamma is None and beta is None) or f"{name}.running_var" not in state:
            continue
        mean, var = state[f"{name}.running_mean"].double(), state[f"{name}.running_var"].double() + module.eps
        gamma = torch.ones_like(var) if gamma is None else gamma.double()
        if not bool((gamma > 0).all()):
            raise ValueError(f"{name}.weight has scales that are not positive: they cannot be folded away")
        mean = mean if bias is None else mean - bias.double()
        mean = mean if beta is None else mean - beta.double() * var.sqrt() / gamma
        state[f"{name}.running_mean"] = mean.float()
        state[f"{name}.running_var"] = (var / gamma.square() - module.eps).float()
    optional = [name for name in expected if name == "pixel_mean" or name.endswith("num_batches_tracked")]
    return {name: expected[name] for name in optional} | state


def _with_dropout(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Keys of a network whose last convolution is layer 18, for want of a dropout layer, as where there is one."""
    if "features.18.weight" not in state:
        return state
    moved = {"18": "19", "19": "20"}
    parts = ((name.split("."), value) for name, value in state.items())
    return {".".join([stem, moved.get(index, index), *rest]): value for (stem, index, *rest), value in parts}
