"""The losses of pruners and their objective: known answers, scalar references, gradients, degenerate pairs."""

import functools
import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from fmtorch import presets, training
from fmtorch.core import Correspondences
from fmtorch.jit.random import Stream, uniform
from fmtorch.pruning import LC
from fmtorch.pruning.networks import Prediction, predict
from fmtorch.training import run
from fmtorch.training.objective import LIMIT_E, LIMIT_F, TRIES
from tests.metrics.test_nsgd import random_pairs, rows_shifted
from tests.reference import pruner_losses as reference
from tests.training.conftest import labelled_pair

VGA = torch.tensor([480, 640])


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def sizes(*batch: int) -> tuple[Tensor, Tensor]:
    return VGA.expand(*batch, 2), VGA.flip(0).expand(*batch, 2)


def labels(seed: int, b: int, n: int) -> Tensor:
    return torch.randint(-1, 2, (b, n), generator=generator(seed), dtype=torch.int8)


def test_classification_is_the_mean_over_matches_then_pairs_then_stages() -> None:
    logit = 3 * torch.randn(2, 5, 40, generator=generator(0), dtype=torch.float64)
    label = labels(1, 5, 40)
    label[1], label[2], label[3, :20] = -1, 1, -1
    p = torch.where(label == 1, torch.sigmoid(logit), 1 - torch.sigmoid(logit))
    stages = torch.where(label < 0, torch.nan, -p.log()).nanmean(-1).nanmean(-1)  # a pair without labels is none
    assert training.classification_loss(logit, label).item() == pytest.approx(stages.mean().item(), rel=1e-12)
    assert training.classification_loss(logit[0], label).item() == pytest.approx(stages[0].item(), rel=1e-12)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000))
def test_ignored_and_masked_matches_are_invisible(seed: int) -> None:
    logit = torch.randn(3, 20, generator=generator(seed), dtype=torch.float64).requires_grad_()
    label = labels(seed, 3, 20)
    loss = training.classification_loss(logit, label)
    (gradient,) = torch.autograd.grad(loss, logit)
    ignored = label < 0
    assert bool((gradient[ignored] == 0).all())
    garbage = torch.where(ignored, torch.nan, logit.detach())
    padded = torch.nn.functional.pad(garbage, (0, 9), value=torch.inf).requires_grad_()
    other = training.classification_loss(padded, torch.nn.functional.pad(label, (0, 9), value=-1))
    torch.testing.assert_close(other, loss)  # exp has other last bits at other places in memory
    (padded_gradient,) = torch.autograd.grad(other, padded)
    torch.testing.assert_close(padded_gradient[:, :20], gradient)
    assert bool((padded_gradient[:, 20:] == 0).all())


def test_classification_of_degenerate_pairs() -> None:
    """No labels, one class, huge logits: finite; a batch without labels gives zero, attached to the graph."""
    logit = torch.tensor([[0.3, -2.0], [1.0, 1.0], [80.0, -1e4], [1e30, -1e30]]).requires_grad_()
    label = torch.tensor([[-1, -1], [1, 1], [0, 1], [1, 0]], dtype=torch.int8)
    loss = training.classification_loss(logit, label)
    (gradient,) = torch.autograd.grad(loss, logit)
    assert bool(loss.isfinite())
    assert bool(gradient.isfinite().all())
    assert float(gradient.abs().max()) <= 1
    assert bool((gradient[0] == 0).all())
    assert bool((gradient[1] < 0).all())
    nothing = training.classification_loss(logit, torch.full_like(label, -1))
    assert nothing.item() == 0
    assert bool((torch.autograd.grad(nothing, logit)[0] == 0).all())
    assert training.classification_loss(logit.half().clamp(-1e4, 1e4), label).dtype == torch.float32


K = torch.tensor([[500.0, 1.0, 310.0], [0.0, 520.0, 250.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.mark.parametrize("calibrated", [False, True])
def test_geometric_loss_matches_scalar_reference(calibrated: bool) -> None:
    F_true, F_est = random_pairs(2, 3, spread=0.2)
    (size0, size1), key, limit = sizes(3), torch.arange(3), LIMIT_E if calibrated else LIMIT_F
    known = {"K0": K.expand(3, 3, 3), "K1": K.expand(3, 3, 3)} if calibrated else {}
    both = torch.stack([F_est, F_true])
    found = training.geometric_loss(both, F_true, size0, size1, points=25, seed=4, key=key, **known)
    uniforms = uniform(4, key, Stream.TRAINING, 0, TRIES * 25, 3).numpy()
    values, clamped = [], 0
    for i in range(3):
        s0, s1 = size0[i].numpy(), size1[i].numpy()
        points = reference.virtual_points(F_true[i].numpy(), s0, s1, uniforms[i], 25)
        A0, A1 = (K.numpy(), K.numpy()) if calibrated else (reference.by_size(s0), reference.by_size(s1))
        values.append(reference.geometric_loss(F_est[i].numpy(), points, A0, A1, limit))
        clamped += values[-1] != reference.geometric_loss(F_est[i].numpy(), points, A0, A1, 1e9)
    assert clamped  # or the limit would not be tested
    # Two stages: the estimates, and the truth, which is exact up to rounding: squares of 1e-13.
    assert found.item() == pytest.approx(sum(values) / 3 / 2, rel=1e-9)
    with pytest.raises(ValueError, match="K0 and K1"):
        training.geometric_loss(F_est, F_true, size0, size1, K0=K.expand(3, 3, 3))


def test_nsgd_loss_known_answer() -> None:
    F_true, F_est, size = rows_shifted(0.0)[None], rows_shifted(8.0)[None], VGA.expand(1, 2)
    assert training.nsgd_loss(F_est, F_true, size, size).item() == pytest.approx(8 / 800, rel=1e-9)
    assert training.nsgd_loss(F_est, F_true, size, size, limit=0.001).item() == 0.001


def test_losses_of_the_estimate_pass_gradcheck() -> None:
    """On an image of a few pixels, so that finite differences suit all elements of F; no limit, which has a kink."""
    F_true, F_est = (torch.randn(2, 3, 3, generator=generator(s), dtype=torch.float64) for s in (2, 5))
    size = torch.tensor([[3, 4]]).expand(2, 2)
    geometric = functools.partial(training.geometric_loss, points=6, limit=1e9)
    for loss in (geometric, functools.partial(training.nsgd_loss, samples=6)):

        def of_estimate(F: Tensor, loss: functools.partial[Tensor] = loss) -> Tensor:
            return loss(F, F_true, size, size)

        assert torch.autograd.gradcheck(of_estimate, [F_est.clone().requires_grad_()], eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("loss", [training.geometric_loss, training.nsgd_loss])
def test_failed_fits_add_nothing(loss: Callable[..., Tensor]) -> None:
    """Estimates that are zero, not finite, of rank 1, or whose lines miss the image; truths that are not known."""
    (F_true, F_est), (size0, size1), key = random_pairs(6, 8), sizes(8), torch.arange(8)
    F_est[1], F_est[2], F_est[3, 0, 0] = torch.nan, 0.0, torch.inf
    F_est[4] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    F_est[5] = rows_shifted(1e5)
    F_true[6], F_true[7] = torch.nan, 0.0
    F_est.requires_grad_()
    value = loss(F_est, F_true, size0, size1, key=key)
    assert bool(value.isfinite())
    (gradient,) = torch.autograd.grad(value, F_est)
    assert bool(gradient.isfinite().all())
    assert bool((gradient[[1, 2, 3, 6, 7]] == 0).all())
    assert float(gradient[0].abs().max()) > 0
    # Three estimates count: those of the pairs 0, 4 and 5. With `valid` only the first.
    valid = torch.zeros(8, dtype=torch.bool)
    valid[:4] = True
    alone = loss(F_est[:1], F_true[:1], size0[:1], size1[:1], key=key[:1])
    assert torch.equal(loss(F_est, F_true, size0, size1, key=key, valid=valid), alone)
    (its_gradient,) = torch.autograd.grad(alone, F_est)
    torch.testing.assert_close(gradient[0] * 3, its_gradient[0], rtol=1e-9, atol=0)
    nothing = loss(F_est, F_true, size0, size1, key=key, valid=valid & False)
    assert nothing.item() == 0
    assert bool((torch.autograd.grad(nothing, F_est)[0] == 0).all())


def prediction(batch: training.LabelledMatches) -> Prediction:
    torch.manual_seed(0)
    return predict(LC(channels=8, blocks=1), batch.correspondences)


def test_geometric_terms_come_in_after_classification_alone() -> None:
    batch = training.collate([labelled_pair(i) for i in range(3)])
    objective = training.Objective(geometric=0.5, nsgd=0.25, classification_steps=10)
    made = prediction(batch)
    before, after = objective(made, batch, 9), objective(made, batch, 10)
    assert set(before) == {"classification", "loss"}
    assert torch.equal(before["loss"], before["classification"])
    total = after["classification"] + 0.5 * after["geometric"] + 0.25 * after["nsgd"]
    assert after["loss"].item() == pytest.approx(total.item(), rel=1e-6)


def test_a_pair_that_cannot_be_judged_adds_nothing() -> None:
    """Coincident points, unlabelled: the loss and gradients of the others are what they are without it."""
    good = labelled_pair(0)
    same = good.correspondences.replace(x0=torch.full_like(good.correspondences.x0, 9.0),
                                        x1=torch.full_like(good.correspondences.x1, 9.0))  # fmt: skip
    bad = training.LabelledMatches(same, torch.full_like(good.label, -1), torch.zeros_like(good.F))
    objective = training.Objective(nsgd=1.0, classification_steps=0)
    logits = [torch.zeros(1, n, good.label.shape[1], requires_grad=True) for n in (1, 2)]
    for logit, batch in zip(logits, (good, training.collate([good, bad])), strict=True):
        weight = torch.where(batch.correspondences.mask, torch.sigmoid(logit[0]), 0)[None]
        objective(Prediction(logit, weight), batch, 0)["loss"].backward()
    alone, together = (logit.grad for logit in logits)
    assert bool(torch.isfinite(together).all())
    assert torch.allclose(together[:, :1], alone, rtol=1e-9)
    assert not bool(together[:, 1].any())


def test_matches_that_a_stage_does_not_judge_are_as_unlabelled() -> None:
    batch, draws = labelled_pair(0), generator(0)
    logit = torch.randn(2, *batch.label.shape, generator=draws)
    judged = torch.rand(logit.shape, generator=draws) < 0.5
    loss = training.Objective(geometric=0)(Prediction(logit, logit[:1].relu(), judged=judged), batch, 0)["loss"]
    labels = [torch.where(j, batch.label, -1) for j in judged]
    parts = [training.classification_loss(z, label) for z, label in zip(logit, labels, strict=True)]
    assert loss.item() == pytest.approx(sum(float(part) for part in parts) / 2, rel=1e-6)


def test_options_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one of"):
        training.Objective(classification=0.0, geometric=0.0)
    batch = labelled_pair(0)
    without = training.LabelledMatches(batch.correspondences.replace(K0=None, K1=None), batch.label, batch.F)
    with pytest.raises(ValueError, match="needs calibration matrices"):
        training.Objective(coordinates="K", classification_steps=0)(prediction(without), without, 0)


class Known(nn.Module):
    """Gives back log-odds that are known for each pair by its key."""

    def __init__(self, logit: dict[int, torch.Tensor]) -> None:
        super().__init__()
        self.logit = logit

    def forward(self, c: Correspondences) -> torch.Tensor:
        return self.logit[int(c.keys[0])]


def test_validation_tells_a_network_that_knows_from_one_that_does_not() -> None:
    pairs = [labelled_pair(i, outliers=0.7) for i in range(5)]
    uses = {"hard": training.Use(presets.build("estimator", "irls", loss="huber"), 0.5)}
    validation = training.Validation(pairs, uses, ["a", "a", "b", "b", "b"])
    right = {int(pair.correspondences.keys[0]): 8.0 * (2 * pair.label.float() - 1) for pair in pairs}
    wrong = {i: torch.full_like(value, 0.1) for i, value in right.items()}
    knows, not_ = (validation(Known(value)) for value in (right, wrong))
    assert knows.figures["hard/AUC@0.05"] > max(0.9, not_.figures["hard/AUC@0.05"])
    assert knows.figures["match_precision"] == knows.figures["match_recall"] == not_.figures["match_recall"] == 1.0
    share = sum(float((pair.label == 1).sum()) for pair in pairs) / sum(pair.label.numel() for pair in pairs)
    assert not_.figures["match_precision"] == pytest.approx(share)
    assert {"hard/AUC@0.05/a", "hard/AUC@0.05/b", "log_loss", "calibration_error"} <= set(knows.figures)
    assert not any(run.expect_figure(figure, uses) for figure in knows.figures)
    assert knows.figures["log_loss"] == pytest.approx(float(torch.nn.functional.softplus(torch.tensor(-8.0))), rel=1e-3)
    assert len(knows.label) == sum(pair.label.numel() for pair in pairs)


def test_validation_leaves_the_network_in_its_mode() -> None:
    network = LC(channels=8, blocks=1).train()
    before = {key: value.clone() for key, value in network.state_dict().items()}
    training.Validation([labelled_pair(0)], {})(network)
    assert network.training
    assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())
    with pytest.raises(ValueError, match="at least one pair"):
        training.Validation([], {})


@settings(max_examples=20, deadline=None)
@given(true=st.floats(0.05, 20), seed=st.integers(0, 100))
def test_temperature_minimises_the_loss(true: float, seed: int) -> None:
    """No other temperature is better; logits scaled by s have s times the temperature; calibrated ones about 1."""
    z = 2 * torch.randn(20, 200, generator=generator(seed), dtype=torch.float64)
    label = (torch.rand(20, 200, generator=generator(seed + 1), dtype=torch.float64) < torch.sigmoid(z)).to(torch.int8)
    label[:, 150:] = -1
    found = training.temperature(z * true, label)
    assert found == pytest.approx(true * training.temperature(z, label), rel=1e-9)
    # 3,000 matches of logits of variance 4: Fisher information E[p (1 - p) z^2] is some 0.35 each.
    assert found / true == pytest.approx(1, abs=4.5 / math.sqrt(0.35 * 3000))

    def loss(t: float) -> float:
        kept = label >= 0
        cross_entropy = torch.nn.functional.binary_cross_entropy_with_logits
        return cross_entropy((z * true / t)[kept], label[kept].double()).item()

    assert loss(found) <= min(loss(found * 1.01), loss(found / 1.01))


def test_temperature_of_degenerate_validation() -> None:
    z = torch.tensor([2.0, -1.0, 0.5])
    one = torch.ones(3, dtype=torch.int8)
    assert (training.temperature(z, -one), training.temperature(z * 0, one)) == (1, 1)
    right, wrong = (training.temperature(z, label.to(torch.int8)) for label in (z > 0, z < 0))  # the bounds
    assert right < 0.1
    assert right * wrong == pytest.approx(1)


def test_reliability() -> None:
    p = torch.rand(500, generator=generator(0), dtype=torch.float64)
    p[0], p[1] = 1.0, 0.0
    label = labels(1, 1, 500)[0]
    table = training.reliability(p, label)
    kept = label >= 0
    gaps = torch.bincount((10 * p[kept]).long().clamp(max=9), p[kept] - label[kept]).abs()  # Naeini et al., AAAI 2015
    assert table.error == pytest.approx(float(gaps.sum()) / int(kept.sum()), rel=1e-12)
    assert int(table.matches.sum()) == int(kept.sum())
    share, right = torch.tensor([0.25] * 4 + [0.875] * 8), torch.tensor([1, 0, 0, 0, 0] + [1] * 7)
    exact = training.reliability(share, right.to(torch.int8))
    assert (exact.error, exact.observed[[2, 8]].tolist()) == (0, [0.25, 0.875])
    assert bool(exact.predicted[[0, 1, 9]].isnan().all())
    assert math.isnan(training.reliability(p, torch.full_like(label, -1)).error)
