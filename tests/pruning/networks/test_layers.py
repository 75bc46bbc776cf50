"""Networks of learned pruners: layers, LC, DFE, their inputs and files."""

import copy
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from fmtorch.core import Correspondences, collate
from fmtorch.geometry import eight_point, sampson
from fmtorch.pruning import DFE, LC, LearnedPruner, MatchInputs
from fmtorch.pruning.networks import CLNet, ConvMatch, NCMNet, OANet
from fmtorch.pruning.networks.layers import ContextBatchNormReLU, ResidualBlock, Slots
from scripts import convert_checkpoint
from tests.conftest import oracle
from tests.laws import calibrated, scene
from tests.pruning.networks.test_published import convert
from tests.reference.pruner_losses import context_batch_norm_relu

SIDE = ("ratio", "mutual", "scale", "rotation", "agreement")


def batch(channels=3, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(4, 9, generator=generator) > 0.3
    mask[1] = True
    x = torch.randn(channels, 4, 9, generator=generator, dtype=dtype) * torch.tensor([1e-3, 1.0, 30.0])[:, None, None]
    x = x + torch.tensor([5.0, 0.0, -7.0])[:, None, None]
    return torch.where(mask, x, 0).to(dtype), mask, generator


@pytest.mark.parametrize("training", [True, False])
def test_value_and_gradients_are_those_of_the_two_normalisations(training):
    """The collapsed form is the same function: equal to rounding of float64."""
    x, mask, generator = batch()
    layer = ContextBatchNormReLU(3).double().train(training)
    with torch.no_grad():
        for tensor in (layer.weight, layer.bias, layer.running_mean):
            tensor.copy_(torch.randn(3, generator=generator))
        layer.running_var.copy_(torch.rand(3, generator=generator) + 0.5)
    running = None if training else (layer.running_mean.clone(), layer.running_var.clone())
    inputs = [x.requires_grad_(), layer.weight, layer.bias]
    fast = layer(x, Slots.of(mask, x.dtype))
    slow = context_batch_norm_relu(x, mask, layer.weight, layer.bias, running)
    torch.testing.assert_close(fast, slow, rtol=1e-10, atol=1e-12)
    upstream = torch.randn(fast.shape, generator=generator, dtype=fast.dtype)
    both = (torch.autograd.grad(y, inputs, upstream) for y in (fast, slow))
    for a, b in zip(*both, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-9)


def test_running_statistics_are_batch_norms():
    x, mask, _ = batch()
    layer, reference = ContextBatchNormReLU(3).double(), torch.nn.BatchNorm1d(3).double()
    pairs = [torch.nn.functional.instance_norm(x[None, :, b, mask[b]]) for b in range(4)]
    for _ in range(3):
        layer(x, Slots.of(mask, x.dtype))
        reference(torch.cat(pairs, 2))
    torch.testing.assert_close(layer.running_var, reference.running_var, rtol=1e-10, atol=0)
    torch.testing.assert_close(layer.running_mean, reference.running_mean, rtol=0, atol=1e-10)


@pytest.mark.parametrize("training", [True, False])
def test_padding_is_invisible(training):
    """More slots, and a pair without matches, change neither a value nor a gradient; of float32, beyond rounding."""
    x, mask, _ = batch(dtype=torch.float32)
    block = ResidualBlock(3).train(training)
    wide = torch.cat([x, x.new_zeros(3, 4, 5)], 2)
    wide = torch.cat([wide, torch.zeros_like(wide[:, :1])], 1)
    wide_mask = torch.nn.functional.pad(mask, (0, 5, 0, 1))
    outputs, gradients = [], []
    for given, slots in ((x, Slots.of(mask)), (wide, Slots.of(wide_mask))):
        y = block(given, slots)
        outputs.append(y)
        gradients.append(torch.autograd.grad(y.square().sum(), list(block.parameters())))
        assert not y[:, slots.mask == 0].any()
    torch.testing.assert_close(outputs[1][:, :4, :9], outputs[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_matches_without_variance_have_finite_gradients(count):
    """No match, one match, equal matches: the variance is zero."""
    x = torch.ones(3, 1, 5, requires_grad=True)
    mask = torch.arange(5)[None] < count
    block = ResidualBlock(3)
    y = block(x * mask, Slots.of(mask))
    gradients = torch.autograd.grad(y.square().sum(), [x, *block.parameters()])
    assert torch.isfinite(y).all()
    assert all(torch.isfinite(g).all() for g in gradients)
    assert torch.isfinite(block.norm0.running_var).all()


torch.manual_seed(0)  # weights whatever else was collected
PUBLISHED = [
    OANet(side=["ratio"], blocks=4, clusters=20), ConvMatch(side=["ratio"], layers=2),
    CLNet(side=["ratio"], channels=32), NCMNet(side=["ratio"], channels=32, clusters=20),
]  # fmt: skip


def in_double(network: torch.nn.Module) -> torch.nn.Module:
    """In which rounding changes neither neighbours nor which matches are pruned, but by chance."""
    network, inputs = copy.deepcopy(network).double(), network.inputs
    network.inputs = lambda c: (inputs(c)[0].double(), inputs(c)[1])
    return network


BEFORE = [LC(side=["ratio"], blocks=4), DFE(side=["ratio"], widths=(16, 32, 8))]


@pytest.mark.parametrize("network", [*BEFORE, *PUBLISHED[:2], *map(in_double, PUBLISHED[2:])])
def test_padding_and_neighbours_change_a_networks_values_by_rounding_alone(network):
    """At inference; NaN in masked slots. `LearnedPruner` has the same bits."""
    counts, network = (60, 1, 100, 30), network.eval()
    with torch.no_grad():
        together = network(matches(counts))
        for i, n in enumerate(counts):
            alone = network(scene(i, count=n))
            torch.testing.assert_close(together.logit[:, i, :n], alone.logit[:, 0], rtol=1e-4, atol=1e-4)
            torch.testing.assert_close(together.weight[:, i, :n], alone.weight[:, 0], rtol=1e-3, atol=1e-4)
            assert not together.weight[:, i, n:].any()
    assert torch.isfinite(together.logit).all()


@pytest.mark.parametrize("model", ["F_r0.80", "F_rs_r0.80", "F_r1.00"])
def test_outputs_of_neural_guided_ransac(model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The authors' weights give the authors' sampling probabilities: float32 against float64 differ by up to 2e-4.
    So do those of their checkpoint, converted: of both in float32."""
    weights = {key: torch.from_numpy(value) for key, value in oracle(f"weights_ngransac_{model}.npz").items()}
    network = LC(side=["ratio"]).eval()
    network.load_state_dict(convert_checkpoint.authors_state("ngransac", network, weights))
    network.double()
    data = {key: torch.from_numpy(value) for key, value in oracle("ngransac_net.npz").items() if key != "names"}
    cases = [key[:3] for key in data if key.endswith(f".logprob_{model}")]
    assert len(cases) == 6
    for case in cases:
        x0, x1, ratio, size0, size1 = (data[f"{case}.{name}"][None] for name in ("X1", "X2", "ratio", "size1", "size2"))
        mask = torch.ones(x0.shape[:2], dtype=torch.bool)
        c = Correspondences(x0, x1, mask, ratio=ratio, size0=size0, size1=size1)
        x, _ = network.inputs(c)
        torch.testing.assert_close(x[0].mT, data[f"{case}.inp"], rtol=0, atol=1e-6)  # another order of rounding
        with torch.no_grad():
            logit = network.backbone(x.double(), Slots.of(mask, torch.float64))[0, 0]
        log_probability, expected = logit.sigmoid().log().log_softmax(0), data[f"{case}.logprob_{model}"].double()
        torch.testing.assert_close(log_probability, expected, rtol=0, atol=2e-4)
    torch.save(weights, tmp_path / "weights.net")
    convert(monkeypatch, "ngransac", tmp_path / "weights.net", tmp_path / "net.safetensors", "--side", "ratio")
    p = LearnedPruner(LC(side=["ratio"]), file=tmp_path / "net.safetensors").probability(c)[0].double()
    torch.testing.assert_close((p / p.sum()).log(), expected, rtol=0, atol=4e-4)


def matches(counts: tuple[int, ...]) -> Correspondences:
    """Pairs of several lengths with NaN in their padding."""
    c = collate([scene(i, count=n) for i, n in enumerate(counts)])
    return c.replace(x1=torch.where(c.mask[..., None], c.x1, torch.nan))


def test_weights_are_those_published() -> None:
    torch.manual_seed(7)
    network, c = LC(side=["ratio"], blocks=2, channels=16).eval(), matches((60, 30))
    logit, weight, F, _ = network(c)
    expected = torch.where(c.mask, torch.tanh(logit[0].clamp_min(0)), 0)
    assert (expected > 0).any()
    assert (expected[c.mask] == 0).any()
    assert torch.equal(weight[0], expected)
    assert F is None


@pytest.mark.parametrize("network", [*BEFORE, PUBLISHED[0]])
def test_mixed_precision(network: torch.nn.Module) -> None:
    """Products in bfloat16, statistics in float32: finite values and gradients close to those of float32."""
    c = matches((60, 100))
    losses = []
    for mixed in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            logit = network(c).logit[0]
        assert logit.dtype == torch.float32
        losses.append(torch.where(c.mask, logit, 0).square().sum())
    gradients = [torch.autograd.grad(loss, list(network.parameters()), allow_unused=True)[0] for loss in losses]
    torch.testing.assert_close(losses[1], losses[0], rtol=0.05, atol=0.05)
    assert torch.isfinite(gradients[1]).all()
    cosine = torch.nn.functional.cosine_similarity(*(g.flatten() for g in gradients), dim=0)
    assert cosine > 0.95


def small(**options: object) -> DFE:
    torch.manual_seed(0)
    return DFE(widths=(16, 32, 8), side=["ratio"], **options)  # type: ignore[arg-type]


def robust(x: Tensor, slots: Slots) -> Tensor:
    """A backbone whose weights fall with the square of the residual, as those of a robust kernel."""
    return torch.stack([-2 * x[:, -2], -x[:, -2]], 1)


def test_each_stage_is_the_fit_with_its_weights() -> None:
    c = scene(0)
    prediction = small()(c)
    assert prediction.logit.shape == prediction.weight.shape == (5, 1, 150)
    torch.testing.assert_close(prediction.weight.sum(-1), torch.ones(5, 1))
    for weight, F in zip(prediction.weight, prediction.F, strict=True):
        expected, valid = eight_point(c.x0.double(), c.x1.double(), weight.double())
        assert valid.all()
        torch.testing.assert_close(F, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("coordinates", ["size", "K"])
def test_residuals_are_fed_back(coordinates: str) -> None:
    """Weights that fall with the residual make the fits those of robust least squares: few outliers are left out."""
    c = calibrated(scene(0, outliers=0.05))
    prediction = small(coordinates=coordinates).predict(c, robust)
    first, *_, last = (float(sampson(F, c.x0.double(), c.x1.double()).median()) for F in prediction.F)
    assert last < 0.3 < 3 < first  # px; the noise of a coordinate is 0.3
    assert (prediction.weight[-1].log() - prediction.logit[-1] * 2).std() < 1e-4  # both follow the last residual


def degenerate() -> Correspondences:
    """Collinear, coincident, seven, two and no matches, one plane, and a sound pair."""
    sound = scene(0, count=60)
    line = torch.linspace(0, 600, 60)[None, :, None] * torch.tensor([1.0, 0.5])
    seven, two = (torch.arange(60)[None] < n for n in (7, 2))
    plane = sound.x0 * 1.1 + 3
    cases = [
        sound, sound.replace(x0=line, x1=line + 5), sound.replace(x0=torch.full_like(line, 7.0), x1=line * 0),
        sound.keep(seven), sound.keep(two), sound.keep(two & ~two), sound.replace(x1=plane),
    ]  # fmt: skip
    return collate(cases)


@pytest.mark.parametrize("network", [small(), small(coordinates="K")])
def test_gradients_are_finite_on_degenerate_pairs(network: DFE) -> None:
    """Of weights, log-odds and fits alike, in training mode, and no pair takes the sound one's gradient with it."""
    c = calibrated(degenerate())
    prediction = network.train()(c)
    loss = prediction.F.square()[..., 0, :].sum() + (prediction.logit * c.mask).sum() + prediction.weight.square().sum()
    gradients = torch.autograd.grad(loss, list(network.parameters()))
    assert all(torch.isfinite(g).all() for g in gradients)
    assert any(g.any() for g in gradients)
    assert torch.isfinite(prediction.logit).all()
    assert torch.isfinite(prediction.F).all()
    assert not prediction.F[:, 3:6].any()  # fewer than eight matches fit nothing
    assert all(torch.isfinite(b).all() for b in network.buffers())


def one_match(**changes: object) -> Correspondences:
    """A match from (10, 20) to (30, 50); the frame doubles in size and turns by 200 degrees."""
    c, s = math.cos(math.radians(200)), math.sin(math.radians(200))
    lafs0 = torch.tensor([[[[3.0, 0, 10], [0, 3, 20]]]])
    lafs1 = torch.tensor([[[[6 * c, -6 * s, 30], [6 * s, 6 * c, 50]]]])
    return Correspondences(
        lafs0[..., 2], lafs1[..., 2], torch.ones(1, 1, dtype=torch.bool), ratio=torch.tensor([[0.7]]),
        lafs0=lafs0, lafs1=lafs1, size0=torch.tensor([[100, 200]]), size1=torch.tensor([[400, 100]]),
        K0=torch.tensor([[[100.0, 2, 50], [0, 50, 40], [0, 0, 1]]]), K1=torch.eye(3)[None],
        mutual=torch.tensor([[False]]),
    ).replace(**changes)  # fmt: skip


def test_coordinates_by_size_and_by_the_inverse_of_K_and_side_information() -> None:
    c = one_match()
    x, mask = MatchInputs("size")(c)
    expected = [(10 - 100) / 200, (20 - 50) / 200, (30 - 50) / 400, (50 - 200) / 400]
    torch.testing.assert_close(x, torch.tensor(expected)[None, :, None])
    assert mask.all()
    ray = torch.linalg.inv(c.K0[0]) @ torch.tensor([10.0, 20, 1])
    by_calibration = torch.tensor([float(ray[0]), float(ray[1]), 30, 50])
    torch.testing.assert_close(MatchInputs("K")(c)[0][0, :, 0], by_calibration)
    inputs = MatchInputs("size", SIDE)
    x, _ = inputs(c)
    assert inputs.channels == x.shape[1] == 10
    expected = [0.7, -1, math.log(2), math.cos(math.radians(200)), math.sin(math.radians(200)), -1]
    torch.testing.assert_close(x[0, 4:, 0], torch.tensor(expected))


def test_what_is_not_known_is_zero() -> None:
    bare = one_match(lafs0=None, lafs1=None, ratio=None, mutual=None)
    assert not MatchInputs("size", SIDE)(bare)[0][:, 4:].any()
    flat = one_match(lafs0=torch.zeros(1, 1, 2, 3), ratio=torch.tensor([[torch.nan]]))
    assert torch.isfinite(MatchInputs("size", SIDE)(flat)[0]).all()


@pytest.mark.parametrize("coordinates", ["size", "K"])
def test_padding_is_zero_and_not_finite_matches_are_masked(coordinates: str) -> None:
    c = calibrated(scene(1, count=20))
    mask = c.mask.clone()
    mask[0, 15:] = False
    expected, _ = MatchInputs(coordinates, SIDE)(c.keep(mask).compact())
    garbage = {
        "x0": torch.where(mask[..., None], c.x0, torch.nan), "ratio": torch.where(mask, c.ratio, torch.inf),
        "lafs0": torch.where(mask[..., None, None], c.lafs0, torch.nan),
    }  # fmt: skip
    x, input_mask = MatchInputs(coordinates, SIDE)(c.replace(mask=mask, **garbage))
    assert torch.equal(x[..., :15], expected)
    assert not x[..., 15:].any()
    assert torch.equal(input_mask, mask)
    x, input_mask = MatchInputs(coordinates, SIDE)(c.replace(**garbage))
    assert torch.equal(input_mask, mask)
    assert torch.isfinite(x).all()


@pytest.mark.parametrize(("coordinates", "missing"), [("size", ("size0", "size1")), ("K", ("K1",))])
def test_what_is_missing_is_named(coordinates: str, missing: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=f"coordinates={coordinates} needs `{missing[0]}`"):
        MatchInputs(coordinates)(one_match(**dict.fromkeys(missing)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coordinates": "pixels"}, "coordinates=pixels; there are: size, K"),
        ({"side": ("ratio", "angle")}, "each at most once of ratio"),
        ({"side": ("ratio", "ratio")}, "each at most once of ratio"),
    ],
)
def test_unknown_options(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MatchInputs(**options)  # type: ignore[arg-type]
