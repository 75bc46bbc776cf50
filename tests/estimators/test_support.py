"""No estimate without support: enough different inliers, not on one line, at any scale of the coordinates."""

import importlib.util
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch

from fmtorch import find_fundamental
from fmtorch.core import Correspondences, Estimate, collate
from fmtorch.estimators import Fundamental, GraphCut, Homography, degensac, inliers
from fmtorch.estimators.models import with_focals
from fmtorch.estimators.models.model import FitScale
from fmtorch.presets.objects import merged
from tests.laws import PEERS, degenerate, few, quick, scene, small
from tests.variants import OTHER_LIBRARIES, built, loaded, variants

EVERY = variants("estimator")
OWN = [name for name in EVERY if not name.startswith(OTHER_LIBRARIES)]
PIXELS = [  # what is a distance in pixels and no option
    (degensac, "PLANE_THRESHOLD_PX"), (with_focals, "INLIER_SIGMA_PX"), (with_focals, "LOSS_SCALE_PX"),
    (with_focals, "PARALLEL_PX"), (inliers, "FLOOR_PX"), (GraphCut, "RADIUS_PX"),
    (Fundamental, "fit_scale"), (Homography, "fit_scale"),
]  # fmt: skip


def estimator(name: str) -> Any:
    if name in PEERS and importlib.util.find_spec(PEERS[name]) is None:
        pytest.skip(f"{PEERS[name]} (extra `peers`) is not installed")
    return quick(name) if name in OWN else built("estimator", name)


def assert_supported(estimate: Estimate, c: Correspondences, what: str) -> None:
    """What is ok has a minimal sample of different inliers, off a line, and an F of unit norm; the rest has nothing."""
    points = torch.cat([c.x0, c.x1], -1).to(torch.float64).numpy()
    for i, ok in enumerate(estimate.ok.tolist()):
        inside = points[i][estimate.inliers[i].numpy()]
        assert ok == (estimate.reason[i] == ""), what
        if not ok:
            assert not len(inside), what
            assert not bool(estimate.F[i].any()), what
            continue
        minimal = 7 if estimate.model == "fundamental" else 4
        assert len(np.unique(inside, axis=0)) >= minimal, f"{what}, pair {i}"
        for image in (inside[:, :2], inside[:, 2:]):
            spread = np.linalg.svd(image - image.mean(0), compute_uv=False)
            assert spread[1] > 1e-9 * spread[0], f"{what}, pair {i}"
        assert float(estimate.F[i].norm()) == pytest.approx(1), f"{what}, pair {i}"


HOPELESS = ("empty", "one match", "all points equal", "NaN", "infinite")
RANK_TWO = (*small(), "one plane", "identity", "all outliers", "all points equal")
"""Pairs of usual coordinates, of which an F of unit norm in pixels has rank two to rounding."""


@pytest.mark.parametrize(
    ("name", "factor"), [*((name, 1.0) for name in EVERY), *((name, factor) for name in OWN for factor in (1e-9, 1e9))]
)
def test_few_and_degenerate_matches_of_any_scale_give_a_supported_model_or_a_reason(name: str, factor: float) -> None:
    """Sizes are scaled alike."""
    kinds = small() | degenerate() | {str(i): scene(100 + i, 20, outliers=1.0) for i in range(8)}
    fields = ("x0", "x1", "size0", "size1")
    c = collate([p.replace(**{f: getattr(p, f).double() * factor for f in fields}) for p in kinds.values()])
    estimate = estimator(name)(c, 2)
    assert_supported(estimate, c, name)
    assert not any(bool(estimate.ok[list(kinds).index(kind)]) for kind in HOPELESS)
    if name in OWN and estimate.model == "fundamental":
        usual = torch.tensor([kind in RANK_TWO for kind in kinds])
        # Rank two in the unit of the points; in pixels, a thousandth of it, 1e6 roundings of 2e-16 are left.
        assert float(torch.linalg.svdvals(estimate.F[usual])[:, 2].max()) < 1e-9


def test_the_default_has_no_support_at_thresholds_far_below_rounding() -> None:
    c = scene(0, 60, outliers=0.0, noise=0.0)
    estimate = find_fundamental(c.x0.double() * 1e12, c.x1.double() * 1e12)
    assert not bool(estimate.ok[0])
    assert "different inliers; at least 7 are needed" in estimate.reason[0]


def scaled(config: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """The thresholds within a preset, times `scale`."""
    levels = {key: scaled(value, scale) for key, value in config.items() if isinstance(value, Mapping)}
    pixels = ("threshold", "inlier_threshold", "scale")
    own = {k: v * scale for k, v in config.items() if k in pixels and isinstance(v, float)}
    of_losses = config.get("threshold")
    if isinstance(of_losses, Mapping):
        own["threshold"] = {loss: value * scale for loss, value in of_losses.items()}
    return {**levels, **own}


@pytest.mark.parametrize("name", OWN)
def test_coordinates_sizes_and_thresholds_scaled_together_give_the_same_inliers(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = [scene(i, 100, outliers=0.2, noise=0.1) for i in range(3)]
    c = collate(
        [p.replace(x0=p.x0.double(), x1=p.x1.double(), size0=p.size0.double(), size1=p.size1.double()) for p in pairs]
    )
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
        sizes = {"size0": c.size0 * scale, "size1": c.size1 * scale}
        estimate = changed(c.replace(x0=c.x0 * scale, x1=c.x1 * scale, **sizes), 3)
        assert bool(estimate.ok.all()), estimate.reason
        inliers[scale] = estimate.inliers
    for scale, rescaled in inliers.items():
        assert torch.equal(rescaled, inliers[1.0]), f"{name}: other inliers at {scale}"


@pytest.mark.parametrize("name", OWN)
def test_a_shift_changes_nothing(name: str) -> None:
    pairs = [scene(i, 100, outliers=0.2, noise=0.1) for i in range(3)]
    # Whole 1/256 of a pixel, so that shifted by whole pixels no coordinate is rounded; sizes say where the images are.
    c = collate(
        [
            p.replace(
                x0=(p.x0.double() * 256).round() / 256, x1=(p.x1.double() * 256).round() / 256, size0=None, size1=None
            )
            for p in pairs
        ]
    )
    moved = quick(name)
    before = moved(c, 3)
    shift0, shift1 = torch.tensor([1e6, -3e5], dtype=torch.float64), torch.tensor([-7e4, 2e9], dtype=torch.float64)
    after = moved(c.replace(x0=c.x0 + shift0, x1=c.x1 + shift1), 3)
    assert torch.equal(after.inliers, before.inliers)
    assert torch.equal(after.ok, before.ok)
