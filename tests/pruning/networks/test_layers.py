"""Masked normalisation against its definition; padding and gradients."""

import pytest
import torch

from fmtorch.core import collate
from fmtorch.pruning import DFE, LC
from fmtorch.pruning.networks.layers import ContextBatchNormReLU, ResidualBlock, Slots
from tests.laws import scene
from tests.reference.pruner_losses import context_batch_norm_relu


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
    for a, b in zip(
        torch.autograd.grad(fast, inputs, upstream), torch.autograd.grad(slow, inputs, upstream), strict=True
    ):
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


@pytest.mark.parametrize("network", [LC(side=["ratio"], blocks=4), DFE(side=["ratio"], widths=(16, 32, 8))])
def test_padding_and_neighbours_change_a_networks_values_by_rounding_alone(network):
    """At inference; NaN in masked slots. `LearnedPruner` has the same bits."""
    counts, network = (60, 1, 100, 30), network.eval()
    c = collate([scene(i, count=n) for i, n in enumerate(counts)])
    with torch.no_grad():
        together = network(c.replace(x1=torch.where(c.mask[..., None], c.x1, torch.nan)))
        for i, n in enumerate(counts):
            alone = network(scene(i, count=n))
            torch.testing.assert_close(together.logit[:, i, :n], alone.logit[:, 0], rtol=1e-4, atol=1e-4)
            torch.testing.assert_close(together.weight[:, i, :n], alone.weight[:, 0], rtol=1e-3, atol=1e-4)
            assert not together.weight[:, i, n:].any()
    assert torch.isfinite(together.logit).all()
