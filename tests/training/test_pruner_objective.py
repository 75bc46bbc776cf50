"""What a pruner is trained for and validated by: terms that come in when they should, figures of known networks."""

from __future__ import annotations

import pytest
import torch
from torch import nn

pytest.importorskip("lightning", reason="training needs the extra `train`")

from fmtorch import presets
from fmtorch.core.types import Correspondences
from fmtorch.geometry import eight_point
from fmtorch.pruning.networks import LC
from fmtorch.pruning.networks.learned import Prediction, predict
from fmtorch.training import LabelledMatches, collate
from fmtorch.training.objective import Objective, classification_loss, fits, geometric_loss
from fmtorch.training.validation import Use, Validation
from tests.training.synthetic_matches import labelled_pair


def prediction(batch: LabelledMatches) -> Prediction:
    torch.manual_seed(0)
    return predict(LC(channels=8, blocks=1), batch.correspondences)


def test_geometric_terms_come_in_after_classification_alone() -> None:
    batch = collate([labelled_pair(i) for i in range(3)])
    objective = Objective(geometric=0.5, nsgd=0.25, classification_steps=10)
    made = prediction(batch)
    before, after = objective(made, batch, 9), objective(made, batch, 10)
    assert set(before) == {"classification", "loss"}
    assert torch.equal(before["loss"], before["classification"])
    total = after["classification"] + 0.5 * after["geometric"] + 0.25 * after["nsgd"]
    assert after["loss"].item() == pytest.approx(total.item(), rel=1e-6)


def test_terms_are_the_losses_of_the_weighted_fit() -> None:
    batch = collate([labelled_pair(i) for i in range(2)])
    c, made = batch.correspondences, prediction(batch)
    F, valid = fits(made, batch)
    own, _ = eight_point(c.x0.double(), c.x1.double(), made.weight[0].double(), c.mask)
    assert torch.equal(F[0], own)
    terms = Objective(classification_steps=0)(made, batch, 7)
    assert c.size0 is not None
    assert c.size1 is not None
    expected = geometric_loss(F, batch.F, c.size0, c.size1, valid=valid, points=100, seed=7, key=c.keys)
    assert float(terms["geometric"].detach()) == pytest.approx(float(expected.detach()))
    classification = classification_loss(made.logit, batch.label)
    assert float(terms["classification"].detach()) == pytest.approx(float(classification.detach()))


def test_a_pair_that_cannot_be_judged_adds_nothing() -> None:
    """Coincident points, unlabelled: the loss and gradients of the others are what they are without it."""
    good = labelled_pair(0)
    same = good.correspondences.replace(x0=torch.full_like(good.correspondences.x0, 9.0),
                                        x1=torch.full_like(good.correspondences.x1, 9.0))  # fmt: skip
    bad = LabelledMatches(same, torch.full_like(good.label, -1), torch.zeros_like(good.F))
    objective = Objective(nsgd=1.0, classification_steps=0)
    logits = [torch.zeros(1, n, good.label.shape[1], requires_grad=True) for n in (1, 2)]
    for logit, batch in zip(logits, (good, collate([good, bad])), strict=True):
        weight = torch.where(batch.correspondences.mask, torch.sigmoid(logit[0]), 0)[None]
        loss = objective(Prediction(logit, weight), batch, 0)["loss"]
        loss.backward()
    alone, together = (logit.grad for logit in logits)
    assert alone is not None
    assert together is not None
    assert bool(torch.isfinite(together).all())
    assert torch.allclose(together[:, :1], alone, rtol=1e-9)
    assert not bool(together[:, 1].any())


def test_options_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="must be one of: size, K"):
        Objective(coordinates="pixels")
    with pytest.raises(ValueError, match="at least one of"):
        Objective(classification=0.0, geometric=0.0)
    batch = labelled_pair(0)
    without = LabelledMatches(batch.correspondences.replace(K0=None, K1=None), batch.label, batch.F)
    with pytest.raises(ValueError, match="needs calibration matrices"):
        Objective(coordinates="K", classification_steps=0)(prediction(without), without, 0)


class Known(nn.Module):
    """Gives back log-odds that are known for each pair by its key."""

    def __init__(self, logit: dict[int, torch.Tensor]) -> None:
        super().__init__()
        self.logit = logit

    def forward(self, c: Correspondences) -> torch.Tensor:
        return self.logit[int(c.keys[0])]


def test_validation_tells_a_network_that_knows_from_one_that_does_not() -> None:
    pairs = [labelled_pair(i, outliers=0.7) for i in range(5)]
    uses = {"hard": Use(presets.build("estimator", "irls", loss="huber"), 0.5)}
    validation = Validation(pairs, uses, ["a", "a", "b", "b", "b"])
    right = {i: 8.0 * (2 * pair.label.float() - 1) for i, pair in enumerate(pairs)}
    wrong = {i: torch.full_like(value, 0.1) for i, value in right.items()}
    knows, not_ = (validation(Known(value)) for value in (right, wrong))
    assert knows.figures["hard/AUC@0.05"] > 0.9
    assert knows.figures["hard/AUC@0.05"] > not_.figures["hard/AUC@0.05"]
    assert knows.figures["match_precision"] == knows.figures["match_recall"] == 1.0
    assert not_.figures["match_recall"] == 1.0
    share = sum(float((pair.label == 1).sum()) for pair in pairs) / sum(pair.label.numel() for pair in pairs)
    assert not_.figures["match_precision"] == pytest.approx(share)
    assert {"hard/AUC@0.05/a", "hard/AUC@0.05/b", "log_loss", "calibration_error"} <= set(knows.figures)
    assert knows.figures["log_loss"] == pytest.approx(float(torch.nn.functional.softplus(torch.tensor(-8.0))), rel=1e-3)
    assert len(knows.label) == sum(pair.label.numel() for pair in pairs)


def test_validation_leaves_the_network_in_its_mode() -> None:
    network = LC(channels=8, blocks=1).train()
    before = {key: value.clone() for key, value in network.state_dict().items()}
    Validation([labelled_pair(0)], {})(network)
    assert network.training
    assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())
    with pytest.raises(ValueError, match="at least one pair"):
        Validation([], {})
