"""LC against a published network's outputs; padding and neighbours."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from fmtorch.pruning.networks import LC
from fmtorch.pruning.networks.layers import Slots
from fmtorch.pruning.networks.published import ngransac_state
from fmtorch.types import Correspondences


def oracles():
    folder = os.environ.get("FMTORCH_TEST_DATA")
    folder = None if folder is None else Path(folder) / "oracles"
    if folder is None or not (folder / "ngransac_net.npz").is_file():
        pytest.skip("FMTORCH_TEST_DATA has no oracles/ngransac_net.npz")
    return folder


@pytest.mark.parametrize("model", ["F_r0.80", "F_rs_r0.80", "F_r1.00"])
def test_outputs_of_neural_guided_ransac(model):
    """The authors' weights give the authors' sampling probabilities: float32 against float64 differ by up to 2e-4."""
    with np.load(oracles() / f"weights_ngransac_{model}.npz") as file:
        weights = {key: torch.from_numpy(file[key]) for key in file.files}
    network = LC(side=["ratio"]).eval()
    network.load_state_dict(ngransac_state(weights))
    network.double()
    with np.load(oracles() / "ngransac_net.npz") as data:
        cases = [key[:3] for key in data.files if key.endswith(f".logprob_{model}")]
        assert len(cases) == 6
        for case in cases:
            names = ("X1", "X2", "ratio", "size1", "size2", "inp", f"logprob_{model}")
            x0, x1, ratio, size0, size1, inp, expected = (
                torch.from_numpy(data[f"{case}.{name}"])[None] for name in names
            )
            mask = torch.ones(x0.shape[:2], dtype=torch.bool)
            x, _ = network.inputs(Correspondences(x0, x1, mask, quality=ratio, size0=size0, size1=size1))
            torch.testing.assert_close(x.mT, inp, rtol=0, atol=1e-6)  # another order of rounding
            with torch.no_grad():
                logit = network.logit(x.double(), Slots.of(mask, torch.float64))
            log_probability = torch.nn.functional.logsigmoid(logit).log_softmax(1)
            torch.testing.assert_close(log_probability, expected.double(), rtol=0, atol=2e-4)
