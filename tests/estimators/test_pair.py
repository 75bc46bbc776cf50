"""One pair of a batch: its units, what supports a model, and gradients."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch import estimators, find_fundamental
from fmtorch.core import Correspondences, Estimate, collate
from fmtorch.estimators import MAX_NOISE, MIN_NOISE, FitScale, bucket
from fmtorch.estimators.models import with_focals
from fmtorch.geometry import LOSSES
from fmtorch.presets import merged
from tests.estimators.models.test_focals import TALL, WIDE, photographs
from tests.estimators.pairs import SCALES, known, named, normalized, pair_of, quick_or_skip, real
from tests.laws import degenerate, few, quick, scene, small, with_padding
from tests.reference.random import number
from tests.variants import OTHER_LIBRARIES, built, loaded, variants

WRONG = {
    "prior": ((1.5, -0.1, math.nan), "prior of 1 match is wrong: it is P(inlier), within [0, 1]"),
    "noise": ((0.0, -1.0, math.nan), f"noise of 1 match is wrong: {Correspondences.declared['noise'].bounds.text}"),
    "size0": ((0.0, -3.0, math.nan, math.inf), "size0 is wrong: image sizes (h, w) are positive"),
}
HOPELESS = ("empty", "one match", "all points equal", "NaN", "infinite")
RANK_TWO = (*small(), "one plane", "identity", "all outliers", "all points equal")
"""Pairs of usual coordinates, of which an F of unit norm in pixels has rank two to rounding."""
EVERY = variants("estimator")
SCALED = ("x0", "x1", "size0", "size1")
OWN = [name for name in EVERY if not name.startswith(OTHER_LIBRARIES)]
PARTS = [name for name in OWN if not name.startswith("paper/") or name in ("paper/ransac", "paper/usac")]
"""Presets in which every part stands: those of the paper differ from their namesakes by the final fit alone."""
PIXELS = [  # what is a distance in pixels and no option
    (estimators.search, "PLANE_THRESHOLD_PX"), (with_focals, "INLIER_SIGMA_PX"), (with_focals, "LOSS_SCALE_PX"),
    (with_focals, "PARALLEL_PX"), (estimators.inliers, "FLOOR_PX"), (estimators.GraphCut, "RADIUS_PX"),
    (estimators.Fundamental, "fit_scale"), (estimators.Homography, "fit_scale"),
]  # fmt: skip


def padded_pairs() -> Correspondences:
    """Pairs of many sizes, with priors and noise on and beyond their bounds, with garbage in masked slots."""
    c = collate([scene(i, 7 + 67 * i, noise=0.1 * i) for i in range(6)])
    c = c.replace(noise=torch.linspace(1e-3, 40, c.mask.shape[1]).expand(len(c), -1))
    return with_padding(c, np.random.default_rng(1), float("nan"))


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("kind", ["all", "nothing", "real"])
def test_a_pair_holds_its_usable_matches_in_order(kind: str, scale: float) -> None:
    c = real(7) if kind == "real" else padded_pairs()
    c = c if kind == "all" else c.replace(prior=None, noise=None, ratio=None, size0=None, size1=None)
    c = c.replace(x0=scale * c.x0.double(), x1=scale * c.x1.double())
    for i in range(len(c)):
        pair, slot = normalized(c, i=i)
        mask = c.mask[i].numpy()
        np.testing.assert_array_equal(slot, np.flatnonzero(mask))
        pixels = torch.cat([c.x0, c.x1], -1)[i].numpy()[mask].T
        low, high = pixels.min(1), pixels.max(1)
        np.testing.assert_array_equal(pair.centre, (low + high) / 2)
        half = ((high - low) / 2).max()
        assert math.frexp(pair.pixels_per_unit)[0] == 0.5  # a power of two, the next one
        assert pair.pixels_per_unit / 2 < half <= pair.pixels_per_unit
        np.testing.assert_array_equal(pair.points, (pixels - pair.centre[:, None]) / pair.pixels_per_unit)
        assert (pair.count, pair.key, pair.bucket) == (mask.sum(), int(c.keys[i]), bucket(int(mask.sum())))
        values = {name: getattr(c, name) for name in ("prior", "noise", "ambiguity")}
        for name, value in values.items():
            assert (getattr(pair, name) is None) == (value is None) == (kind != "all")
        usual = np.ones(pair.count)
        prior, noise, _ = (usual if v is None else v[i].double().numpy()[mask] for v in values.values())
        noise = np.clip(noise, MIN_NOISE, MAX_NOISE)
        np.testing.assert_array_equal(pair.match_weight, prior)
        np.testing.assert_array_equal(pair.weight, prior / (noise * noise))
        np.testing.assert_array_equal(pair.pixels_per_noise, pair.pixels_per_unit / noise)
        assert pair.sizes.tolist() == ([640, 960, 640, 960] if kind == "all" else [])
        assert pair.sizes_known == (kind == "all")
        assert pair.table.flags.c_contiguous
        assert pair.table.dtype == np.float64


@pytest.mark.parametrize("name", WRONG)
def test_wrong_values_are_a_reason_unless_they_are_masked(name: str) -> None:
    c, (values, reason) = known(20), WRONG[name]
    for value in values:
        wrong = getattr(c, name).float().clone()
        wrong[0, wrong.shape[1] // 2] = value
        assert normalized(c.replace(**{name: wrong})) == reason
        hidden = c.replace(**{name: wrong}, mask=torch.arange(20)[None] != 10)
        assert isinstance(normalized(hidden), str) == (name == "size0")


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e100, -1e300])
def test_matches_that_are_no_numbers_are_none(value: float) -> None:
    c = known(20)
    x1 = c.x1.double().clone()
    x1[0, 5, 1] = value
    result = normalized(c.replace(x0=c.x0.double(), x1=x1))
    np.testing.assert_array_equal(result[1], np.delete(np.arange(20), 5))
    few = normalized(c.replace(x0=c.x0.double(), x1=x1), minimal=20)
    assert few == "19 matches; at least 20 are needed"


def test_pairs_that_cannot_be_estimated_have_a_reason() -> None:
    reasons = {name: normalized(c) for name, c in {**degenerate(), **small()}.items()}
    failures = {name: reason for name, reason in reasons.items() if isinstance(reason, str)}
    assert failures == {
        "empty": "0 matches; at least 7 are needed",
        "one match": "1 matches; at least 7 are needed",
        "all points equal": "all matches coincide",
        "NaN": "0 matches; at least 7 are needed",
        "infinite": "0 matches; at least 7 are needed",
        "8 coincident": "all matches coincide",
        "20 coincident": "all matches coincide",
    }


def test_a_part_of_a_pair_keeps_its_frame() -> None:
    pair = named("scene 40")
    index = np.array([7, 3, 30])
    part = pair.take(index)
    np.testing.assert_array_equal(part.table, pair.table[:, index])
    for name in ("bucket", "pixels_per_unit", "key", "seed", "centre", "sizes", "residual", "images"):
        assert getattr(part, name) is getattr(pair, name), name
    assert pair.cached("sum", lambda pair: float(pair.points.sum())) == pair.points.sum()
    assert pair.cached("sum", lambda pair: pytest.fail("computed again")) == pair.points.sum()
    assert part.cached("sum", lambda pair: float(pair.points.sum())) == part.points.sum()


def assert_supported(estimate: Estimate, c: Correspondences, what: str) -> None:
    """What is ok has a minimal sample of different inliers, off a line, and an F of unit norm; the rest has nothing."""
    points = torch.cat([c.x0, c.x1], -1).to(torch.float64).numpy()
    for i, ok in enumerate(estimate.ok.tolist()):
        inside = points[i][estimate.inliers[i].numpy()]
        assert ok == (estimate.reason[i] == ""), what
        if not ok:
            assert not len(inside), what
            assert not bool(estimate.matrix[i].any()), what
            continue
        minimal = 7 if estimate.model == "fundamental" else 4
        assert len(np.unique(inside, axis=0)) >= minimal, f"{what}, pair {i}"
        for image in (inside[:, :2], inside[:, 2:]):
            spread = np.linalg.svd(image - image.mean(0), compute_uv=False)
            assert spread[1] > 1e-9 * spread[0], f"{what}, pair {i}"
        assert float(estimate.matrix[i].norm()) == pytest.approx(1), f"{what}, pair {i}"


@pytest.mark.parametrize("name", EVERY)
def test_few_and_degenerate_matches_of_any_scale_give_a_supported_model_or_a_reason(name: str) -> None:
    kinds = small() | degenerate() | {str(i): scene(100 + i, 20, outliers=1.0) for i in range(3)}
    usual, built = torch.tensor([kind in RANK_TWO for kind in kinds]), quick_or_skip(name)
    for scale in (1e-9, 1.0, 1e9) if name in PARTS else (1.0,):
        c = collate([p.replace(**{name: getattr(p, name).double() * scale for name in SCALED}) for p in kinds.values()])
        estimate = built(c, 2)
        assert_supported(estimate, c, f"{name} at {scale}")
        assert not any(bool(estimate.ok[list(kinds).index(kind)]) for kind in HOPELESS)
        if name in OWN and estimate.model == "fundamental":
            # Rank two in the unit of the points; in pixels, a thousandth of it, 1e6 roundings of 2e-16 are left.
            assert float(torch.linalg.svdvals(estimate.F[usual])[:, 2].max()) < 1e-9


def test_the_default_has_no_support_at_thresholds_far_below_rounding() -> None:
    c = scene(0, 60, outliers=0.0, noise=0.0)
    estimate = find_fundamental(c.x0.double() * 1e12, c.x1.double() * 1e12)
    assert not bool(estimate.ok[0])
    assert "different inliers; at least 7 are needed" in estimate.reason[0]


def scaled(config: Mapping[str, Any], scale: float) -> dict[str, Any]:
    levels = {key: scaled(value, scale) for key, value in config.items() if isinstance(value, Mapping)}
    pixels = ("threshold", "inlier_threshold", "scale")
    own = {k: v * scale for k, v in config.items() if k in pixels and isinstance(v, float)}
    of_losses = config.get("threshold")
    if isinstance(of_losses, Mapping):
        own["threshold"] = {loss: value * scale for loss, value in of_losses.items()}
    return {**levels, **own}


@pytest.mark.parametrize("name", OWN)
def test_coordinates_sizes_and_thresholds_scaled_together_give_the_same_inliers(name, monkeypatch):
    pairs = [scene(i, 100, outliers=0.2, noise=0.1) for i in range(3)]
    c = collate([p.replace(**{name: getattr(p, name).double() for name in SCALED}) for p in pairs])
    preset = loaded("estimator", name)
    options = {} if name.startswith("irls") else few(preset)
    pixels = {(owner, constant): getattr(owner, constant) for owner, constant in PIXELS}

    def in_pixels(value: Any, scale: float) -> Any:
        if not isinstance(value, FitScale):
            return value * scale
        limits = {name: getattr(value, name) * scale for name in ("smallest_px", "largest_px", "default_px")}
        return value._replace(**limits)

    inliers = {}
    # Outliers carry Huber's loss away so far that its 30 steps do not end at an optimum; where they do depends on the
    # unit of the points, which is the next power of two.
    scales = (2.0**-30, 2.0**-10, 2.0**10, 2.0**30) if name == "irls:loss=huber" else (1e-9, 1e-3, 1e3, 1e9)
    for scale in (1.0, *scales):
        for (owner, constant), value in pixels.items():
            monkeypatch.setattr(owner, constant, in_pixels(value, scale))
        changed = built("estimator", name, **merged(options, scaled(preset, scale)))
        estimate = changed(c.replace(**{name: getattr(c, name) * scale for name in SCALED}), 3)
        assert bool(estimate.ok.all()), estimate.reason
        inliers[scale] = estimate.inliers
    for scale, rescaled in inliers.items():
        assert torch.equal(rescaled, inliers[1.0]), f"{name}: other inliers at {scale}"


@pytest.mark.parametrize("name", OWN)
def test_a_shift_changes_nothing(name: str) -> None:
    pairs = [scene(i, 100, outliers=0.2, noise=0.1) for i in range(3)]
    # Whole 1/256 of a pixel, so that shifted by whole pixels no coordinate is rounded; sizes say where the images are.
    points = ([(x.double() * 256).round() / 256 for x in (p.x0, p.x1)] for p in pairs)
    c = collate([p.replace(x0=x0, x1=x1, size0=None, size1=None) for p, (x0, x1) in zip(pairs, points, strict=True)])
    moved = quick(name)
    before = moved(c, 3)
    shift0, shift1 = torch.tensor([1e6, -3e5], dtype=torch.float64), torch.tensor([-7e4, 2e9], dtype=torch.float64)
    after = moved(c.replace(x0=c.x0 + shift0, x1=c.x1 + shift1), 3)
    assert torch.equal(after.inliers, before.inliers)
    assert torch.equal(after.ok, before.ok)


VARIABLES = ("x0", "x1", "prior", "noise")
SEARCH = {"hypotheses": 200, "round": 200, "confidence": None, "refit_inliers": False, "inlier_threshold": 3.0}
REFINED = {"refine": {"loss": "truncated"}, "select": {"scale": 1.0}, "pool": 4}
CAMERAS = "adaptive, with cameras"
FITS: Mapping[str, Mapping[str, object]] = {
    "least_squares": {"final": "least_squares"},
    "unweighted_least_squares": {"final": "unweighted_least_squares"},
    "gauss_newton": {"final": "gauss_newton", **REFINED},
    "adaptive": {"final": "adaptive", **REFINED},
    CAMERAS: {"final": "adaptive", **REFINED, "focal": {"samples": 100, "pool": 8}},
}
UNMOVED = {"unweighted_least_squares": ("prior", "noise"), **{f"irls {name}": ("noise",) for name in LOSSES}}
"""What a fit takes no account of."""


def attached_estimator(name: str) -> estimators.Ransac | estimators.IterativelyReweighted:
    if name.startswith("irls "):
        return estimators.IterativelyReweighted(loss=name.removeprefix("irls "), threshold=2.0, refine_iterations=60)
    return estimators.Ransac(**(SEARCH | FITS[name]))  # type: ignore[arg-type]


def inputs(seed: int, noise: float, same: bool = False) -> dict[str, Tensor]:
    """Points, priors and noises of a pair without outliers."""
    c = photographs(seed, (WIDE, WIDE if same else TALL), (1.1, 1.2), 60, noise, 0.0).c
    rng = np.random.default_rng(seed)
    prior, sigma = torch.from_numpy(rng.uniform(0.2, 0.9, (1, 60))), torch.from_numpy(rng.uniform(0.5, 2, (1, 60)))
    return {"x0": c.x0, "x1": c.x1, "prior": prior, "noise": sigma}


@pytest.fixture
def converging(monkeypatch: pytest.MonkeyPatch) -> None:
    schedule = estimators.refinement.SCHEDULE._replace(iterations=30, tolerance=0.0)
    for name, value in {"SCHEDULE": schedule, "FOCAL_ITERATIONS": 30, "FOCAL_TOLERANCE": 0.0}.items():
        monkeypatch.setattr(estimators.refinement, name, value)


@pytest.mark.usefixtures("converging")
@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("name", [*FITS, *(f"irls {loss}" for loss in LOSSES)])
def test_they_are_the_differences_of_estimates(name: str, same: bool) -> None:
    """Where residuals are small against the image: Gauss and Newton's Hessian leaves out their curvature."""
    given, built = inputs(7, 1e-3, same), attached_estimator(name)
    c = photographs(7, (WIDE, WIDE if same else TALL), (1.1, 1.2), 60).c
    rng = np.random.default_rng(1)
    weights, D = torch.from_numpy(rng.normal(size=(3, 3))), torch.diag(torch.tensor([480.0, 320, 1]).double())

    def value(values: dict[str, Tensor]) -> Tensor:
        (F,) = built(c.replace(**values)).F  # in units of half the image
        G = D @ F @ D
        return (weights * G / G.norm()).sum()

    attached = {key: tensor.clone().requires_grad_() for key, tensor in given.items()}
    output = value(attached)
    assert torch.equal(output.detach(), value(given))
    gradients = torch.autograd.grad(output, list(attached.values()), allow_unused=True)
    for (key, tensor), gradient in zip(given.items(), gradients, strict=True):
        if key in UNMOVED.get(name, ()):
            assert gradient is None or not bool(gradient.any())
            continue
        step = torch.from_numpy(rng.normal(size=tuple(tensor.shape)))
        h = 1e-4  # px, or of numbers about one
        ends = [float(value(given | {key: tensor + sign * h * step})) for sign in (-1, 1)]
        # By prior and noise the optimum moves in proportion to its residuals, 1e-5 of half the image and less.
        numeric, rounding = (ends[1] - ends[0]) / (2 * h), 1e-12 / h
        assert float((gradient * step).sum()) == pytest.approx(numeric, rel=5e-3, abs=rounding), key


def with_noise(c: Correspondences) -> Correspondences:
    noise = torch.linspace(0.5, 2, c.mask.shape[1]).double()[None]
    return c.replace(x0=c.x0.double(), x1=c.x1.double(), noise=noise)


@pytest.mark.parametrize("name", [*FITS, "irls cauchy", "irls magsac"])
def test_failed_pairs_have_none_and_change_no_other(name: str) -> None:
    good, built = [with_noise(scene(1)), with_noise(scene(2, 60))], attached_estimator(name)

    def differentiated(c: Correspondences) -> tuple[Tensor, dict[str, Tensor]]:
        values = {key: getattr(c, key).double() for key in VARIABLES}
        attached = {key: value.clone().requires_grad_() for key, value in values.items()}
        estimate, without = built(c.replace(**attached), seed=5), built(c.replace(**values), seed=5)
        assert torch.equal(estimate.F.detach(), without.F)
        assert torch.equal(estimate.inliers, without.inliers)
        assert estimate.reason == without.reason
        estimate.F[:, 0, 1].square().sum().backward()
        return estimate.ok, {key: value.grad for key, value in attached.items() if value.grad is not None}

    c = collate([good[0], *map(with_noise, degenerate().values()), good[1]])
    ok, gradients = differentiated(c)
    assert bool(ok[[0, -1]].all())
    assert not bool(ok.all())
    for key, gradient in gradients.items():
        assert bool(gradient.isfinite().all()), key
        assert not bool(gradient[~ok].any()), key
        assert not bool(gradient[~c.mask].any()), key
    assert bool(gradients["x0"][[0, -1]].flatten(1).any(1).all())
    for row, each in ((0, good[0]), (-1, good[1])):
        for key, alone in differentiated(each)[1].items():
            # Sums over paddings of other lengths are rounded otherwise.
            torch.testing.assert_close(gradients[key][row, : alone.shape[1]], alone[0], rtol=1e-9, atol=1e-15)


def test_numbers_of_a_pair_are_those_of_its_seed_key_and_draw() -> None:
    pair = pair_of(scene(0, 20), seed=5)
    expected = [[(number(5, pair.key, 1, d, j, 4) >> 10) / 2**53 for j in range(4)] for d in range(100, 130)]
    assert pair.uniform(100, 30, 4).tolist() == expected
