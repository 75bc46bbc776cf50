"""Estimates of known, half-known and unknown cameras: one posterior, its poses, focal lengths and gradients."""

import functools
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import fmtorch
from fmtorch import presets
from fmtorch.core import Correspondences, Estimate, collate
from fmtorch.data import ImagePair, load
from fmtorch.estimators import inliers, refinement
from fmtorch.geometry import cameras as square_pixels
from fmtorch.geometry import fundamental_from_calibration
from fmtorch.metrics import pose_error
from fmtorch.pipeline import Pipeline
from fmtorch.two_view.arguments import camera_fields
from fmtorch.two_view.known_cameras import KnownCameras
from tests.conftest import shared_path
from tests.laws import calibrated, degenerate, quick, scene, scenes, small, with_knowledge
from tests.reference import known_cameras as reference
from tests.reference import solvers
from tests.reference.focal import calibration

CAMERAS = {"K0": torch.from_numpy(reference.K0), "K1": torch.from_numpy(reference.K1)}
SIZES = {"size0": reference.SIZE, "size1": reference.SIZE}
CENTRAL, ZOOMED = (tuple(calibration(f / 640, (480, 640)) for f in focals) for focals in ((650, 650), (650, 820)))
VARIABLES = ("x0", "x1", "prior", "noise", "K0", "K1")
INF = float("inf")
K = torch.from_numpy(reference.K0)
SCENE = reference.scene(0)


def error(e: Estimate, s: reference.Scene) -> float:
    return reference.pose_error(e.R[0].numpy(), e.t[0].numpy(), s)


@pytest.fixture
def converging(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refinement, "FOCAL_ITERATIONS", 60)
    monkeypatch.setattr(refinement, "FOCAL_TOLERANCE", 0.0)


@pytest.mark.usefixtures("converging")
@pytest.mark.parametrize("estimator", ["fmtorch", "msac"])
@pytest.mark.parametrize("sizes", [{}, SIZES], ids=["sizes unknown", "sizes known"])
def test_exact_matches_give_the_exact_pose(estimator: str, sizes: dict[str, Any]) -> None:
    for seed in range(4):
        s = reference.scene(seed)
        e = fmtorch.find_essential(s.x0, s.x1, **CAMERAS, **sizes, estimator=estimator)
        assert error(e, s) < 1e-6
        F = reference.fundamental(s.R, s.t)
        assert min(float(np.abs(e.F[0].numpy() - sign * F).max()) for sign in (-1, 1)) < 1e-6
        np.testing.assert_allclose(e.focals[0], [np.sqrt(500 * 520), np.sqrt(600 * 590)], rtol=1e-6)
        assert int(e.inliers[0].numpy()[s.right].sum()) == s.right.sum()


@pytest.mark.usefixtures("converging")
def test_calibrated_cameras_need_six_matches() -> None:
    for seed in range(8):
        s = reference.scene(seed)
        x0, x1 = s.x0[s.right], s.x1[s.right]
        e = fmtorch.find_essential(x0[:6], x1[:6], **CAMERAS, **SIZES)
        assert error(e, s) < 1e-6
        five = fmtorch.find_essential(x0[:5], x1[:5], **CAMERAS, **SIZES)
        assert (bool(five.ok[0]), five.reason[0]) == (False, "5 matches; at least 6 are needed")
    fewer = fmtorch.find_essential(x0[:6], x1[:6], **CAMERAS, **SIZES, focal=0.05)
    assert fewer.reason[0] == "6 matches; at least 7 are needed"  # two focal lengths more are to be estimated


@pytest.mark.usefixtures("converging")
@pytest.mark.parametrize(
    ("cameras", "known", "tolerance"),
    [
        (ZOOMED, {"focal": ((650.0, 0.0), None)}, 0.02),
        (ZOOMED, {"focal": ((640.0, 0.05), (840.0, 0.05))}, 0.02), (CENTRAL, {"focal": "shared"}, 0.01),
        (CENTRAL, {"focal": (650.0, 0.0)}, 1e-6), (ZOOMED, {"K0": ZOOMED[0]}, 0.02),
        (ZOOMED, {"K0": ZOOMED[0], "K1": 0.95 * (ZOOMED[1] - np.eye(3)) + np.eye(3), "focal": (0.0, 0.05)}, 0.02),
    ],
    ids=["one", "both roughly", "shared", "both", "one K", "one K exact, the other rough"],
)  # fmt: skip
def test_focal_lengths_are_recovered(cameras: tuple, known: dict[str, Any], tolerance: float) -> None:
    """From exact matches of pairs that determine them; the prior pulls a little."""
    if "K1" in known:
        known["K1"][:2, 2] = ZOOMED[1][:2, 2]
    for seed in range(4):
        s = reference.scene(seed, outliers=0.0, cameras=cameras)
        e = fmtorch.find_fundamental(s.x0, s.x1, **SIZES, **known)
        np.testing.assert_allclose(e.focals[0], [K[0, 0] for K in cameras], rtol=tolerance)
        assert error(e, s) < 20 * tolerance + 1e-4


@pytest.mark.usefixtures("converging")
def test_the_fit_is_the_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the Sampson error of right matches, by SciPy."""
    monkeypatch.setattr(inliers, "MIN_INLIERS_FOR_NOISE", 1000)  # the loss is truncated at 1.5 px, five deviations
    s = reference.scene(3, noise=0.3, outliers=0.0)
    prior = np.random.default_rng(0).uniform(0.5, 1, 150)
    e = fmtorch.find_essential(s.x0, s.x1, **CAMERAS, **SIZES, prior=prior)
    R, t = reference.best_pose(s, prior)
    assert reference.angle(e.R[0].numpy(), R) < 1e-4
    assert float(np.degrees(np.linalg.norm(np.cross(e.t[0].numpy(), t)))) < 1e-3
    assert error(e, s) > 1e-2  # it is not the truth


@pytest.mark.usefixtures("converging")
@pytest.mark.parametrize("known", ["rough", "one", "shared", "unknown"])
def test_the_fit_is_the_maximum_of_the_posterior(known: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over pose and focal lengths, by SciPy; of images of two sizes, which the well of one camera is not for."""
    monkeypatch.setattr(inliers, "MIN_INLIERS_FOR_NOISE", 1000)  # the loss is truncated at 1.5 px, two deviations
    sizes, inf = ((480, 640), (600, 800)), float("inf")
    nothing = (1.0, inf)
    measured = {"rough": ((640.0, 0.05), (900.0, 0.1)), "one": ((660.0, 0.03), nothing)}.get(known, (nothing, nothing))
    cameras = tuple(calibration(f / max(size), size) for f, size in zip((650.0, 820.0), sizes, strict=True))
    s = reference.scene(3, noise=0.2, outliers=0.0, cameras=cameras)
    focal: Any = known if known in ("shared", "unknown") else torch.tensor(measured, dtype=torch.float64)
    e = fmtorch.find_fundamental(s.x0, s.x1, size0=sizes[0], size1=sizes[1], focal=focal, prior=np.ones(150))
    R, t, focals = reference.best_cameras(s, sizes, 0.75, measured, known == "shared")
    np.testing.assert_allclose(e.focals[0], focals, rtol=1e-4)
    assert reference.angle(e.R[0].numpy(), R) < 1e-2
    assert float(np.degrees(np.linalg.norm(np.cross(e.t[0].numpy(), t)))) < 1e-2


def test_noise_with_a_direction() -> None:
    """Points that err ten times as far along an edge: nearly as accurate as the best fit from the truth, by SciPy."""
    errors = []
    for seed in range(30):
        s, rng = reference.scene(seed, outliers=0.0), np.random.default_rng(seed)
        edge = rng.uniform(0, np.pi, 150)
        along = np.stack([np.cos(edge), np.sin(edge)], -1)
        root = 0.2 * np.eye(2) + 1.8 * along[:, :, None] * along[:, None]
        s = s._replace(x1=s.x1 + (root @ rng.normal(size=(150, 2, 1)))[..., 0])
        C = root @ root

        def distances(R: np.ndarray, t: np.ndarray, _: np.ndarray, s: Any = s, C: Any = C) -> np.ndarray:
            line = np.c_[s.x0, np.ones(150)] @ reference.fundamental(R, t).T
            e = (line[:, :2] * s.x1).sum(1) + line[:, 2]
            return np.asarray(e / np.sqrt(np.einsum("ni,nij,nj->n", line[:, :2], C, line[:, :2])))

        noises = C, np.sqrt(np.trace(C, axis1=1, axis2=2) / 2)
        own = [fmtorch.find_essential(s.x0, s.x1, **CAMERAS, **SIZES, noise=noise) for noise in noises]
        errors.append([*(error(e, s) for e in own), reference.pose_error(*reference.fitted(s, distances, 0)[:2], s)])
    covariances, mean, best = np.median(errors, 0)
    assert covariances < 1.4 * best
    assert covariances < 0.7 * mean


@pytest.mark.parametrize("known", [CAMERAS, {"focal": "shared"}, {"focal": (560.0, 0.1)}])
def test_pose_and_essential_matrix_are_those_of_the_fundamental_matrix(known: dict[str, Any]) -> None:
    """By a singular value decomposition and triangulation, with the estimated focal lengths."""
    for seed in range(4):
        s = reference.scene(seed, noise=0.5)
        e = fmtorch.find_fundamental(s.x0, s.x1, **SIZES, **known)
        K0, K1 = (calibration(f / 640, reference.SIZE) for f in e.focals[0].tolist())
        if known is CAMERAS:
            K0, K1 = reference.K0, reference.K1
        right = e.inliers[0].numpy()
        R, t, _ = solvers.pose(e.F[0].numpy(), K0, K1, s.x0[right], s.x1[right])
        np.testing.assert_allclose(e.R[0], R, atol=1e-6)
        np.testing.assert_allclose(e.t[0], t, atol=1e-6)
        np.testing.assert_allclose(e.E[0], solvers.skew(t) @ R, atol=1e-6)
        assert float(e.t.norm()) == pytest.approx(1)
        F = fundamental_from_calibration(*map(torch.from_numpy, (K0, K1)), e.R, e.t)
        assert min(float((e.F - sign * F).abs().max()) for sign in (-1, 1)) < 1e-6


def test_a_wrong_measurement_is_not_believed_for_long() -> None:
    """It has a tail: far from where the matches are, it no longer pulls."""
    s = reference.scene(5, 300, noise=0.1, outliers=0.1, cameras=CENTRAL)
    e = fmtorch.find_fundamental(s.x0, s.x1, **SIZES, focal=((2000.0, 0.02), (2000.0, 0.02)))
    np.testing.assert_allclose(e.focals[0], [650, 650], rtol=0.05)


def test_poses_are_there_as_a_whole_or_not_at_all() -> None:
    pairs = [scene(1), *degenerate().values(), *small().values()]
    e = KnownCameras(quick("fmtorch"))(with_knowledge(collate(pairs), "exact"), seed=5)
    for value in (e.E, e.R, e.t):
        finite = value.flatten(1).isfinite()
        assert bool((finite.all(1) | ~finite.any(1)).all())
        assert not bool(finite[~e.ok].any())
        assert float(finite[e.ok].any(1).float().mean()) > 0.5


def test_a_wrong_calibration_is_a_reason_and_no_more() -> None:
    c = with_knowledge(collate([scene(i) for i in range(5)]), "exact")
    K0, K1 = c.K0.clone(), c.K1.clone()
    K0[1], K1[2, 0, 0], K0[3, :2] = torch.nan, 0.0, K0[3, :2] / 800
    K0.requires_grad_()
    e = KnownCameras(quick("fmtorch"))(c.replace(K0=K0, K1=K1), seed=5)
    alone = KnownCameras(quick("fmtorch"))(c[[0, 4]], seed=5)
    assert e.ok.tolist() == [True, False, False, False, True]
    assert [reason.split(" ")[0] for reason in e.reason] == ["", "K0", "K1", "K0", ""]
    assert torch.equal(e.F[[0, 4]], alone.F)
    (gradient,) = torch.autograd.grad(e.F.sum() + e.t[[0, 4]].sum() + e.focals[[0, 4]].sum(), K0)
    assert bool(gradient.isfinite().all())
    assert bool(gradient[[0, 4]].any())
    assert not bool(gradient[1:4].any())


def test_wrong_focal_lengths_are_a_reason() -> None:
    c = collate([scene(i) for i in range(3)])
    focal = torch.tensor([[[800.0, 0.0], [800, 0]], [[-1, 0.1], [800, 0]], [[800, 0], [800, float("nan")]]])
    e = quick("fmtorch")(c.replace(focal=focal), seed=5)
    assert e.ok.tolist() == [True, False, False]
    assert all(reason.startswith("focal is wrong") for reason in e.reason[1:])


def test_without_cameras_nothing_changes() -> None:
    """Not even where data sets know them: neither K0 and K1, nor that nothing is known, count."""
    c = scenes()
    plain, calibrations = quick("fmtorch")(c, seed=5), quick("fmtorch")(calibrated(c), seed=5)
    asked = quick("fmtorch")(c.replace(focal=torch.full((len(c), 2, 2), torch.inf)), seed=5)
    for other in (calibrations, asked):
        for field in ("F", "inliers", "ok", "samples", "significance"):
            assert torch.equal(getattr(plain, field), getattr(other, field))
    assert plain.focals is None
    assert bool(asked.focals.isfinite().any())
    assert plain.E is None


@pytest.mark.usefixtures("converging")
@pytest.mark.parametrize("focal", [(0.0, 0.0), (0.05, 0.05), "shared"], ids=["exact", "rough", "shared"])
def test_gradients_are_the_differences_of_estimates(focal, monkeypatch):
    """At a converged fit of 14 inliers, too few to tell the noise, of which the scale of the fit would depend. The
    image of square pixels is a constant. Focal lengths are usual and equal ones, so that the prior does not pull: Gauss
    and Newton's Hessian leaves out the curvature of residuals."""
    given = _differentiable()
    fixed = square_pixels._image(torch.cat([given["K0"], given["K1"]]), torch.tensor([reference.SIZE] * 2))
    monkeypatch.setattr(square_pixels, "_image", lambda K, size: fixed)
    rng, names = np.random.default_rng(0), VARIABLES if focal != "shared" else VARIABLES[:4]
    weights = torch.from_numpy(rng.normal(size=9))

    def outputs(values: dict[str, Tensor]) -> Tensor:
        known = {"focal": focal} | ({name: values[name] for name in ("K0", "K1")} if focal != "shared" else {})
        rest = {name: values[name] for name in VARIABLES[:4]}
        e = fmtorch.find_fundamental(**rest, **known, **SIZES, inlier_threshold=3.0)  # type: ignore[arg-type]
        D = torch.diag(torch.tensor([300.0, 300, 1]).double())
        F = D @ e.F[0] @ D
        fields = (F / F.norm(), e.E[0], e.R[0], e.t[0], e.focals[0])
        return torch.stack([each.flatten() @ weights[: each.numel()] for each in fields])

    attached = {name: given[name].clone().requires_grad_() for name in names}
    computed = outputs(given | attached)
    leaves, graph = list(attached.values()), {"retain_graph": True, "allow_unused": True}
    gradients = [torch.autograd.grad(output, leaves, **graph) for output in computed]
    for name, own in zip(names, zip(*gradients, strict=True), strict=True):
        step = torch.from_numpy(rng.normal(size=tuple(given[name].shape)))
        if name in ("K0", "K1"):
            step = step * torch.tensor([[1.0, 1, 1], [0, 1, 1], [0, 0, 0]])
        h = {"x0": 1e-4, "x1": 1e-4, "K0": 1e-3, "K1": 1e-3}.get(name, 1e-2)  # px, or of numbers about one
        ends = [outputs(given | {name: given[name] + sign * h * step}) for sign in (-1, 1)]
        slopes = [0.0 if gradient is None else float((gradient * step).sum()) for gradient in own]
        assert slopes == pytest.approx(((ends[1] - ends[0]) / (2 * h)).tolist(), rel=1e-2, abs=1e-7), name


def _differentiable() -> dict[str, Tensor]:
    """Points, priors, noises and calibrations of 14 matches, nearly exact."""
    f = 1.2 * 640
    cameras = tuple(np.array([[f, skew, 319.5], [0, f, 239.5], [0, 0, 1]]) for skew in (1.0, -1.0))
    s, rng = reference.scene(4, 14, noise=1e-3, outliers=0.0, cameras=cameras), np.random.default_rng(1)
    values = {"x0": s.x0, "x1": s.x1, "prior": rng.uniform(0.5, 0.9, 14), "noise": rng.uniform(0.5, 2, 14)}
    return {name: torch.from_numpy(value)[None] for name, value in values.items()} | {
        name: torch.from_numpy(K)[None] for name, K in zip(("K0", "K1"), cameras, strict=True)
    }


@functools.cache
def castle() -> list[tuple[ImagePair, Correspondences]]:
    """Two pairs of castle-P19 with SIFT matches, P(inlier) and noise."""
    pairs = load("fmbench", root=shared_path("data/Strecha_train"))
    names = ("ratio", "one_to_one", "frame_consistency", "match_noise")
    pruners = {name: presets.build("pruner", name) for name in names}
    front = Pipeline(presets.build("features", "sift"), presets.build("matcher", "nearest"), pruners, quick("msac"))
    chosen = sorted((pairs[i] for i in range(len(pairs))), key=lambda pair: pair.identity)[::40]
    return [(pair, c) for pair in chosen if (c := front.correspondences([pair])[0].correspondences) is not None]


def test_real_pairs_keep_the_order_of_knowledge() -> None:
    """Exact calibration, 6 % of focal lengths, nothing."""
    errors: dict[str, list[float]] = {"exact": [], "rough": [], "unknown": []}
    for pair, c in castle():
        given = {name: getattr(c, name) for name in ("mask", "ratio", "prior", "noise", "size0", "size1", "key")}
        K = {"K0": pair.K0, "K1": pair.K1}
        knowledge: dict[str, Any] = {"exact": K, "rough": K | {"focal": 0.06}, "unknown": {"focal": "unknown"}}
        for name, known in knowledge.items():
            e = fmtorch.find_fundamental(c.x0, c.x1, **given, **known)
            errors[name].append(float(pose_error(e.R, e.t, pair.R[None], pair.t[None]).worst))  # type: ignore[arg-type]
    assert len(errors["exact"]) == 2
    assert max(errors["exact"]) < 2  # degrees
    assert np.mean(errors["exact"]) < np.mean(errors["rough"]) < np.mean(errors["unknown"])


@pytest.mark.parametrize(
    ("arguments", "focal"),
    [
        ({"focal": (800, 0.05)}, [[800, 0.05], [800, 0.05]]), ({"focal": ((800, 0), None)}, [[800, 0], [1, INF]]),
        ({"focal": ((800, 0), (900, 0.1))}, [[800, 0], [900, 0.1]]),
        ({"focal": np.ones((3, 2, 2))}, np.ones((3, 2, 2)).tolist()), ({"focal": "unknown"}, [[1, INF], [1, INF]]),
        ({"focal": "shared"}, [[1, INF], [1, INF]]), ({"K0": K, "K1": K}, [[1, 0], [1, 0]]),
        ({"K0": K, "K1": K, "focal": 0.05}, [[1, 0.05], [1, 0.05]]),
        ({"K0": K, "K1": K, "focal": (0, 0.1)}, [[1, 0], [1, 0.1]]),
        ({"K0": K, "K1": K, "focal": np.full((3, 2), 0.1)}, [[[1, 0.1], [1, 0.1]]] * 3),
        ({"K0": K}, [[1, 0], [1, INF]]), ({"K1": K, "focal": 0.1}, [[1, INF], [1, 0.1]]),
        ({"K0": K, "K1": K, "focal": "shared"}, [[1, INF], [1, INF]]),
    ],
)  # fmt: skip
def test_forms_of_what_is_known(arguments: dict[str, Any], focal: list[Any]) -> None:
    fields = camera_fields(arguments.get("K0"), arguments.get("K1"), arguments.get("focal"), True)
    assert fields["focal"].tolist() == focal
    said = arguments.get("focal")
    assert ("shared_focal" in fields) == (isinstance(said, str) and said == "shared")
    assert {name for name in ("K0", "K1") if name in fields} == arguments.keys() - {"focal"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"focal": "same"}, "focal is 'same'; it must be None, 'unknown', 'shared'"),
        ({"focal": "shraed"}, "did you mean 'shared'?"),
        ({"focal": 800.0}, "focal has shape"), ({"K0": K, "K1": K, "focal": (800, 0.1, 2)}, "focal has shape"),
        ({"focal": (-800.0, 0.1)}, "focal of image 0 of pair 0 is"),
        ({"focal": ((800.0, 0.1), (800.0, -0.1))}, "focal of image 1 of pair 0 is"),
        ({"focal": (800.0, float("nan"))}, "focal of image 0"),
        ({"focal": (800.0, 0.1), "size0": None, "size1": None}, "focal needs the image sizes"),
        ({"K0": K, "size0": None, "size1": None}, "K0 alone needs the image sizes"),
        ({"covariance": True, "size0": None, "size1": None}, "covariance needs K0 and K1, or the image sizes"),
        ({"size0": "guess"}, "size0 is 'guess'; it must be (h, w), 'unknown' or None"),
        ({"size1": "unknown"}, "size0 is given and the other is 'unknown'"),
        ({"size0": "unknown"}, "size1 is given and the other is 'unknown'"),
        ({"size0": "unknown", "size1": None, "focal": "shared"}, "focal needs the image sizes"),
        ({"K0": K, "K1": K, "focal": -0.1}, "a relative deviation is not negative"),
        *(({"K0": K, "K1": K, "focal": focal}, "such as 0.05, and unless it is infinite at most 2")
          for focal in (600, 5, ((600, 0.05), (600, 0.05)))),
        ({"focal": (600, 600)}, "focal of image 0 of pair 0 is [600.0, 600.0]; it is a positive focal length in px"),
        ({"K0": torch.eye(2), "K1": K}, "K0 has shape"), ({"K0": K, "K1": 0 * K}, "K1 is singular"),
        ({"K0": K / torch.tensor([[100.0], [100], [1]]), "K1": K}, "K0 has a focal length of 5 for an"),
        ({"K0": K, "K1": K * torch.tensor([[1e5], [1e5], [1]])}, "K1 has a focal length of 5e+07 for"),
        ({"K0": K, "K1": K / torch.tensor([[51], [51], [1]]), "size0": None, "size1": None}, "K1 has points"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_named(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=r"^") as error:
        fmtorch.find_fundamental(SCENE.x0, SCENE.x1, **(SIZES | arguments))
    assert str(error.value).startswith(said) or said in str(error.value)


def test_calibrations_come_in_any_form() -> None:
    """One for all pairs or one each, lists of pairs, whole numbers."""
    x0, x1 = SCENE.x0, SCENE.x1
    alone = fmtorch.find_essential(x0, x1, K, reference.K1)
    both = fmtorch.find_essential([x0, x0[:90]], [x1, x1[:90]], [K, K], reference.K1)
    batch = fmtorch.find_essential(np.stack([x0, x0]), np.stack([x1, x1]), K.expand(2, 3, 3), reference.K1)
    for other in (both, batch):
        assert torch.equal(other.R[:1], alone.R)
        assert other.focals.shape == (2, 2)
    as_lists = fmtorch.find_essential(x0, x1, [[500, 2, 310], [0, 520, 250], [0, 0, 1]], reference.K1)
    assert torch.equal(as_lists.R, alone.R)
