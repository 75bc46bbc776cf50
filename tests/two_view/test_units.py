"""Pair types, homographies, units and lenses of the public functions."""

import functools
import math
import warnings
from typing import Any

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch.core import PAIR_TYPES, Correspondences, Estimate, collate
from fmtorch.estimators import Ransac, lens_search
from fmtorch.geometry import significance
from fmtorch.metrics import corner_error, nsgd
from fmtorch.two_view.arguments import lens_fields
from fmtorch.two_view.pair_type import classify
from tests.geometry.scenes import batch, draw
from tests.laws import quick
from tests.reference import lenses as division
from tests.reference.homography import mapped
from tests.reference.known_cameras import K0, K1, SIZE, angle, scene
from tests.two_view.test_lenses import PLANE, planes

K = np.array([[900.0, 0, 639.5], [0, 900, 359.5], [0, 0, 1]])
SCENE = scene(0)
X0, X1 = SCENE.x0, SCENE.x1
SIZES = {"size0": SIZE, "size1": SIZE}
INF = float("inf")


def pair(kind: str, seed: int, n: int = 150, **options: float) -> Correspondences:
    given = batch([draw(kind, seed, n, **options)])  # type: ignore[arg-type]
    fields = {name: given[name] for name in ("x0", "x1", "mask", "size0", "size1", "K0", "K1")}
    return Correspondences(**fields, key=torch.tensor([seed]))


def estimated(c: Correspondences) -> Estimate:
    return quick("fmtorch")(c, 0)


@functools.cache
def twelve(kind: str) -> tuple[Correspondences, Estimate]:
    """Pairs, and their estimates, for which K0 and K1 do not count."""
    c = collate([pair(kind, seed) for seed in range(12)])
    return c, estimated(c)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("kind", PAIR_TYPES)
def test_kinds(kind: str, known: bool) -> None:
    """Of estimated models, with calibrations and by image sizes alone, the cameras being usual ones."""
    c, estimate = twelve(kind)
    c = c if known else c.replace(K0=None, K1=None)
    classified = classify(c, estimate)
    assert classified.names.count(kind) >= 11, classified.names
    assert torch.equal(classified.determined, torch.tensor([name == "general" for name in classified.names]))
    exact = classify(c, estimate, focal_deviation=0)
    assert exact.names.count(kind) >= 11, exact.names
    nothing = torch.zeros_like(estimate.F)
    failed = estimate.derived(matrix=nothing, ok=nothing[:, 0, 0] > 0)  # as of an estimator that does not work
    assert classify(c, failed).names.count(kind) >= 11
    if kind == "rotation":  # which needs cameras or sizes
        alone = c.replace(K0=None, K1=None, size0=None, size1=None)
        assert classify(alone, estimated(alone)).names.count("planar") >= 11


def test_a_focal_length_that_is_not_known_is_that_of_no_calibration() -> None:
    """Rotations with K whose focal lengths are three times too long, and with measured ones but no K."""
    c = collate([pair("rotation", seed) for seed in range(10)])
    long = torch.tensor([3.0, 3.0, 1.0])
    wrong, estimate = c.replace(K0=c.K0 * long, K1=c.K1 * long), estimated(c)
    assert classify(wrong, estimate).names.count("rotation") <= 2
    unknown = wrong.replace(focal=torch.tensor([1.0, torch.inf]).expand(len(c), 2, 2).clone())
    assert classify(unknown, estimate).names.count("rotation") >= 8
    px = torch.stack([c.K0[:, 0, 0], c.K1[:, 0, 0]], 1)
    measured = torch.stack([px, torch.full_like(px, 0.01)], -1)
    assert classify(c.replace(K0=None, K1=None, focal=measured), estimate).names.count("rotation") >= 9


def test_wrong_arguments() -> None:
    c = pair("general", 0)
    estimate, plane = estimated(c), fmtorch.find_homography(c.x0, c.x1)
    for given, deviation, said in (
        (plane, 0, "estimate is of homography matrices"),
        (estimate[:0], 0, "estimate is of 0 pairs and c of 1"),
        (estimate, -1, "focal_deviation is -1"),
    ):
        with pytest.raises(ValueError, match=said):
            classify(c, given, focal_deviation=deviation)


def pitch(seed: int, up: bool, count: int = 60, wrong: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a court in metres, y up or down, where a camera beside it sees them, with 0.5 px of noise; the map."""
    rng = np.random.default_rng(seed)
    court, centre = rng.uniform([0, 0], [28, 15], (count, 2)), np.array([14.0, -12, 7])
    z = np.array([14.0, 7, 0]) - centre
    R = np.stack([np.array([1.0, 0, 0]), np.cross(z / np.linalg.norm(z), [1.0, 0, 0]), z / np.linalg.norm(z)])
    H = K @ np.c_[R[:, 0], R[:, 1], -R @ centre] @ np.diag([1, 1 if up else -1, 1])
    court = court * [1, 1 if up else -1]
    y = mapped(H, court) + 0.5 * rng.normal(size=(count, 2))
    bad = np.arange(count) < wrong * count
    y[bad] = rng.uniform([0, 0], [1280, 720], (int(bad.sum()), 2))
    return court, y, H


def error(H: torch.Tensor, truth: np.ndarray, court: np.ndarray, unit: np.ndarray) -> float:
    apart = mapped(H.numpy() @ unit, court) - mapped(truth, court)
    return float(np.sqrt((apart**2).sum(1).mean()))


@pytest.mark.parametrize("up", [False, True])
@pytest.mark.parametrize("shift", [0.0, 1e5])
def test_the_unit_of_a_plane_and_its_orientation_change_nothing(up: bool, shift: float) -> None:
    """From kilometres to centimetres, in units of the plane, and on a map far from its origin."""
    court, y, H = pitch(0, up)
    for scale in (1e-3, 1 / 28, 1.0, 100.0, 1e4):
        unit = np.array([[scale, 0, shift * scale], [0, scale, -3 * shift * scale], [0, 0, 1]])
        e = fmtorch.find_homography(mapped(unit, court), y)
        assert bool(e.ok)
        assert int(e.inliers[0, 18:].sum()) >= 40
        assert error(e.H[0], H, court, unit) < 0.6  # by 8 parameters of 42 matches some 0.3
        assert float(e.significance) > 50
        assert bool(e.related)
        seen = torch.from_numpy(np.c_[mapped(unit, court), np.ones(60)]) @ e.H[0, 2]
        assert bool((seen[e.inliers[0]] > 0).all())


def test_a_mirrored_photograph_is_the_mirror_of_it() -> None:
    """Bits and gradients of the other orientation, in a batch with one that is not mirrored."""
    rng = np.random.default_rng(0)
    x = rng.uniform([0, 0], [640, 480], (80, 2))
    y = mapped(np.array([[0.9, 0.1, 20], [-0.1, 1, 5], [1e-4, 2e-4, 1]]), x) + 0.3 * rng.normal(size=(80, 2))
    both = torch.from_numpy(np.stack([x, x * [1, -1]])).requires_grad_()
    e = fmtorch.find_homography(both, torch.from_numpy(np.stack([y, y])))
    assert e.ok.tolist() == [True, True]
    assert torch.equal(e.H[1], e.H[0] * torch.tensor([1.0, -1, 1]))
    (gradient,) = torch.autograd.grad((e.H[0] * e.H[0].detach().roll(1)).sum(), both, retain_graph=True)
    (turned,) = torch.autograd.grad((e.H[1] * torch.tensor([1.0, -1, 1]) * e.H[0].detach().roll(1)).sum(), both)
    torch.testing.assert_close(turned[1], gradient[0] * torch.tensor([1.0, -1]), rtol=1e-12, atol=1e-15)


def test_matches_of_nothing_have_no_homography() -> None:
    """Any four have one, and of a hundred some agree by chance."""
    for seed in range(8):
        x0, x1 = np.random.default_rng(seed).uniform([0, 0], [640, 480], (2, 100, 2))
        e = fmtorch.find_homography(x0, x1)
        assert not bool(e.ok), seed
        assert "no more than by chance" in e.reason[0]
    exact = fmtorch.find_homography(x0[:4], mapped(np.diag([2.0, 2, 1]), x0[:4]))
    assert (exact.ok.tolist(), exact.related.tolist()) == ([True], [False])


def test_significance_is_that_of_its_definition() -> None:
    """NFA(k) = 2 (n - 4) C(n, k) C(k, 4) p_k^(k - 4), by whole numbers; each match in a cell of its own."""
    rng = np.random.default_rng(4)
    x0 = np.stack(np.meshgrid(np.arange(5) * 120.0, np.arange(4) * 120.0), -1).reshape(-1, 2)
    H = np.array([[1.1, 0.05, 12], [-0.04, 0.98, 7], [2e-5, -3e-5, 1]])
    x1 = mapped(H, x0) + rng.normal(size=(20, 2)) * np.r_[np.full(14, 0.7), np.full(6, 90.0)][:, None]
    back, areas = mapped(np.linalg.inv(H), x1), [np.prod(np.ptp(x, axis=0)) for x in (x0, x1)]
    ends = zip((x0, x1), (back, mapped(H, x0)), areas, strict=True)
    chance = np.max([np.pi * ((a - b) ** 2).sum(1) / area for a, b, area in ends], 0)
    p = np.sort(np.clip(chance, 2.0**-26, 1))
    tests = {k: 2 * 16 * math.comb(20, k) * math.comb(k, 4) for k in range(5, 21)}
    expected = max(-math.log10(tests[k]) - (k - 4) * math.log10(p[k - 1]) for k in tests)
    got = significance(*(torch.from_numpy(a)[None] for a in (H, x0, x1)), model="homography")
    assert float(got) == pytest.approx(expected, rel=1e-9)


def normalized(x: np.ndarray, K: np.ndarray) -> np.ndarray:
    return mapped(np.linalg.inv(K), x)


@pytest.mark.parametrize("unit", ["focal length", "width", "0 to 1", "-1 to 1"])
def test_normalized_points_are_refused(unit: str) -> None:
    """They came back ok, with all matches inliers: thresholds are in pixels."""
    if unit == "focal length":
        x0, x1 = normalized(X0, K0), normalized(X1, K1)
    else:
        scale, shift = {"width": (640, 0.5), "0 to 1": (640, 0), "-1 to 1": (320, 1)}[unit]
        x0, x1 = (x / scale - shift for x in (X0, X1))
    said = r"^x0 runs from .*: no pixels, in which thresholds are.*Give points in"
    for find in (fmtorch.find_fundamental, fmtorch.find_homography):
        for points in ((x0, x1), (np.stack([x0, x0]), np.stack([x1, x1]))):
            with pytest.raises(ValueError, match=said):
                find(*points)


def test_normalized_points_have_the_identity_for_their_camera() -> None:
    x0, x1 = normalized(X0, K0), normalized(X1, K1)
    estimate = fmtorch.find_essential(x0, x1, np.eye(3), np.eye(3))
    assert bool(estimate.ok)
    assert int(estimate.inliers.sum()) < 0.8 * len(x0)
    with_pair_type = fmtorch.find_essential(x0, x1, np.eye(3), np.eye(3), pair_type=True)
    assert with_pair_type.pair_type == ("general",)
    said = r"x0 runs from .*, as normalised points do, but K0 is in pixels; give points in"
    with pytest.raises(ValueError, match=said):
        fmtorch.find_essential(x0, x1, K0, K1)
    with pytest.raises(ValueError, match=r"^x1 runs from"):  # one image may be the wrong one
        fmtorch.find_fundamental(X0, x1)


def test_points_of_a_wide_lens_are_no_swapped_sizes() -> None:
    """Undistorted, most lie outside on all sides."""
    far = [4 * x - 3 * np.array([319.5, 239.5]) for x in (X0, X1)]
    for points in ((X0, X1), far):
        assert bool(fmtorch.find_fundamental(*points, size0=SIZE, size1=SIZE).ok)


def part(corner: tuple[float, float], size: tuple[int, int]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The matches whose both points are in a crop of the images, in its pixels, and its calibrations."""
    h, w = size
    x0, x1 = SCENE.x0 - corner, SCENE.x1 - corner
    inside = ((x0 >= 0) & (x0 < (w, h)) & (x1 >= 0) & (x1 < (w, h))).all(1)
    shift = np.array([[0, 0, corner[0]], [0, 0, corner[1]], [0, 0, 0]])
    return [x0[inside], x1[inside]], [K0 - shift, K1 - shift]


@pytest.mark.parametrize("sizes", [{}, {"size0": (480, 300), "size1": (480, 300)}])
def test_the_principal_point_of_a_crop_may_lie_outside(sizes: dict[str, tuple[int, int]]) -> None:
    """The pose is that of the whole images, alone and in a batch, and nothing is said against K."""
    (x0, x1), Ks = part((340, 0), (480, 300))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = fmtorch.find_essential(x0, x1, *Ks, **sizes)
        batch = fmtorch.find_essential([x0, x0[:40]], [x1, x1[:40]], *Ks, **sizes)
    assert angle(alone.R[0].numpy(), SCENE.R) < 0.5
    assert alone.warning == ("",)
    assert torch.equal(batch.R[0], alone.R[0])
    assert bool(batch.ok.all())


def test_calibrations_of_another_resolution_or_focal_length_are_doubted() -> None:
    """Their pose is off by many degrees, though some matches agree with it."""
    quarter = [np.diag([0.25, 0.25, 1]) @ K for K in (K0, K1)]
    shorter = [K0 * [[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]], K1]
    for Ks, sizes in ((quarter, {}), (quarter, SIZES), (shorter, SIZES)):
        with pytest.warns(UserWarning, match="pair 0: far more matches agree without the calibration"):
            wrong = fmtorch.find_essential(X0, X1, *Ks, **sizes)
        assert "another resolution" in wrong.warning[0]
        assert angle(wrong.R[0].numpy(), SCENE.R) > 2
    with pytest.warns(UserWarning, match="pair 0: far more matches agree without the calibration"):
        assert fmtorch.find_fundamental(X0, X1, focal=((250, 0), (600, 0)), **SIZES).lens_suggested.isnan().all()
    both = [[K, wrong] for K, wrong in zip((K0, K1), quarter, strict=True)]
    with pytest.warns(UserWarning, match="^pair 1: ") as said:
        batch = fmtorch.find_essential([X0, X0], [X1, X1], *both, pair_type=True)
    assert (said[0].filename, batch.warning[0]) == (__file__, "")
    assert "another resolution" in batch.warning[1]


def test_pairs_of_a_batch_stand_for_one_another() -> None:
    """No pair takes its batch down: a small patch of an image may happen, a batch of normalised ones is a mistake."""
    small = 5 + normalized(X0, K0), 5 + normalized(X1, K1)
    both = fmtorch.find_fundamental(np.stack([X0, small[0]]), np.stack([X1, small[1]]))
    assert bool(both.ok[0])
    assert bool((both.F[:1] == fmtorch.find_fundamental(X0, X1).F).all())


def test_what_says_nothing_is_no_mistake() -> None:
    """Points that coincide, too few of them, none that is real: pairs that fail with a reason."""
    zeros, few = np.zeros((20, 2)), normalized(X0[:6], K0)
    for x in (zeros, few, np.full((20, 2), np.nan)):
        estimate = fmtorch.find_fundamental(x, x)
        assert not bool(estimate.ok)
        assert estimate.reason[0]


def found(x0: Any, x1: Any, **said: Any) -> Estimate:
    return fmtorch.find_fundamental(x0, x1, **SIZES | said)


def error_of_lens(estimate: Estimate, F: np.ndarray, i: int = 0) -> float:
    size = torch.tensor(SIZE)
    return float(nsgd(torch.from_numpy(F), estimate.F[i], size, size))


def lenses(estimate: Estimate) -> list[float]:
    return estimate.lens[0].tolist()


@pytest.mark.parametrize(
    ("lens", "fields"),
    [(-0.1, [[-0.1, 0], [-0.1, 0]]), ((-0.1, 0.02), [[-0.1, 0.02], [-0.1, 0.02]]),
     (((-0.1, 0), None), [[-0.1, 0], [0, INF]]), ("shared", [[0, INF], [0, INF]]),
     (np.full((3, 2, 2), 0.1), [[[0.1, 0.1], [0.1, 0.1]]] * 3)],
)  # fmt: skip
def test_forms_of_what_is_known(lens: Any, fields: Any) -> None:
    assert lens_fields(lens)["lens"].tolist() == fields
    assert ("shared_lens" in lens_fields(lens)) == isinstance(lens, str)
    assert lens_fields(None) == {}


@pytest.mark.parametrize("lens", [-0.1, -0.3])
def test_one_unknown_lens(lens: float) -> None:
    x0, x1, F, _ = division.photographs(1, (lens, lens))
    estimate = found(x0, x1, lens="shared")
    assert lenses(estimate) == pytest.approx([lens, lens], abs=0.02)
    assert estimate.warning == ("",)
    known = found(x0, x1, lens=lens)
    assert lenses(known) == pytest.approx([lens, lens], abs=1e-4)
    assert error_of_lens(known, F) < 0.01
    assert error_of_lens(estimate, F) < min(0.01, error_of_lens(found(x0, x1), F))
    right = np.arange(len(x0)) >= len(x0) // 4
    F, inliers = estimate.F[0].numpy(), estimate.inliers[0].numpy()
    assert inliers[right].mean() > 0.97
    assert all(abs(division.sampson(F, x, (SIZE, SIZE), (lens, lens))) < 2.5 for x in np.c_[x0, x1][inliers])


@pytest.mark.parametrize(("lens", "fewest", "most", "below"), [(-0.3, 0, 3, -0.2), (0.0, 19, 24, 0.01)])
def test_few_matches_have_a_lens_where_there_is_a_strong_one(lens, fewest, most, below) -> None:
    """24 pairs of 50 matches, half of them wrong: how many are straight. With a prior about 0 it is 5 and 17."""
    pairs = [division.photographs(seed, (lens, lens), noise=1.0, wrong=0.5) for seed in range(24)]
    chosen = [np.random.default_rng(seed).permutation(len(pair[0]))[:50] for seed, pair in enumerate(pairs)]
    both = ([pair[i][own] for pair, own in zip(pairs, chosen, strict=True)] for i in range(2))
    estimated = found(*both, lens="shared").lens[:, 0]
    assert fewest <= int((estimated == 0).sum()) <= most
    assert float(estimated.nanmedian()) < below


def test_nine_exact_matches_have_the_estimated_lens() -> None:
    """Fitzgibbon's solver, on samples of the same matches: exact ones tell lambda, noisy ones far worse than all."""
    rng, nearest, own = np.random.default_rng(0), [], []
    for noise in (0.0, 0.3):
        x0, x1, _, _ = division.photographs(1, (-0.15, -0.15), noise=noise, wrong=0)
        own.append(abs(lenses(found(x0, x1, lens="shared"))[0] + 0.15))
        samples = [rng.choice(len(x0), 9, replace=False) for _ in range(10)]
        solutions = [division.nine_points(x0[each], x1[each], SIZE) for each in samples]
        nearest.append(np.median([min((abs(value + 0.15) for value, _ in s), default=1.0) for s in solutions]))
    assert nearest[0] < 1e-6
    assert own[0] < 1e-3
    assert own[1] < min(0.02, nearest[1] / 2)


def test_two_lenses_one_of_them_straight() -> None:
    x0, x1, F, _ = division.photographs(3, (-0.2, 0))
    estimate = found(x0, x1, lens="unknown")
    assert lenses(estimate) == pytest.approx([-0.2, 0], abs=0.04)
    rough = found(x0, x1, lens=((-0.15, 0.05), (0, 0)))
    assert lenses(rough) == pytest.approx([-0.2, 0], abs=0.03)
    assert max(error_of_lens(estimate, F), error_of_lens(rough, F)) < 0.007 < error_of_lens(found(x0, x1), F)


def test_a_pose_through_a_lens() -> None:
    x0, x1, _, K = division.photographs(4, (-0.2, -0.2))
    posed = fmtorch.find_essential(x0, x1, K, K, lens="shared", **SIZES)
    for estimate, most in ((posed, 1.0), (found(x0, x1, lens="shared", focal="shared"), 3.0)):
        assert lenses(estimate) == pytest.approx([-0.2, -0.2], abs=0.03)
        cosine = float(estimate.t[0] @ torch.nn.functional.normalize(torch.tensor([-0.8, 0.1, 0.3]).double(), dim=0))
        assert np.degrees(np.arccos(min(cosine, 1))) < most


def test_pairs_keep_to_themselves() -> None:
    pairs = [division.photographs(5, (-0.2, -0.2))[:2], division.photographs(6, (0, 0))[:2]]
    pairs += [(pairs[0][0][:30], np.full((30, 2), 100.0)), division.photographs(7, (-0.2, -0.2), noise=3.0)[:2]]
    together = found([x for x, _ in pairs], [x for _, x in pairs], lens="shared")
    assert together.ok.tolist() == [True, True, False, True]
    for i, pair in enumerate(pairs):
        alone = found(*pair, lens="shared")
        assert torch.equal(together.F[i], alone.F[0])
        assert torch.equal(together.lens[i].nan_to_num(9), alone.lens[0].nan_to_num(9))
    assert together.lens[1].tolist() == [0, 0]
    assert all(torch.equal(together.F[1], found(*pairs[1], lens=lens).F[0]) for lens in (None, 0.0))


def test_coarse_matches_have_lenses_at_their_own_noise() -> None:
    x0, x1, F, _ = zip(*(division.photographs(seed, (-0.2, -0.2), noise=3.0) for seed in range(8)), strict=True)
    both = [found(list(x0), list(x1), lens="shared", coarsest=times) for times in (8, 1)]
    better, worse = (np.median([error_of_lens(e, each, i) for i, each in enumerate(F)]) for e in both)
    assert better < 0.7 * worse
    estimate, points = both[0], np.c_[x0[0], x1[0]]
    distances = [abs(division.sampson(estimate.F[0].numpy(), x, (SIZE, SIZE), lenses(estimate))) for x in points]
    assert estimate.inliers[0, : len(points)].tolist() == [distance <= 1.5 for distance in distances]


def test_sizes_may_be_assumed() -> None:
    x0, x1, F, _ = division.photographs(1, (-0.2, -0.2))
    estimate = fmtorch.find_fundamental(x0, x1, lens="shared")
    assert estimate.sizes.isfinite().all()
    assert lenses(estimate) == pytest.approx([-0.2, -0.2], abs=0.05)
    assert error_of_lens(estimate, F) < 0.02
    centred = fmtorch.find_fundamental(x0 - 300, x1 - 300, lens="shared")
    assert centred.reason == ("a lens needs the image sizes",)


@pytest.mark.parametrize("calibrated", [False, True])
def test_the_type_of_a_pair_is_that_of_the_undistorted_photographs(calibrated: bool) -> None:
    """Of a plane, alone and beside a general pair, whose homography is that of pinholes."""
    lens = -0.25
    x0, x1, _, K = division.photographs(1, (lens, lens))
    y0, y1 = planes(0, lens, wrong=0.0)
    cameras = {"K0": K, "K1": K} if calibrated else {}
    given = {**cameras, "pair_type": True, "seed": 1}
    together = found([y0, x0], [y1, x1], lens=lens, **given, key=[0, 0])
    assert together.pair_type == ("planar", "general")
    alone = found(y0, y1, lens=lens, **given)
    assert alone.pair_type == ("planar",)
    torch.testing.assert_close(alone.homography[0], together.homography[0], rtol=0, atol=0)
    truth = torch.from_numpy(PLANE)[None], torch.tensor([SIZE])
    as_pinholes = found(y0, y1, **given)
    assert float(corner_error(alone.homography, *truth)) < 0.5 < 3 < float(corner_error(as_pinholes.homography, *truth))


@pytest.mark.parametrize(
    ("lens", "cameras"),
    [("shared", "nothing"), ("unknown", "unknown"), ("shared", "known"), (((-0.15, 0.03), None), "shared")],
)
def test_gradients_of_lenses_are_differences_of_optima(lens: Any, cameras: str, monkeypatch: Any) -> None:
    """Of F, lenses, focal lengths and pose to points, noise, prior and K: of converged fits to all matches, since the
    Hessian is Gauss and Newton's; the same bits alone and beside another pair."""
    monkeypatch.setattr(lens_search, "fit_distance", lambda r2, own: 1.0)
    monkeypatch.setattr(lens_search, "FOCAL_TOLERANCE", 0.0)
    monkeypatch.setattr(lens_search, "ITERATIONS", 40)
    *points, _, K = division.photographs(1, (-0.15, -0.15), noise=0.02, wrong=0)
    generator, n = torch.Generator().manual_seed(0), len(points[0])
    given = {"x0": torch.from_numpy(points[0]), "x1": torch.from_numpy(points[1])}
    given |= {"noise": torch.ones(n, dtype=torch.float64), "prior": torch.full((n,), 0.9, dtype=torch.float64)}
    given |= {"K0": torch.from_numpy(K), "K1": torch.from_numpy(K)} if cameras == "known" else {}
    focal = {"focal": cameras} if cameras in ("unknown", "shared") else {}
    ways = {k: torch.randn(v.shape, generator=generator, dtype=torch.float64) * 0.03 for k, v in given.items()}
    ways |= {f"K{i}": torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)) for i in range(2)}
    weight = torch.randn(3, 3, generator=generator, dtype=torch.float64)

    def figures(e: Estimate) -> dict[str, torch.Tensor]:
        by_field = {"F": 1e3 * e.F[0] * weight, "lens": e.lens[0] * weight[0, :2]}
        return by_field if e.R is None else {**by_field, "focals": e.focals[0].log(), "R": e.R[0] * weight}

    leaves = {name: value.clone().requires_grad_() for name, value in given.items()}
    estimate = found(**leaves, **focal, lens=lens)
    for name, figure in figures(estimate).items():
        slopes = torch.autograd.grad(figure.sum(), list(leaves.values()), retain_graph=True)
        ends = []
        for step in (1e-3, -1e-3):
            moved = {k: v + step * ways[k] for k, v in given.items()}
            ends.append(float(figures(found(**moved, **focal, lens=lens))[name].sum()))
        slope = sum(float((g * ways[k]).sum()) for g, k in zip(slopes, leaves, strict=True))
        scale = sum(float((g * ways[k]).norm()) for g, k in zip(slopes, leaves, strict=True))
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-3, abs=0.02 * scale), name
    batch = {k: torch.stack([v.detach(), v.detach()]).requires_grad_() for k, v in leaves.items()}
    together = found(**batch, **focal, lens=lens, key=[0, 1])
    for e, of in ((estimate, leaves), (together, batch)):
        e.F[0].sum().backward(inputs=list(of.values()))
    for name, leaf in leaves.items():
        torch.testing.assert_close(batch[name].grad[0], leaf.grad, rtol=0, atol=0)


def test_a_lens_without_plausible_cameras_has_no_gradients(monkeypatch: Any) -> None:
    """As of crops, whose points would have to be undistorted in the graph."""
    fitted = Ransac._fitted

    def free(self: Ransac, pair: Any, selection: Any, draws: int) -> Any:
        return fitted(self, pair, selection._replace(cameras=None), draws)

    monkeypatch.setattr(Ransac, "_fitted", free)
    x0, x1, F, _ = division.photographs(1, (-0.15, -0.15))
    attached = torch.from_numpy(x0).requires_grad_()
    estimate = found(attached, x1, lens=-0.15)
    estimate.F.sum().backward()
    assert error_of_lens(estimate.detach(), F) < 0.02
    assert not bool(attached.grad.any())


def test_matches_that_contradict_pinholes_suggest_a_lens() -> None:
    """In a batch as alone; nothing is suggested of photographs that are straight, nor where lenses are estimated."""
    bent, straight = division.photographs(2, (-0.1, -0.1)), division.photographs(2, (0.0, 0.0))
    estimate = found([bent[0], straight[0]], [bent[1], straight[1]])
    assert float(estimate.lens_suggested[0]) == pytest.approx(-0.1, abs=0.02)
    assert bool(estimate.lens_suggested[1].isnan())
    assert "give lens='shared'" in estimate.warning[0]
    assert estimate.warning[1] == ""
    alone = found(bent[0], bent[1]).lens_suggested
    assert torch.equal(alone, estimate.lens_suggested[:1])
    assert found(bent[0], bent[1], lens="shared").lens_suggested is None
