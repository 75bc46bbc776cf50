"""Training of patch networks: patches, losses, figures, the loop and the command; their files in the layout that ONNX
Runtime runs fastest: the same outputs."""

import itertools
import multiprocessing.dummy
import pickle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from PIL import Image
from scipy.spatial.distance import cdist
from torch import Tensor, nn

from fmtorch.core import conf_dir, models_dir
from fmtorch.features import PatchNetwork
from fmtorch.features.networks import ARCHITECTURES, GeoDesc, HardNet, build
from fmtorch.scenes import photograph
from fmtorch.training import Photograph, PlaneViews, list_photographs, plane_homography, random_camera
from scripts.patch_networks import objectives, stores
from scripts.patch_networks.objectives import geodesc, geometric, hardest_triplet, structured
from scripts.patch_networks.onnx_export import export, laid_out, quantize
from scripts.patch_networks.stores import tracks
from scripts.patch_networks.train import PatchTraining, TrainingOptions, cutting_of, training_of
from tests.features.test_networks import randomized
from tests.reference import geodesc as geodesc_reference

PLANES = PlaneViews(views=4, tilt=15.0, scale=(0.5, 0.6))


@pytest.fixture
def in_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photographs are cut by threads in place of processes, which take seconds to start."""
    monkeypatch.setattr(stores, "multiprocessing", SimpleNamespace(get_context=lambda _: multiprocessing.dummy))


@pytest.fixture(scope="module")
def store() -> stores.PatchStore:
    """Patches of a photograph as a plane, with their geometry."""
    views = stores.views_of(photograph("chelsea.png"), np.random.default_rng(0), PLANES, points=150)
    patches, point, *geometry = tracks(views, stores.Tolerance())
    first = np.r_[0, np.cumsum(np.bincount(point))]
    about = {"photographs": {"scikit-image": 1}, "points": len(first) - 1, "patches": len(patches), "views": 4}
    return stores.PatchStore(patches, first, *geometry, {**about, "limits": {}})


def test_figures_of_known_answers() -> None:
    # By hand: 95 % of 20 are 19.
    assert objectives.fpr_at_recall(torch.arange(1, 21.0), torch.tensor([0.5, 19.0, 19.5, 30.0])) == 0.5
    assert objectives.patch_quality(*(torch.eye(5),) * 2) == {"fpr95": 0.0, "map": 1.0, "accuracy": 1.0}


OPTIONS: dict[str, Any] = {"batch": 24, "steps": 30, "bf16": False, "checkpoint_steps": 1000, "seed": 3}


def training(store: stores.PatchStore, **options: Any) -> PatchTraining:
    torch.manual_seed(0)
    made = TrainingOptions(**{**OPTIONS, **options})
    description = {"architecture": "hardnet", "loss": {"name": "hardest_triplet"}}
    objective = objectives.DescriptorObjective(objectives.hardest_triplet)
    return PatchTraining(HardNet(dropout=0.3), objective, store, made, description)


def set_training(store: stores.PatchStore, batch: int = 32) -> PatchTraining:
    torch.manual_seed(0)
    options = TrainingOptions(**{**OPTIONS, "batch": batch, "learning_rate": 3e-4})
    description = {"architecture": "geodesc", "loss": {"name": "geodesc"}, "match_sets": {"matches": 16}}
    objective, sets = objectives.DescriptorObjective(objectives.geodesc), stores.match_sets(store, 16, 1.0)
    return PatchTraining(GeoDesc(), objective, store, options, description, sets=sets, matches=16)


@pytest.mark.parametrize("make", [training, set_training])
def test_a_resumed_run_is_the_uninterrupted_run(make, store, tmp_path):
    whole, first, second = make(store), make(store), make(store)
    whole.run(until=4)
    first.run(until=2, checkpoint=tmp_path / "run.pt")
    second.resume(tmp_path / "run.pt")
    assert second.step == 2
    torch.manual_seed(99)  # what else draws random numbers does not matter
    second.run(until=4)
    assert second.losses == whole.losses
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, second.network.state_dict()[name]), name
    assert [p.name for p in tmp_path.iterdir()] == ["run.pt"]
    second.description["match_sets"] = {"matches": 8}
    with pytest.raises(ValueError, match="was trained with other match_sets"):
        second.resume(tmp_path / "run.pt")


def test_a_checkpoint_of_other_options_is_refused(store: stores.PatchStore, tmp_path: Path) -> None:
    training(store).save(tmp_path / "run.pt")
    with pytest.raises(ValueError, match="trained with other batch, seed"):
        training(store, batch=16, seed=4, steps=60).resume(tmp_path / "run.pt")
    with pytest.raises(ValueError, match="batch=100000 is more than"):
        training(store, batch=100000)
    with pytest.raises(ValueError, match=r"batch=40 must be a multiple of match_sets\.matches=16"):
        set_training(store, batch=40)
    with pytest.raises(ValueError, match=r"batch=3200 is more than the \d sets of 16 matches"):
        set_training(store, batch=3200)


def config(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(conf_dir()), version_base=None):
        return compose("train_patch_network", overrides=["training=geodesc", "images=.", *overrides])


@pytest.mark.usefixtures("in_threads")
def test_photographs_become_tracks_and_a_step_of_training(tmp_path: Path) -> None:
    training = config().training
    assert training.match_sets == {"matches": 64, "max_similarity": 0.85}
    assert training.loss == {"name": "geodesc", "ratio": 0.4, "geometric_weight": 0.2}
    small = [
        "patches.points=80", "patches.planes.views=3", "patches.planes.tilt=10", "patches.longest_side=300",
        "training.options.batch=16", "training.match_sets.matches=8", "training.match_sets.max_similarity=1.0",
    ]  # fmt: skip
    made = config(*small)
    store = stores.build_store(tmp_path / "tracks", stores.package_photographs()[:2], cutting_of(made), seed=0)
    assert store.description["views"] == 3
    network, cpu = build("geodesc"), torch.device("cpu")
    run = training_of(made, network, store, {"architecture": "geodesc"}, cpu)
    assert run.description["match_sets"] == {"matches": 8, "max_similarity": 1.0}
    run.run(until=1)
    assert len(run.losses) == 1
    with pytest.raises(ValueError, match=r"training\.match_sets needs training\.loss\.name=geodesc"):
        training_of(config(*small, "training.loss.name=hardest_triplet"), network, store, {}, cpu)


@pytest.mark.usefixtures("in_threads")
def test_an_unreadable_photograph_leaves_no_store(tmp_path: Path) -> None:
    (tmp_path / "bad.jpg").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"bad\.jpg") as refused:
        stores.build_store(tmp_path / "s", [Photograph(tmp_path / "bad.jpg", "x")], stores.Cutting(PLANES, 10), seed=0)
    assert str(pickle.loads(pickle.dumps(refused.value))) == str(refused.value)  # as it comes from a process
    assert [p.name for p in tmp_path.iterdir()] == ["bad.jpg"]
    with pytest.raises(FileNotFoundError, match="holds no patches"):
        stores.PatchStore.open(tmp_path / "s")


def test_photographs_are_split_by_source(tmp_path: Path) -> None:
    for name in ("a/1.jpg", "a/2.png", "b/3.jpg", "4.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.new("L", (4, 4)).save(tmp_path / name)
    found = list_photographs(tmp_path)
    assert sorted((p.path.name, p.source) for p in found) == [
        ("1.jpg", "a"), ("2.png", "a"), ("3.jpg", "b"), ("4.jpg", "4.jpg"),
    ]  # fmt: skip
    train, validation = stores.split(found, ["a"])
    assert {p.source for p in train} == {"b", "4.jpg"}
    assert {p.path.name for p in validation} == {"1.jpg", "2.png"}
    with pytest.raises(ValueError, match=r"held_out names c; the sources are 4\.jpg, a, b"):
        stores.split(found, ["c"])
    with pytest.raises(ValueError, match="both sides"):
        stores.split(found, ["a", "b", "4.jpg"])


def test_keypoints_are_where_the_plane_puts_them_under_its_angles() -> None:
    """A small circle about a keypoint, of the radius and the orientation that it has there, projects onto it."""
    size, rng = (240, 320), np.random.default_rng(0)
    camera = random_camera(rng, size, PlaneViews(views=2, tilt=40.0))
    H = plane_homography(camera, size)
    keypoints = np.c_[rng.uniform(60, 160, (50, 2)), np.full(50, 1e-3), rng.uniform(-3, 3, 50)]
    there = stores.in_photograph(keypoints, H)

    def seen(place: np.ndarray) -> np.ndarray:
        """In the view; the photograph's longest side is 1, its centre the origin."""
        world = np.c_[(place - [159.5, 119.5]) / 320, np.zeros(len(place))]
        return camera.project(world)[0]

    np.testing.assert_allclose(seen(there[:, :2]), keypoints[:, :2], atol=1e-8)
    J = np.stack([seen(there[:, :2] + 1e-3 * axis) - keypoints[:, :2] for axis in np.eye(2)], -1) / 1e-3
    x, y = np.einsum("nij,jn->in", J, [np.cos(there[:, 3]), np.sin(there[:, 3])])
    np.testing.assert_allclose(np.exp(1j * (np.arctan2(y, x) - keypoints[:, 3])), 1, atol=1e-3)
    np.testing.assert_allclose(there[:, 2] * np.sqrt(np.abs(np.linalg.det(J))), keypoints[:, 2], rtol=1e-3)
    rays, incidence = stores.rays_and_incidence(keypoints, camera)
    world = np.c_[(there[:, :2] - [159.5, 119.5]) / 320, np.zeros(50)]
    np.testing.assert_allclose(rays * np.linalg.norm(camera.centre - world, axis=1)[:, None], camera.centre - world)
    np.testing.assert_allclose(np.cos(np.radians(incidence)), -rays[:, 2])


def test_tracks_show_the_same_point(store: stores.PatchStore) -> None:
    """By the median correlation of two patches of a point, and of patches of different points."""
    flat = store.patches[:, 16:48, 16:48].reshape(len(store.patches), -1).astype(float)
    flat = (flat - flat.mean(1, keepdims=True)) / (flat.std(1, keepdims=True) + 1e-6)
    a, b = flat[store.first[:-1]], flat[store.first[:-1] + 1]
    assert np.median((a * b).mean(1)) > 0.6 > 0.3 > np.median((a * np.roll(b, 1, 0)).mean(1))


def unit(n: int, d: int, seed: int, noise: float = 0.3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(n, d, generator=generator, dtype=torch.float64)
    b = a + noise * torch.randn(n, d, generator=generator, dtype=torch.float64)
    return nn.functional.normalize(a, dim=1), nn.functional.normalize(b, dim=1)


def sets_of(sets: int, n: int, d: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Unit descriptors of match sets, alike within noise, and random S_patch."""
    a, b = unit(sets * n, d, seed, noise=1.0)
    similarity = torch.rand(sets, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return a.reshape(sets, n, d), b.reshape(sets, n, d), similarity


def test_losses_are_their_definitions() -> None:
    a, b = unit(12, 4, 0)
    b[3] = a[7]  # the same patch twice is no negative
    # Mishchuk et al., NIPS 2017, section 3.1: the hardest negative of a_i among b and of b_i among a
    distances = cdist(a, b)
    others = np.where(np.eye(12, dtype=bool) | (distances < 0.008), np.inf, distances)
    hinges = np.maximum(0, 1 + distances.diagonal() - np.minimum(others.min(0), others.min(1)))
    assert float(hardest_triplet(a, b)) == pytest.approx(hinges.mean(), abs=1e-9)


def test_the_loss_of_match_sets_is_its_definition() -> None:
    a, b, similarity = sets_of(3, 9, 4, 0)
    sets = list(zip(a.tolist(), b.tolist(), similarity.tolist(), strict=True))
    first = sum(geodesc_reference.structured(x, y, 0.3) for x, y, _ in sets) / 3
    second = sum(geodesc_reference.geometric(x, y, s) for x, y, s in sets) / 3
    assert min(first, second) > 0.02
    assert float(structured(a, b, ratio=0.3)) == pytest.approx(first, abs=1e-12)
    assert float(geometric(a, b, similarity)) == pytest.approx(second, abs=1e-12)
    assert float(geodesc(a, b, similarity, ratio=0.3, geometric_weight=0.2)) == pytest.approx(first + 0.2 * second)
    alone = [float(geodesc(a[i : i + 1], b[i : i + 1], similarity[i : i + 1])) for i in range(3)]
    assert float(geodesc(a, b, similarity)) == pytest.approx(sum(alone) / 3)  # sets do not see each other
    a, b, similarity = sets_of(2, 5, 3, 0)
    assert torch.autograd.gradcheck(lambda x, y: geodesc(x, y, similarity), (a.requires_grad_(), b.requires_grad_()))


def random_tracks(seed: int) -> tuple[stores.PatchStore, dict[tuple[int, int], float]]:
    """Points in up to five views, and S_patch of every two patches of a point."""
    rng = np.random.default_rng(seed)
    first, views, names = [0], [], []
    for point in range(60):
        shown = rng.permutation(5)[: rng.integers(2, 6)]
        views += shown.tolist()
        names += [1000 * int(v) + point for v in shown]
        first.append(len(views))
    rays = rng.normal(size=(len(views), 3)) * 0.2 + [0, 0, 1]
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    incidence = np.degrees(np.arccos(rays[:, 2])).astype(np.float32)  # of a surface that faces z
    similarity = {}
    for begin, end in itertools.pairwise(first):
        for i, j in itertools.combinations(range(begin, end), 2):
            seen = geodesc_reference.patch_similarity((0, 0, 0), (0, 0, 1), rays[i].tolist(), rays[j].tolist())
            similarity[names[i], names[j]] = seen
    patches = np.zeros((len(views), 1, 1), np.uint8)
    return stores.PatchStore(patches, np.array(first), np.array(views), rays, incidence, {}), similarity


def test_match_sets_are_their_definition() -> None:
    tracks, similarity = random_tracks(0)
    names = 1000 * tracks.view + np.repeat(np.arange(60), np.diff(tracks.first))
    everything = stores.match_sets(tracks, 2, 1.0)
    assert len(everything) == 10
    limit = float(np.median(np.add.reduceat(everything.similarity, everything.first[:-1]) / np.diff(everything.first)))
    sets, expected = stores.match_sets(tracks, 15, limit), geodesc_reference.match_sets(similarity, 15, limit)
    assert 0 < len(sets) < len(everything)
    assert len(sets) == len(expected)
    for a, b in itertools.pairwise(sets.first):
        patches = names[sets.patches[:, a:b]]
        members, image = expected[patches[0, 0] // 1000, patches[1, 0] // 1000]
        assert sorted(zip(*patches.tolist(), strict=True)) == members
        assert sets.similarity[a:b].mean() == pytest.approx(image)
    with pytest.raises(ValueError, match=r"shares 500 points .* at most 0\.85: lower match_sets\.matches"):
        stores.match_sets(tracks, 500)


NAMES = [name for name in ARCHITECTURES if name != "orinet"]
SHIPPED = [(name, f"{name}{precision}.onnx") for name in NAMES for precision in ("", ".int8")]


@pytest.fixture(scope="module")
def patches() -> Tensor:
    """Noise, ramps, a constant patch and one of extreme values."""
    generator = torch.Generator().manual_seed(3)
    noise = torch.rand(40, 1, 32, 32, generator=generator)
    ramp = torch.linspace(0, 1, 32).expand(1, 1, 32, 32)
    extreme = (torch.rand(20, 1, 32, 32, generator=generator) > 0.5).float()
    return torch.cat([noise, ramp, ramp.transpose(2, 3), torch.full((1, 1, 32, 32), 0.5), extreme])


@pytest.fixture
def exact_int8(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums of int8 products in 32 bits on every processor.

    Without VNNI, ONNX Runtime otherwise adds them in pairs in 16 bits, where they saturate; which are pairs depends on
    the layout."""

    class Exact(onnxruntime.SessionOptions):  # type: ignore[misc, unused-ignore]
        def __init__(self) -> None:
            super().__init__()
            self.add_session_config_entry("session.x64quantprecision", "1")

    monkeypatch.setattr(onnxruntime, "SessionOptions", Exact)


def exported(name: str, folder: Path, patches: Tensor) -> tuple[Path, Path]:
    """A network of random weights in fp32, which is torch's, and int8, as torch and the quantisation lay them out."""
    fp32, int8, network = folder / "fp32.onnx", folder / "int8.onnx", randomized(build(name))
    if name == "l2net":
        network.pixel_mean.copy_(patches.mean(0, keepdim=True))
    export(network, fp32)
    torch.testing.assert_close(PatchNetwork(fp32, batch=40)(patches), network(patches).detach(), atol=1e-4, rtol=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scripts.patch_networks.onnx_export.lay_out", lambda path: None)
        quantize(fp32, int8, patches)
    return fp32, int8


@pytest.mark.usefixtures("exact_int8")
@pytest.mark.parametrize("name", ["l2net", "affnet"])  # one that ends in a normalisation, one in Tanh
def test_the_outputs_are_the_same(name: str, tmp_path: Path, patches: Tensor) -> None:
    for path, atol in zip(exported(name, tmp_path, patches), (1e-5, 0.0), strict=True):
        model = onnx.load(path)
        onnx.save(laid_out(model, 32), tmp_path / "laid_out.onnx")
        assert model == onnx.load(path)  # what was given is not changed
        for batch in (1, 64):
            expected = PatchNetwork(path, batch=batch)(patches)
            found = PatchNetwork(tmp_path / "laid_out.onnx", batch=batch)(patches)
            assert float(expected.nan_to_num().std()) > 0
            torch.testing.assert_close(found, expected, atol=atol, rtol=0, equal_nan=True)  # L2-Net of constant patches


@pytest.mark.parametrize(("name", "file"), SHIPPED)
def test_shipped_networks_are_laid_out(name: str, file: str) -> None:
    convolutions = sum(isinstance(layer, torch.nn.Conv2d) for layer in build(name).modules())
    operators = [node.op_type for node in onnx.load(models_dir() / file).graph.node]
    assert (operators.count("Gemm"), operators.count("Conv")) == (1, convolutions - 1)
