"""What networks see of matches, and the networks of one `backbone`: LC (Yi et al., CVPR 2018), DFE (Ranftl & Koltun,
ECCV 2018) and ConvMatch (Zhang & Ma, AAAI 2023)."""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from fmtorch.core.types import Correspondences
from fmtorch.geometry.refine import reweighted_fits
from fmtorch.pruning.consistency import frame_agreement, usable_frame_maps
from fmtorch.pruning.networks import layers, learned

COORDINATES = ("size", "K")
MIN_AREA_RATIO = 1e-12  # of two frames; keeps the gradient of the logarithm finite


@dataclasses.dataclass(frozen=True)
class MatchInputs:
    """Turns correspondences into (B, channels, N) float32, zero in masked slots.

    coordinates, the first four channels (x0, y0, x1, y1):
      "size": ``(x - w/2) / max(h, w)``, as Brachmann & Rother, "Neural-guided RANSAC", ICCV 2019. Points have (0, 0) at
      the centre of the first pixel, so this centre is half a pixel off the image's: it is kept as published.
      "K": rays ``K^-1 (x, y, 1)``, as Yi et al., CVPR 2018, for the essential matrix.
    side: names from `SIDE`, in this order after the coordinates. What is not known, of a match or of all, is 0, which
    no channel but "scale" (beside "rotation") and "agreement" otherwise takes:
      "ratio": the ratio, or 1 - score, as it is, [0, 1].
      "mutual": 1 or -1.
      "scale": half the logarithm of the determinant of the map from frame 0 to frame 1.
      "rotation": cosine and sine of that map's rotation (of its polar decomposition), so without a jump at any angle.
      "agreement": ``2 a - 1`` with a of `frame_agreement`, in [-1, 1].

    Raises ValueError for unknown names."""

    coordinates: str = "size"
    side: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.coordinates not in COORDINATES:
            raise ValueError(f"coordinates={self.coordinates}; there are: {', '.join(COORDINATES)}")
        object.__setattr__(self, "side", tuple(self.side))
        unknown = [name for name in self.side if name not in SIDE]
        if unknown or len(set(self.side)) < len(self.side):
            raise ValueError(f"side={list(self.side)}: each at most once of {', '.join(SIDE)}")

    @property
    def channels(self) -> int:
        """Numbers for each match."""
        return 4 + sum(SIDE[name][0] for name in self.side)

    def __call__(self, c: Correspondences) -> tuple[Float[Tensor, "b channels n"], Bool[Tensor, "b n"]]:
        """The input and the mask of its columns: matches of `c.mask` whose normalised coordinates are finite.
        Raises ValueError where image sizes or calibration matrices are missing."""
        x0, x1 = (torch.where(c.mask[..., None], x, 0) for x in (c.x0, c.x1))
        if self.coordinates == "size":
            points = [_by_size(x0, c.size0, "size0"), _by_size(x1, c.size1, "size1")]
        else:
            points = [by_calibration(x, K) for x, K in zip((x0, x1), _calibrations(c), strict=True)]
        coordinates = torch.cat(points, -1).float()
        mask = c.mask & torch.isfinite(coordinates).all(-1)
        channels = [*torch.where(mask[..., None], coordinates, 0).unbind(-1)]
        for count, values in (SIDE[name] for name in self.side):
            known = values(c) or [torch.zeros_like(c.x0[..., 0])] * count
            channels += [torch.where(mask & torch.isfinite(value), value.float(), 0) for value in known]
        return torch.stack(channels, 1), mask

    def unit(self, c: Correspondences) -> Float[Tensor, " b"]:
        """Pixels of one unit of the coordinates, the mean of both images, typed as `x0`; ValueError where unknown."""
        if self.coordinates == "size":
            unit0, unit1 = (_known(size, f"size{i}", BY_SIZE).amax(-1) for i, size in enumerate((c.size0, c.size1)))
        else:
            unit0, unit1 = ((K[:, 0, 0].abs() + K[:, 1, 1].abs()) / 2 for K in _calibrations(c))
        return (unit0 + unit1).to(c.x0.dtype) / 2


BY_SIZE = (
    "coordinates=size needs `{}`, the images' (h, w): give image sizes with the matches, or take a network trained on "
    "calibrated coordinates (coordinates=K)"
)
BY_CALIBRATION = (
    "coordinates=K needs `{}`, the calibration matrices: take a data set that has them, or a network trained on "
    "coordinates by image size (coordinates=size)"
)


def _known(value: Tensor | None, name: str, message: str) -> Tensor:
    if value is None:
        raise ValueError(message.format(name))
    return value


def _by_size(x: Float[Tensor, "b n 2"], size: Tensor | None, name: str) -> Float[Tensor, "b n 2"]:
    size = _known(size, name, BY_SIZE).to(x.dtype)
    return (x - size.flip(-1)[:, None] / 2) / size.amax(-1)[:, None, None]


def _calibrations(c: Correspondences) -> list[Tensor]:
    return [_known(K, f"K{i}", BY_CALIBRATION) for i, K in enumerate((c.K0, c.K1))]


def by_calibration(x: Float[Tensor, "b n 2"], K: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b n 2"]:
    """The points K^-1 x, of an upper triangular K with last row (0, 0, 1)."""
    fx, skew, cx, fy, cy = (K[:, i, j, None].to(x.dtype) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    y = (x[..., 1] - cy) / fy
    return torch.stack([(x[..., 0] - cx - skew * y) / fx, y], -1)


def _frame_map(c: Correspondences) -> Float[Tensor, "b n 2 2"] | None:
    """The linear part of the map from frame 0 to frame 1; the identity's in masked slots and for unusable frames."""
    return None if c.lafs0 is None or c.lafs1 is None else usable_frame_maps(c.lafs0, c.lafs1, c.mask)[0]


def _scale(c: Correspondences) -> list[Tensor]:
    if (S := _frame_map(c)) is None:
        return []
    return [(S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]).abs().clamp_min(MIN_AREA_RATIO).log() / 2]


def _rotation(c: Correspondences) -> list[Tensor]:
    if (S := _frame_map(c)) is None:
        return []
    cosine, sine = S[..., 0, 0] + S[..., 1, 1], S[..., 1, 0] - S[..., 0, 1]
    squared = cosine.square() + sine.square()
    inverse = torch.where(squared > 0, torch.where(squared > 0, squared, 1).rsqrt(), 0)
    return [cosine * inverse, sine * inverse]


def _agreement(c: Correspondences) -> list[Tensor]:
    if c.lafs0 is None or c.lafs1 is None:
        return []
    return [2 * frame_agreement(c.x0, c.x1, c.lafs0, c.lafs1, c.ambiguity, c.mask) - 1]


SIDE: dict[str, tuple[int, Callable[[Correspondences], list[Tensor]]]] = {
    "ratio": (1, lambda c: [] if c.ambiguity is None else [torch.where(c.mask, c.ambiguity, 0)]),
    "mutual": (1, lambda c: [] if c.mutual is None else [c.mutual.to(c.x0.dtype) * 2 - 1]),
    "scale": (1, _scale),
    "rotation": (2, _rotation),
    "agreement": (1, _agreement),
}  # name: how many channels, and what they hold, nothing where that is not known

RESIDUAL_UNIT = 1e-3  # of the image's longest side, or of the focal length: about a pixel
LARGEST_RESIDUAL = 0.5  # of the same; as published


class WithOptions(nn.Module):
    """A network of `inputs` with `options`, part of its identity. Raises ValueError for unknown coordinates or side."""

    def __init__(self, coordinates: str, side: Sequence[str], **options: Any) -> None:
        super().__init__()
        self.inputs = MatchInputs(coordinates, tuple(side))
        self.options = {**options, "coordinates": coordinates, "side": list(side)}

    def extra_repr(self) -> str:
        return ", ".join(f"{key}={value}" for key, value in self.options.items())


class OfBackbone(WithOptions):
    """A network of a `backbone`."""

    def forward(self, c: Correspondences) -> learned.Prediction:
        """The prediction of each match. Raises ValueError where image sizes or calibration matrices are missing."""
        return self.predict(c, self.backbone)  # type: ignore[no-any-return, operator]


class PointCN(nn.Module):
    """The same perceptrons for every match, which see the others by context norm.
    A perceptron, residual blocks of two layers each, and a perceptron to the outputs."""

    def __init__(self, inputs: int, channels: int, blocks: int) -> None:
        super().__init__()
        self.p_in = layers.Perceptron(inputs, channels)
        self.blocks = nn.ModuleList(layers.ResidualBlock(channels) for _ in range(blocks))
        self.p_out = layers.Perceptron(channels, 1)

    def forward(self, x: Float[Tensor, "b inputs n"], slots: layers.Slots) -> Float[Tensor, "b 1 n"]:
        """x has to be zero in masked slots, where the result means nothing."""
        y = layers.through(self.blocks, slots.clean(torch.relu(self.p_in(x.transpose(0, 1)))), slots)
        return self.p_out(y).transpose(0, 1)  # type: ignore[no-any-return]


class LC(OfBackbone):
    """Classifies all matches of a pair at once.

    Yi, Trulls, Ono, Lepetit, Salzmann, Fua, "Learning to find good correspondences", CVPR 2018.

    Args:
        channels: of each layer.
        blocks: residual blocks of two layers.
        coordinates: "size", for the fundamental matrix, or "K", for the essential matrix as published.
        side: side information, see `MatchInputs`. Raises ValueError for unknown coordinates or side information.
    """

    def __init__(
        self, *, channels: int = 128, blocks: int = 12, coordinates: str = "size", side: Sequence[str] = ()
    ) -> None:
        super().__init__(coordinates, side, channels=channels, blocks=blocks)
        self.input_channels = self.inputs.channels
        self.backbone = PointCN(self.input_channels, channels, blocks)

    def predict(self, c: Correspondences, backbone: learned.Backbone) -> learned.Prediction:
        """One stage; ``weight = tanh(relu(logit))`` as published (section 3.3), 0 where masked."""
        x, mask = self.inputs(c)
        logit = backbone(x, layers.Slots.of(mask))[:, 0]
        return learned.Prediction(logit[None], torch.where(mask, torch.tanh(torch.relu(logit)), 0)[None])


class PointwiseNetwork(nn.Module):
    """Perceptrons of these widths with context norm, batch norm and ReLU, and a perceptron to the outputs."""

    def __init__(self, inputs: int, widths: Sequence[int], outputs: int) -> None:
        super().__init__()
        pairs = zip((inputs, *widths), widths, strict=False)
        self.linear = nn.ModuleList(layers.Perceptron(before, after, bias=False) for before, after in pairs)
        self.norm = nn.ModuleList(layers.ContextBatchNormReLU(width) for width in widths)
        self.p_out = layers.Perceptron((inputs, *widths)[-1], outputs)

    def forward(self, x: Float[Tensor, "b inputs n"], slots: layers.Slots) -> Float[Tensor, "b outputs n"]:
        """x has to be zero in masked slots, where the result means nothing."""
        y = x.transpose(0, 1)
        for linear, norm in zip(self.linear, self.norm, strict=True):
            y = norm(linear(y), slots)
        return self.p_out(y).transpose(0, 1)  # type: ignore[no-any-return]


class DFE(OfBackbone):
    """Iterated weighted 8-point fits; a network predicts the weights, from the second fit on with the last residuals.

    Ranftl & Koltun, "Deep fundamental matrix estimation", ECCV 2018, section 4, through `geometry.reweighted_fits`.
    What differs from the authors' code: one network serves all iterations (theirs: another for the first); its layers
    are context norm, batch norm and ReLU over real matches, where theirs are instance norm and an affine map, which is
    the same, and leaky ReLU; residuals are Sampson distances on a logarithmic scale, since on theirs, linear to half
    the image, those of a pixel and of five are the same to a network; matches are weighted by w, theirs by w^2; and a
    second output gives the log-odds that a match is an inlier, since weights that sum to one are no probabilities.

    Args:
        widths: of the layers. As published, with five iterations, a pair costs ten times what it costs `LC`.
        iterations: fits.
        coordinates: "size" or "K", what the network sees; fits are in pixels, of fundamental matrices, in any case.
        side: side information, see `MatchInputs`. Raises ValueError for unknown coordinates or side information.
    """

    def __init__(
        self, *, widths: Sequence[int] = (64, 128, 1024, 512, 256), iterations: int = 5, coordinates: str = "size",
        side: Sequence[str] = (),
    ) -> None:  # fmt: skip
        if iterations < 1:
            raise ValueError(f"iterations={iterations}: at least one fit")
        super().__init__(coordinates, side, widths=list(widths), iterations=iterations)
        self.iterations = iterations
        self.input_channels = self.inputs.channels + 2
        self.backbone = PointwiseNetwork(self.input_channels, tuple(widths), 2)

    def predict(self, c: Correspondences, backbone: learned.Backbone) -> learned.Prediction:
        """One stage for each fit, with weights that sum to 1 over the matches of a pair."""
        x, mask = self.inputs(c)
        slots = layers.Slots.of(mask)
        unit = self.inputs.unit(c)[:, None] * RESIDUAL_UNIT
        logits: list[Tensor] = []
        weights: list[Tensor] = []

        def weigh(F: Tensor | None, residual: Tensor | None) -> Tensor:
            state = torch.zeros_like(x[:, :2])
            if residual is not None:
                relative = (residual / unit).clamp_max(LARGEST_RESIDUAL / RESIDUAL_UNIT)
                share = weights[-1] * slots.matches[:, None]  # 1 on average
                state = torch.stack([torch.log1p(relative).to(x.dtype), torch.log1p(share)], 1)
                state = torch.where(mask[:, None], state, 0)
            weight_logit, logit = backbone(torch.cat([x, state], 1), slots).unbind(1)
            logits.append(logit)
            weights.append(slots.softmax(weight_logit))
            return weights[-1].double()

        fits = reweighted_fits(c.x0, c.x1, weigh, self.iterations, mask)
        return learned.Prediction(torch.stack(logits), torch.stack(weights), fits.F)


# ConvMatch: Zhang & Ma, "ConvMatch: Rethinking network design for two-view correspondence learning", AAAI 2023

EXTENT = {"size": 0.5, "K": 1.0}  # half a side of the grid: the longer side of image 0; one focal length, as published
WIDTHS = 64, 16, 4  # of the layers that predict log-odds
CONTEXT_EPS = 1e-3


class Projection(nn.Module):
    """Two numbers, or those of motion and side information, to features."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.hidden0, self.hidden1 = layers.NormedPerceptron(inputs, 32), layers.NormedPerceptron(32, 64)
        self.last = layers.Perceptron(64, channels)

    def forward(self, x: Float[Tensor, "c b n"], slots: layers.Slots) -> Float[Tensor, "d b n"]:
        return slots.clean(self.last(self.hidden1(self.hidden0(x, slots), slots)))


class Attention(nn.Module):
    """``x + MLP([x, attention of x to y])``: motions to the grid, and back."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value, self.merge = (layers.Perceptron(channels, channels) for _ in range(4))
        self.hidden = layers.NormedPerceptron(2 * channels, 2 * channels)
        self.last = layers.Perceptron(2 * channels, channels)

    def forward(
        self, x: Float[Tensor, "c b n"], y: Float[Tensor, "c b m"], slots_x: layers.Slots, slots_y: layers.Slots
    ) -> Float[Tensor, "c b n"]:
        attended = layers.attention(self.query(x), self.key(y), self.value(y), slots_y, heads=self.heads)
        return x + slots_x.clean(self.last(self.hidden(torch.cat([x, self.merge(attended)]), slots_x)))


class GridFilter(nn.Module):
    """Three residual blocks of two 3 x 3 convolutions over the grid of motions, and a perceptron."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=1) for _ in range(6))
        self.norms = nn.ModuleList(layers.BatchNormReLU(channels) for _ in range(6))
        self.last = layers.Perceptron(channels, channels)

    def forward(self, x: Float[Tensor, "c b m"], slots: layers.Slots, side: int) -> Float[Tensor, "c b m"]:
        before = x
        for i, (convolution, norm) in enumerate(zip(self.convolutions, self.norms, strict=True)):
            grid = convolution(torch.unflatten(x.transpose(0, 1), 2, (side, side)))
            x = norm(grid.flatten(2).transpose(0, 1), slots)
            if i % 2:
                x = before = x + before
        return slots.clean(self.last(x))


class Layer(nn.Module):
    """Motions aligned to the grid, filtered there, and taken back; log-odds from what changed."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.align, self.back = Attention(channels, heads), Attention(channels, heads)
        self.filter = GridFilter(channels)
        pairs = list(itertools.pairwise((channels, *WIDTHS)))
        self.hidden = nn.ModuleList(layers.Perceptron(*pair) for pair in pairs)
        self.norms = nn.ModuleList(layers.ContextBatchNormReLU(width, CONTEXT_EPS) for width in WIDTHS)
        self.last = layers.Perceptron(WIDTHS[-1], 1)

    def forward(self, x: Tensor, grid: Tensor, slots: layers.Slots, side: int) -> tuple[Tensor, Tensor]:
        """The motions' features (c, b, n) and log-odds (1, b, n)."""
        nodes = slots.columns(side * side)
        motion = self.filter(self.align(grid, x, nodes, slots), nodes, side)
        after = self.back(x, motion, slots, nodes)
        y = after - x
        for linear, norm in zip(self.hidden, self.norms, strict=True):
            y = norm(slots.clean(linear(y)), slots)
        return after, self.last(y)


class MotionField(nn.Module):
    """All layers; from the inputs of matches to log-odds of each layer."""

    centres: Tensor

    def __init__(self, inputs: int, channels: int, layer_count: int, heads: int, side: int, extent: float) -> None:
        super().__init__()
        self.side = side
        self.position, self.grid_position = Projection(2, channels), Projection(2, channels)
        self.motion = Projection(inputs - 2, channels)
        self.layers = nn.ModuleList(Layer(channels, heads) for _ in range(layer_count))
        x = torch.linspace(1 / side - 1, 1 - 1 / side, side) * extent
        self.register_buffer("centres", torch.cartesian_prod(-x, x).T.flip(0), persistent=False)  # (x, y), y falling

    def forward(self, x: Float[Tensor, "b inputs n"], slots: layers.Slots) -> Float[Tensor, "b layers n"]:
        """x has to be zero in masked slots, where the result means nothing."""
        x0, x1, side = x.transpose(0, 1).tensor_split((2, 4))
        y = self.motion(torch.cat([x1 - x0, side]), slots) + self.position(x0, slots)
        alike = layers.Slots(torch.full_like(slots.matches[:1], self.side**2), None)  # the grid, the same for all pairs
        grid = self.grid_position(self.centres[:, None].to(x.dtype), alike).expand(-1, x.shape[0], -1)
        grid = slots.columns(self.side**2).clean(grid)
        logits = []
        for layer in self.layers:
            y, logit = layer(y, grid, slots, self.side)
            logits.append(logit)
        return torch.cat(logits).transpose(0, 1)


class ConvMatch(OfBackbone):
    """Classifies matches by a regular grid of motions, which convolutions smooth.

    Args:
        channels: of each layer. layers: each with log-odds of its own. heads: of attention.
        grid: cells along a side, over [-1/2, 1/2]^2 with coordinates="size", over [-1, 1]^2 with "K", as published.
        coordinates: "size", for the fundamental matrix, or "K", for the essential matrix.
        side: side information, see `MatchInputs`; beside the motion. Raises ValueError where either is unknown.
    """

    def __init__(
        self, *, channels: int = 128, layers: int = 6, heads: int = 4, grid: int = 16, coordinates: str = "size",
        side: Sequence[str] = (),
    ) -> None:  # fmt: skip
        super().__init__(coordinates, side, channels=channels, layers=layers, heads=heads, grid=grid)
        self.input_channels = self.inputs.channels
        self.backbone = MotionField(self.input_channels, channels, layers, heads, grid, EXTENT[coordinates])

    def predict(self, c: Correspondences, backbone: learned.Backbone) -> learned.Prediction:
        """A prediction of each layer, ``weight = relu(tanh(logit))``."""
        x, mask = self.inputs(c)
        logit = backbone(x, layers.Slots.of(mask)).transpose(0, 1)
        return learned.Prediction(logit, torch.where(mask, torch.relu(torch.tanh(logit)), 0))
