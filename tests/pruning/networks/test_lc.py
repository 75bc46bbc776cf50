"""LC against a published network's outputs; padding and neighbours."""

import pytest
import torch

from fmtorch.pruning.networks import LC
from fmtorch.pruning.networks.layers import Slots
from fmtorch.pruning.networks.published import ngransac_state
from fmtorch.types import Correspondences
from tests.conftest import oracle


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
        x, _ = network.inputs(Correspondences(x0, x1, mask, quality=ratio, size0=size0, size1=size1))
        torch.testing.assert_close(x[0].mT, data[f"{case}.inp"], rtol=0, atol=1e-6)  # another order of rounding
        with torch.no_grad():
            logit = network.backbone(x.double(), Slots.of(mask, torch.float64))[0, 0]
        log_probability = torch.nn.functional.logsigmoid(logit).log_softmax(0)
        torch.testing.assert_close(log_probability, data[f"{case}.logprob_{model}"].double(), rtol=0, atol=2e-4)
