"""Losses, figures and the loop of patch networks."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.features.networks import AffNet, AffNetFast, HardNet, build, load_weights
from fmtorch.scenes.textures import photograph
from fmtorch.training.correspondences import Tolerance, corresponding_patches
from fmtorch.training.model_card import model_card, sha256
from fmtorch.training.patch_loop import PatchTraining, TrainingOptions
from fmtorch.training.patch_losses import hard_negative_constant, hardest_triplet, relative_distance
from fmtorch.training.patch_metrics import fpr_at_recall, middle, patch_quality, validation_pairs
from fmtorch.training.patch_objectives import (
    DRAWS,
    CovarianceObjective,
    DescriptorObjective,
    ShapeObjective,
    sample,
    shape_matrix,
)
from fmtorch.training.patch_store import PatchStore
from fmtorch.training.warps import ViewRange
from tests.reference import patch_losses as reference


def unit(n: int, d: int, seed: int, noise: float = 0.3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(n, d, generator=generator, dtype=torch.float64)
    b = a + noise * torch.randn(n, d, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(a, dim=1), torch.nn.functional.normalize(b, dim=1)


@pytest.mark.parametrize("squared", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_hardest_triplet_is_its_definition(seed: int, squared: bool) -> None:
    a, b = unit(12, 4, seed)
    b[3] = a[7]  # the same patch twice is no negative
    expected = reference.hardest_triplet(a.tolist(), b.tolist(), 1.0, squared)
    assert float(hardest_triplet(a, b, squared=squared)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_relative_distance_is_its_definition(seed: int) -> None:
    a, b = unit(10, 5, seed)
    expected = reference.relative_distance(a.tolist(), b.tolist(), 0.7)
    assert float(relative_distance(a, b, compactness=0.7)) == pytest.approx(expected, abs=1e-6)


def test_the_negative_of_the_shape_loss_is_a_constant() -> None:
    a, b = unit(8, 4, 0, noise=1.0)
    a.requires_grad_()
    loss = hard_negative_constant(a, b)
    assert float(loss.detach()) == pytest.approx(float(hardest_triplet(a, b).detach()))
    active = ((1 + (a - b).norm(dim=1)) > 0).double()
    (gradient,) = torch.autograd.grad(loss, a)
    direction = (a - b) / (a - b).norm(dim=1, keepdim=True) * active[:, None] / 8
    tangent = direction - a * (direction * a).sum(1, keepdim=True)
    mine = gradient - a * (gradient * a).sum(1, keepdim=True)  # the loss knows unit vectors only
    torch.testing.assert_close(mine, tangent.detach(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("loss", [hardest_triplet, hard_negative_constant, relative_distance])
def test_coincident_descriptors_have_finite_gradients(loss: object) -> None:
    a = torch.nn.functional.normalize(torch.ones(4, 3), dim=1).requires_grad_()
    loss(a, a).backward()  # type: ignore[operator]
    assert torch.isfinite(a.grad).all()


@pytest.mark.parametrize("seed", range(3))
def test_figures_are_their_definitions(seed: int) -> None:
    a, b = unit(40, 3, seed, noise=0.5)
    found = patch_quality(a, b)
    positive = [reference.distance(x, y) for x, y in zip(a.tolist(), b.tolist(), strict=True)]
    negative = [reference.distance(x, y) for x, y in zip(a.tolist(), b.roll(1, 0).tolist(), strict=True)]
    assert found["fpr95"] == pytest.approx(reference.fpr_at_recall(positive, negative, 0.95))
    assert found["map"] == pytest.approx(reference.mean_average_precision(a.tolist(), b.tolist()))
    assert found["map"] >= found["accuracy"]


def test_fpr_at_recall_by_hand() -> None:
    positive = torch.arange(1, 21.0)  # 95 % of 20 are 19
    negative = torch.tensor([0.5, 19.0, 19.5, 30.0])
    assert fpr_at_recall(positive, negative) == 0.5
    assert patch_quality(*(torch.eye(5),) * 2) == {"fpr95": 0.0, "map": 1.0, "accuracy": 1.0}


@pytest.fixture(scope="module")
def store() -> PatchStore:
    patches, point = corresponding_patches(
        photograph("chelsea.png"), np.random.default_rng(0), views=5, points=150, limits=ViewRange(),
        tolerance=Tolerance(),
    )  # fmt: skip
    first = np.r_[0, np.cumsum(np.bincount(point))]
    return PatchStore(patches, first, {"photographs": {"scikit-image": 1}, "points": len(first) - 1,
                                       "patches": len(patches), "views": 5, "limits": {}})  # fmt: skip


OPTIONS = TrainingOptions(
    batch=24, steps=30, learning_rate=3e-3, bf16=False, checkpoint_steps=1000, log_steps=10, seed=3
)


def training(store: PatchStore, options: TrainingOptions = OPTIONS) -> PatchTraining:
    torch.manual_seed(0)
    description = {"architecture": "hardnet", "loss": {"name": "hardest_triplet"}}
    return PatchTraining(HardNet(dropout=0.3), DescriptorObjective(hardest_triplet), store, options, description)


def test_the_loss_falls(store: PatchStore) -> None:
    run = training(store)
    run.run()
    assert run.step == 30
    assert sum(run.losses[-5:]) < 0.9 * sum(run.losses[:5])
    assert run.optimizer.param_groups[0]["lr"] == pytest.approx(3e-3 / 30)  # linearly to zero


def test_a_resumed_run_is_the_uninterrupted_run(store: PatchStore, tmp_path: Path) -> None:
    whole = training(store)
    whole.run(until=8)
    first = training(store)
    first.run(until=3, checkpoint=tmp_path / "run.pt")
    second = training(store)
    second.resume(tmp_path / "run.pt")
    assert second.step == 3
    torch.manual_seed(99)  # what else draws random numbers does not matter
    second.run(until=8)
    assert second.losses == whole.losses
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, second.network.state_dict()[name]), name
    assert [p.name for p in tmp_path.iterdir()] == ["run.pt"]


def test_a_checkpoint_of_other_options_is_refused(store: PatchStore, tmp_path: Path) -> None:
    training(store).save(tmp_path / "run.pt")
    other = TrainingOptions(**{**OPTIONS.__dict__, "batch": 16, "seed": 4, "steps": 60})
    with pytest.raises(ValueError, match="trained with other batch, seed"):
        training(store, other).resume(tmp_path / "run.pt")
    with pytest.raises(ValueError, match="batch=100000 is more than"):
        training(store, TrainingOptions(batch=100000))
    with pytest.raises(ValueError, match="optimizer=lion; there are: adam, sgd"):
        training(store, TrainingOptions(batch=4, optimizer="lion"))


def test_minutes_end_a_run(store: PatchStore) -> None:
    run = training(store, TrainingOptions(batch=4, minutes=1e-9, bf16=False))
    run.run()
    assert run.step == 1


def test_a_diverging_run_stops(store: PatchStore) -> None:
    options = TrainingOptions(batch=4, steps=3, bf16=False)
    run = PatchTraining(HardNet(), DescriptorObjective(lambda a, b: (a - b).sum() / 0.0), store, options)
    with pytest.raises(FloatingPointError, match="lower the learning rate"):
        run.run()


def test_a_checkpoint_gives_the_network_and_its_card(store: PatchStore, tmp_path: Path) -> None:
    run = training(store)
    run.run(until=2)
    figures = {"fpr95": 0.0123, "map": 0.91, "accuracy": 0.89}
    run.save(tmp_path / "hardnet.pt", validation={"untrained": figures, "trained": figures})
    network = build("hardnet").eval()
    content = load_weights(network, tmp_path / "hardnet.pt")
    x = middle(validation_pairs(store, 10)[0])
    torch.testing.assert_close(network(x), run.network.eval()(x))
    (tmp_path / "hardnet.onnx").write_bytes(b"as if")
    card = model_card(tmp_path / "hardnet.onnx", "hardnet", "fp32", content, figures)
    for part in (
        sha256(tmp_path / "hardnet.onnx"),
        "2 steps of 24 points",
        "1 of scikit-image",
        "| trained | 1.23 | 91.00",
    ):
        assert part in card
    other = model_card(tmp_path / "hardnet.onnx", "affnet", "int8", {**content, "loss": {"name": "affine_covariance"}})
    assert "own, not AffNet's" in other
    assert "own, not" not in card


def test_a_teacher_adds_the_distance_to_its_descriptors(store: PatchStore) -> None:
    torch.manual_seed(0)
    network, teacher = HardNet(dropout=0.0).eval(), HardNet().eval().requires_grad_(False)
    pairs, draws = validation_pairs(store, 12), torch.full((12, DRAWS), 0.9)  # neither mirrored nor turned
    plain = DescriptorObjective(hardest_triplet).loss(network, pairs, draws)
    itself = DescriptorObjective(hardest_triplet, network, weight=2.0).loss(network, pairs, draws)
    torch.testing.assert_close(itself, plain)
    taught = DescriptorObjective(hardest_triplet, teacher, weight=2.0).loss(network, pairs, draws)
    patches = middle(pairs).flatten(0, 1)
    apart = (network(patches) - teacher(patches)).square().sum(1).mean()
    torch.testing.assert_close(taught, plain + 2 * apart)


def test_a_teacher_adds_the_departure_from_its_shapes(store: PatchStore) -> None:
    torch.manual_seed(0)
    network, draws = AffNetFast(dropout=0.0).eval(), torch.rand(12, DRAWS)
    pairs = validation_pairs(store, 12)
    plain = CovarianceObjective().loss(network, pairs, draws)
    itself = CovarianceObjective(teacher=network, weight=2.0).loss(network, pairs, draws)
    torch.testing.assert_close(itself, plain, atol=1e-6, rtol=0)

    def stretching(patches: Tensor) -> Tensor:
        """The network's shapes, stretched by 1.2 in x and by 1 / 1.2 in y."""
        x = network(patches)
        return torch.stack([1.2 * (1 + x[:, 0]) - 1, x[:, 1] / 1.2, (1 + x[:, 2]) / 1.2 - 1], 1)

    taught = CovarianceObjective(teacher=stretching, weight=2.0).loss(network, pairs, draws)
    # (S A)^-1 A with S the stretch: at least S's own singular values are left
    assert float((taught - plain).detach()) > 2 * math.log((1.44 + 1 / 1.44) / 2) - 1e-5


def stretched(store: PatchStore, matrix: Tensor) -> tuple[Tensor, Tensor]:
    patches = validation_pairs(store, 20)[0]
    return patches, sample(patches, matrix.expand(len(patches), 2, 2))


def test_sampling_through_the_identity_is_the_middle_and_a_turn_is_a_turn(store: PatchStore) -> None:
    patches, seen = stretched(store, torch.eye(2))
    torch.testing.assert_close(seen, middle(patches), atol=1e-5, rtol=0)
    _, turned = stretched(store, torch.tensor([[0.0, -1], [1, 0]]))  # the patch's x axis shows what was y
    torch.testing.assert_close(turned, middle(patches).rot90(1, (2, 3)), atol=1e-4, rtol=0)


def test_shapes_have_determinant_one_and_zero_is_a_circle() -> None:
    x = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8
    matrix = shape_matrix(x)
    torch.testing.assert_close(torch.linalg.det(matrix), torch.ones(50), atol=1e-5, rtol=0)
    assert (matrix[:, 0, 1] == 0).all()
    torch.testing.assert_close(shape_matrix(torch.zeros(1, 3))[0], torch.eye(2))


def test_a_shape_that_undoes_the_stretch_lowers_the_loss(store: PatchStore) -> None:
    class Known(torch.nn.Module):
        """Answers with fixed shapes."""

        def forward(self, patches: Tensor) -> Tensor:
            return self.answer

    known, objective = Known(), ShapeObjective(HardNet().eval(), tilt=2.0)
    pairs = validation_pairs(store, 40)[:1].expand(2, -1, -1, -1, -1)  # the same patch twice, stretched apart
    draws = torch.zeros(40, DRAWS)
    draws[:, 1] = 1.0  # the first is stretched twofold along x, the second not at all
    stretch, n = 2**0.5, 40
    known.answer = torch.tensor([[1 / stretch - 1, 0, stretch - 1]]).repeat(n, 1)
    known.answer = torch.cat([known.answer, torch.zeros(n, 3)])
    undone = objective.loss(known, pairs, draws).detach()
    known.answer = torch.zeros(2 * n, 3)
    circles = objective.loss(known, pairs, draws).detach()
    with torch.no_grad():
        a, b = objective._described(known, pairs, draws, rectify=False)
    assert float((a - b).norm(dim=1).mean()) > 0.1
    assert float(undone) < float(circles) - 0.05


def test_shape_training_moves_the_network_and_not_the_descriptor(store: PatchStore) -> None:
    descriptor = HardNet().eval().requires_grad_(False)
    before = {k: v.clone() for k, v in descriptor.state_dict().items()}
    torch.manual_seed(0)
    network = AffNet()
    start = {k: v.clone() for k, v in network.state_dict().items()}
    run = PatchTraining(network, ShapeObjective(descriptor), store, TrainingOptions(batch=16, steps=3, bf16=False))
    run.run()
    assert all(torch.equal(v, before[k]) for k, v in descriptor.state_dict().items())
    assert all(not torch.equal(v, start[k]) for k, v in network.named_parameters())
    assert set(run.objective.evaluate(network.eval(), validation_pairs(store, 30))) >= {"map", "circle_map"}


def test_covariant_shapes_have_no_loss_and_constant_ones_do() -> None:
    class SecondMoment(torch.nn.Module):
        """Shapes from the second moments of a white disc that was stretched: covariant by construction."""

        def forward(self, patches: Tensor) -> Tensor:
            u = (torch.arange(32) + 0.5) / 16 - 1
            grid = torch.stack(torch.meshgrid(u, u, indexing="xy"), -1).flatten(0, 1)
            weight = patches.flatten(1)
            moment = torch.einsum("np,pi,pj->nij", weight / weight.sum(1, keepdim=True), grid, grid)
            A = torch.linalg.cholesky(moment)  # lower triangular, A A^T is the moment
            A = A / torch.linalg.det(A).sqrt()[:, None, None]
            return torch.stack([A[:, 0, 0] - 1, A[:, 1, 0], A[:, 1, 1] - 1], -1)

    class Circle(torch.nn.Module):
        def forward(self, patches: Tensor) -> Tensor:
            return torch.zeros(len(patches), 3)

    u = (torch.arange(64) + 0.5) / 16 - 2
    disc = (u[:, None] ** 2 + u[None] ** 2 < 0.35**2).float()
    pairs = disc.expand(2, 30, 1, 64, 64)
    draws = torch.rand(30, DRAWS, generator=torch.Generator().manual_seed(0))
    objective = CovarianceObjective(tilt=1.8)
    covariant, constant = (float(objective.loss(f, pairs, draws)) for f in (SecondMoment(), Circle()))
    assert covariant < constant / 5
    figures = objective.evaluate(SecondMoment(), pairs)
    assert figures["residual_tilt"] < 1.1 < figures["circle_residual_tilt"]
    draws = torch.zeros(1, DRAWS)
    draws[0, 1] = 1.0  # T1 stretches 1.8 times, T2 not at all
    found = float(objective.loss(Circle(), pairs[:, :1], draws))
    assert found == pytest.approx(np.log((1.8 + 1 / 1.8) / 2), abs=1e-5)
