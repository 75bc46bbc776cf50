"""DFE: its fits, what it sees of them, padding, degenerate pairs."""

import torch

from fmtorch.pruning.networks.architectures import masked_softmax


def test_weights_of_no_match_are_zero() -> None:
    logit = torch.tensor([[1.0, 2.0], [3.0, 4.0]], requires_grad=True)
    weight = masked_softmax(logit, torch.tensor([[False, False], [True, False]]))
    assert weight.tolist() == [[0, 0], [1, 0]]
    weight.square().sum().backward()
    assert torch.isfinite(logit.grad).all()  # type: ignore[arg-type]
