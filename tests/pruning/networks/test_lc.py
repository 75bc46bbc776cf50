"""LC against a published network's outputs; padding and neighbours."""

import pytest
import torch

from fmtorch.core import Correspondences, collate
from fmtorch.pruning import DFE, LC
from fmtorch.pruning.networks.layers import Slots
from scripts.make_models import ngransac_state
from tests.conftest import oracle
from tests.laws import scene


@pytest.mark.parametrize("model", ["F_r0.80", "F_rs_r0.80", "F_r1.00"])
def test_outputs_of_neural_guided_ransac(model: str) -> None:
    """The authors' weights give the authors' sampling probabilities: float32 against float64 differ by up to 2e-4."""
    weights = {key: torch.from_numpy(value) for key, value in oracle(f"weights_ngransac_{model}.npz").items()}
    network = LC(side=["ratio"]).eval()
    network.load_state_dict(ngransac_state(weights))
    network.double()
    data = {key: torch.from_numpy(value) for key, value in oracle("ngransac_net.npz").items() if key != "names"}
    cases = [key[:3] for key in data if key.endswith(f".logprob_{model}")]
    assert len(cases) == 6
    for case in cases:
        x0, x1, ratio, size0, size1 = (data[f"{case}.{name}"][None] for name in ("X1", "X2", "ratio", "size1", "size2"))
        mask = torch.ones(x0.shape[:2], dtype=torch.bool)
        x, _ = network.inputs(Correspondences(x0, x1, mask, ratio=ratio, size0=size0, size1=size1))
        torch.testing.assert_close(x[0].mT, data[f"{case}.inp"], rtol=0, atol=1e-6)  # another order of rounding
        with torch.no_grad():
            logit = network.backbone(x.double(), Slots.of(mask, torch.float64))[0, 0]
        log_probability = torch.nn.functional.logsigmoid(logit).log_softmax(0)
        torch.testing.assert_close(log_probability, data[f"{case}.logprob_{model}"].double(), rtol=0, atol=2e-4)


def matches(counts: tuple[int, ...]) -> Correspondences:
    """Pairs of several lengths with NaN in their padding."""
    c = collate([scene(i, count=n) for i, n in enumerate(counts)])
    return c.replace(x1=torch.where(c.mask[..., None], c.x1, torch.nan))


def test_weights_are_those_published() -> None:
    torch.manual_seed(7)
    network, c = LC(side=["ratio"], blocks=2, channels=16).eval(), matches((60, 30))
    logit, weight, F = network(c)
    expected = torch.where(c.mask, torch.tanh(logit[0].clamp_min(0)), 0)
    assert (expected > 0).any()
    assert (expected[c.mask] == 0).any()
    assert torch.equal(weight[0], expected)
    assert F is None


@pytest.mark.parametrize("network", [LC(side=["ratio"], blocks=2), DFE(side=["ratio"], widths=(32, 16))])
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
