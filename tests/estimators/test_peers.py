"""Other libraries behind our call: their results in our conventions, failures as data, a prior that orders matches."""

import sys
import types
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import find_essential, geometry, metrics, presets
from fmtorch.core import Correspondences, collate
from fmtorch.estimators import PairwiseEstimator, Solution
from fmtorch.two_view.known_cameras import KnownCameras
from tests.geometry.scenes import scene as matched_scene
from tests.laws import PEERS, scene
from tests.variants import OTHER_LIBRARIES, built, variants


@pytest.mark.parametrize("name", [n for n in variants("estimator") if n.startswith(OTHER_LIBRARIES)])
def test_recovers_the_geometry_in_a_batch(name: str) -> None:
    if name in PEERS:
        pytest.importorskip(PEERS[name])
    pairs = [scene(0, 300, outliers=0.3, noise=0.1), scene(1, 5), scene(2, 200, outliers=0.2, noise=0.1)]
    batch = collate(pairs)
    options = {"rounds": 2} if name == "kornia_ransac" else {}
    estimate = built("estimator", name, **options)(batch)
    assert estimate.ok.tolist() == [True, False, True]
    assert "5 matches" in estimate.reason[1]
    for i in (0, 2):
        clean = scene(i, pairs[i].mask.shape[1], outliers=0.0, noise=0.0)
        distance = geometry.sampson(estimate.F[i : i + 1], clean.x0.double(), clean.x1.double())
        assert float(distance.median()) < 0.5
        assert int(estimate.inliers[i].sum()) >= 0.5 * len(distance[0])
        assert not bool((estimate.inliers[i] & ~batch.mask[i]).any())


@pytest.mark.parametrize("name", PEERS)
def test_a_missing_library_is_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, PEERS[name], None)
    extra = "colmap" if name.startswith("colmap") else "peers"
    with pytest.raises(ImportError, match=rf"{PEERS[name]}.*fmtorch\[{extra}\]"):
        built("estimator", name)


@pytest.mark.parametrize("name", ["poselib", "poselib:shared_focal=true"])
def test_poselib_gets_the_options_that_are_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[np.ndarray, dict[str, object], dict[str, object]]] = []

    def fake_solver(x0: np.ndarray, x1: np.ndarray, *rest: object) -> None:
        seen.append((x0, *rest[-2:]))
        raise RuntimeError("enough")

    known = types.SimpleNamespace(
        RansacOptions=lambda: {"real_focal_check": False}, estimate_fundamental=fake_solver,
        estimate_shared_focal_relative_pose=fake_solver,
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "poselib", known)
    c = scene(0, 40)
    named = {"threshold": 0.5, "iterations": 500, "prosac": True, "loss": "huber", "loss_scale": 0.3}
    built("estimator", name, **named)(c, 7)
    x0, options, refinement = seen.pop()
    expected = {"max_epipolar_error": 0.5, "success_prob": 0.9999, "max_iterations": 500, "min_iterations": 500}
    assert options == expected | {"progressive_sampling": True, "seed": 7}
    assert refinement == {"loss_type": "HUBER", "loss_scale": 0.3}
    with pytest.raises(ValueError, match="loss is 'l3'; it must be one of: trivial, truncated"):
        built("estimator", name, loss="l3")
    if name == "poselib:shared_focal=true":
        with pytest.raises(ValueError, match="real_focal_check is of fundamental matrices alone"):
            built("estimator", name, real_focal_check=True)
    else:
        built("estimator", name, real_focal_check=True, prosac=True)(c)
        centred, options, _ = seen.pop()
        assert options["real_focal_check"] is True
        assert np.allclose(x0 - centred, [(c.size0[0, 1] - 1) / 2, (c.size0[0, 0] - 1) / 2])
        monkeypatch.setattr(known, "RansacOptions", dict)
        with pytest.raises(ValueError, match="no real_focal_check"):
            built("estimator", name, real_focal_check=True)


def test_poselib_estimates_the_pose_of_exactly_known_cameras() -> None:
    """Its own pose, sign included; roughly known focal lengths leave a fundamental matrix."""
    poselib = pytest.importorskip("poselib")
    s = matched_scene(300, 1, noise=0.1)
    K = s.K0.numpy(), s.K1.numpy()
    size = [(round(2 * float(k[1, 2]) + 1), round(2 * float(k[0, 2]) + 1)) for k in K]
    cameras = [
        {"model": "PINHOLE", "width": w, "height": h, "params": [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]}
        for k, (h, w) in zip(K, size, strict=True)
    ]
    options = {"max_epipolar_error": 1.0, "max_iterations": 10000, "min_iterations": 1000, "success_prob": 0.9999}
    pose, info = poselib.estimate_relative_pose(s.x0.numpy(), s.x1.numpy(), *cameras, {**options, "seed": 3}, {})
    estimate = find_essential(s.x0, s.x1, s.K0, s.K1, estimator="poselib", seed=3)
    # pixels are mapped to those of a central principal point: 1e-13 px, times the condition of the fit
    assert estimate.R[0].numpy() == pytest.approx(pose.R, abs=1e-6)
    assert estimate.t[0].numpy() == pytest.approx(pose.t / np.linalg.norm(pose.t), abs=1e-6)
    assert int(estimate.inliers.sum()) == info["num_inliers"]


def test_roughly_known_cameras_are_not_exact_for_peers() -> None:
    given: list[Any] = []

    def solve(pair: Any) -> Solution:
        given.append(pair)
        return None, np.zeros(len(pair.x0), np.bool_)

    s, find = matched_scene(40, 1), KnownCameras(PairwiseEstimator("It", solve))
    c = Correspondences(s.x0[None], s.x1[None], torch.ones(1, 40, dtype=torch.bool), K0=s.K0[None], K1=s.K1[None])
    for deviation in (0.0, 0.05, np.inf):
        find(c.replace(focal=torch.tensor([[[1.0, deviation], [1.0, deviation]]], dtype=torch.float64)), 3)
    exact, rough, unknown = given
    f = [float(torch.sqrt(K[0, 0] * K[1, 1])) for K in (s.K0, s.K1)]
    assert [K[0, 0] for K in exact.exact] == pytest.approx(f)
    assert rough.exact is None
    assert unknown.calibrations == (None, None)


def test_superansac_does_the_same_at_every_call() -> None:
    """Its binding changes the settings that it is given."""
    pytest.importorskip("pysuperansac")
    estimator, c = presets.build("estimator", "superansac_cpp"), scene(0, 200, outliers=0.2, noise=0.1)
    first, *others = (estimator(c).inliers for _ in range(3))
    assert first.sum() > 100
    assert all(torch.equal(first, other) for other in others)


@pytest.mark.parametrize(
    ("name", "part", "choices"),
    [
        ("superansac_cpp", "sampler", "uniform, prosac, importance"),
        ("superansac_cpp", "score", "ransac, msac, magsac"),
        ("magsac_cpp", "sampler", "uniform, prosac, progressive_napsac"),
        ("gc_ransac_cpp", "sampler", "uniform, prosac, progressive_napsac"),
    ],
)
def test_unknown_parts_are_refused_with_the_choices(name: str, part: str, choices: str) -> None:
    with pytest.raises(ValueError, match=f"{part} is 'x'; it must be one of: {choices}"):
        built("estimator", name, **{part: "x"})


@pytest.mark.parametrize("flags", [0, 1])
def test_inliers_of_gc_ransac_follow_from_its_matrix(flags: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its binding returns flags that are all set, or none, whatever the matrix."""
    c = scene(0, 40)
    truth = presets.build("estimator", "lmeds")(c).F[0].numpy()

    def fake_solver(matches: np.ndarray, *_: object) -> tuple[np.ndarray, np.ndarray]:
        return truth, np.full(len(matches), bool(flags))

    monkeypatch.setitem(sys.modules, "pygcransac", types.SimpleNamespace(findFundamentalMatrix=fake_solver))
    estimate = presets.build("estimator", "gc_ransac_cpp", threshold=2.0)(c)
    near = geometry.sampson(torch.from_numpy(truth), c.x0[0].double(), c.x1[0].double()) <= 2
    assert estimate.ok.all()
    assert torch.equal(estimate.inliers[0], near & c.mask[0])
    assert 8 <= near.sum() < c.mask.sum()


def test_the_prior_orders_matches_before_the_quality() -> None:
    seen: list[Any] = []

    def solve(pair: Any) -> Solution:
        seen.append(pair)
        return None, torch.zeros(len(pair.x0), dtype=torch.bool).numpy()

    c = scene(0, 40)
    estimator = PairwiseEstimator("probe", solve, best_first=True)
    estimate = estimator(c)
    estimator(c.replace(prior=None))
    assert estimate.reason == ("probe found no fundamental matrix",)
    for pair in seen:
        assert (pair.likelihood[:-1] >= pair.likelihood[1:]).all()
    assert torch.equal(torch.from_numpy(seen[0].likelihood), c.prior[0].double().sort(descending=True).values)
    assert seen[0].size0 == (640, 960)


def test_what_another_library_raises_becomes_the_pairs_reason() -> None:
    def solve(pair: Any) -> Solution:
        if len(pair.x0) == 20:
            raise cv2.error("(-215:Assertion failed)\n!model.empty()")
        return np.eye(3), np.ones(len(pair.x0), bool)

    estimate = PairwiseEstimator("It", solve)(collate([scene(0, 20), scene(1, 30)]))
    assert estimate.ok.tolist() == [False, True]
    assert estimate.reason == ("It failed: (-215:Assertion failed) !model.empty()", "")
    assert not estimate.F[0].any()
    assert not estimate.inliers[0].any()


@pytest.mark.parametrize("name", ["degensac_cpp", "gc_ransac_cpp", "magsac_cpp"])
def test_a_binding_gets_whole_numbers_that_it_takes(name: str) -> None:
    """Seeds of 64 bits are welcome; points beyond its integers are a pair's failure, and never the batch's."""
    pytest.importorskip(PEERS[name])
    good = scene(0, 300, outliers=0.3, noise=0.1)
    huge = good.replace(x0=1e12 * good.x0.double(), x1=1e12 * good.x1.double(), size0=None, size1=None)
    for seed in (2**31, -(2**40)):
        estimate = built("estimator", name)(collate([good.replace(size0=None, size1=None), huge]), seed)
        assert bool(estimate.ok[0])
        assert estimate.reason[1] == "" or "pybind" not in estimate.reason[1]
    with pytest.raises(ValueError, match="must be a whole number from 1 to 2147483647"):
        built("estimator", name, iterations=2**31)


@pytest.mark.slow  # its kernels are compiled for minutes
def test_fastpose_estimates_what_is_asked_for() -> None:
    """Poses of exactly known cameras, one or two unknown focal lengths, and homographies."""
    pytest.importorskip("fastpose")
    s = matched_scene(300, 1, noise=0.1)
    posed = find_essential(s.x0, s.x1, s.K0, s.K1, estimator="fastpose", seed=3)
    assert posed.R[0].numpy() == pytest.approx(s.R.numpy(), abs=2e-3)
    assert posed.t[0].numpy() == pytest.approx(s.t.numpy() / np.linalg.norm(s.t.numpy()), abs=2e-2)
    sizes = [torch.tensor([round(2 * float(k[1, 2]) + 1), round(2 * float(k[0, 2]) + 1)]) for k in (s.K0, s.K1)]
    given = {"size0": sizes[0], "size1": sizes[1], "focal": "unknown", "estimator": "fastpose"}
    unknown = fmtorch.find_fundamental(s.x0, s.x1, **given, seed=3)
    expected = [float(s.K0[0, 0]), float(s.K1[0, 0])]
    assert unknown.focals[0].numpy() == pytest.approx(expected, rel=0.15)  # by its solver alone, without a prior
    x0 = np.random.default_rng(0).uniform(0, 800, (60, 2))
    H = np.array([[0.9, 0.1, 20], [-0.05, 1.1, -10], [1e-5, 2e-5, 1]])
    x1 = np.c_[x0, np.ones(60)] @ H.T
    plane = fmtorch.find_homography(x0, x1[:, :2] / x1[:, 2:], estimator="fastpose", model="homography")
    assert (plane.H[0] / plane.H[0, 2, 2]).numpy() == pytest.approx(H, abs=1e-6)
    with pytest.raises(ValueError, match="focal=shared is of fundamental matrices"):
        presets.build("estimator", "fastpose", model="homography", focal="shared")


def calibrated_pair(seed: int, outliers: int) -> tuple[Correspondences, np.ndarray, np.ndarray]:
    """A pair of known cameras in whose P(inlier) outliers have a tenth, and its rays (n, 2) of both images."""
    s = matched_scene(100, seed, noise=0.2)
    x1 = torch.cat([s.x1[:outliers].roll(1, 0), s.x1[outliers:]])
    prior = torch.where(torch.arange(100) < outliers, 0.1, torch.linspace(0.6, 0.99, 100))
    mask, size = torch.ones(1, 100, dtype=torch.bool), torch.tensor([[801, 1001]])
    c = Correspondences(
        s.x0[None], x1[None], mask, prior=prior[None], size0=size, size1=size, K0=s.K0[None], K1=s.K1[None],
        focal=torch.tensor([[[1.0, 0.0], [1.0, 0.0]]], dtype=torch.float64),
    )  # fmt: skip
    rays = [((x - K[:2, 2]) / K.diagonal()[:2]).numpy() for x, K in ((s.x0, s.K0), (x1, s.K1))]
    return c, rays[0], rays[1]


def test_the_weighted_eight_point_algorithm_is_oanets() -> None:
    """OANet's weighted_8points: X^T diag(relu(tanh(logit))) X, whose last eigenvector is E."""
    c, rays0, rays1 = calibrated_pair(3, outliers=40)
    estimate = KnownCameras(presets.build("estimator", "weighted_eight_point"))(c)
    p = c.prior[0].double().numpy()
    weight = np.maximum(np.tanh(np.log(p / (1 - p))), 0)
    (a, b), (u, v) = rays0.T, rays1.T
    X = np.stack([u * a, u * b, u, v * a, v * b, v, a, b, np.ones(100)], 1)
    E = np.linalg.svd(X.T @ np.diag(weight) @ X)[2][-1].reshape(3, 3)
    F = np.linalg.inv(c.K1[0].numpy()).T @ E @ np.linalg.inv(c.K0[0].numpy())
    F /= np.linalg.norm(F)
    assert min(np.abs(sign * estimate.F[0].numpy() - F).max() for sign in (1, -1)) < 1e-7
    assert estimate.inliers[0].tolist() == [False] * 40 + [True] * 60
    s = matched_scene(100, 3, noise=0.2)
    error = metrics.pose_error(estimate.R, estimate.t, s.R[None].double(), s.t[None].double())
    assert float(error.worst) < 3
    every = KnownCameras(presets.build("estimator", "weighted_eight_point", best=1.0))(c)
    assert torch.equal(every.F, estimate.F)


def test_opencvs_essential_matrix_is_that_of_its_own_call() -> None:
    c, rays0, rays1 = calibrated_pair(4, outliers=30)
    estimate = KnownCameras(presets.build("estimator", "opencv_essential"))(c)
    E, mask = cv2.findEssentialMat(rays0, rays1, np.eye(3), cv2.RANSAC, 0.999, 0.001)
    _, R, t, _ = cv2.recoverPose(E, rays0, rays1, mask=mask.copy())
    np.testing.assert_allclose(estimate.R[0], R, atol=1e-3)
    np.testing.assert_allclose(estimate.t[0], t[:, 0], atol=1e-2)
    assert np.abs(estimate.inliers[0].numpy() ^ (mask[:, 0] > 0)).sum() <= 3
    unknown = presets.build("estimator", "opencv_essential")(c.replace(focal=None, K0=None, K1=None))
    assert unknown.R is None
    assert bool(unknown.ok)
