"""Calibrated lenses of the public functions, and lenses of homographies, beside points that are undistorted by hand."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

import fmtorch
from fmtorch import Lens
from fmtorch.data import undistorted_points
from fmtorch.metrics import corner_error
from tests.reference import lenses as division

SIZE = (480, 640)
SIZES = {"size0": SIZE, "size1": SIZE}
FISHEYE = Lens(400.0, 410.0, 321.0, 238.0, "OPENCV_FISHEYE", (0.02, -0.01, 0.005, -0.002))
WIDE = Lens(300.0, 310.0, 700.0, 690.0, "OPENCV_FISHEYE", (0.01, -0.002, 0.0, 0.0))
RADIAL = Lens(512.0, 512.0, 319.5, 239.5, "SIMPLE_RADIAL", (-0.15,))
PINHOLE = Lens(512.0, 512.0, 319.5, 239.5)
FOLDED = Lens(512.0, 512.0, 319.5, 239.5, "SIMPLE_RADIAL", (-20.0,))
NAN = Lens(512.0, 512.0, 319.5, 239.5, "SIMPLE_RADIAL", (np.nan,))
PLANE = np.array([[0.95, 0.06, 12], [-0.05, 1.02, -8], [1e-4, -2e-4, 1]])
Array = np.ndarray
FUNDAMENTAL, HOMOGRAPHY = fmtorch.find_fundamental, fmtorch.find_homography
UNKNOWN, KNOWN = {"lens": "shared"} | SIZES, {"K0": PINHOLE.K, "K1": PINHOLE.K}


def photographs(lens0: Lens, lens1: Lens, seed: int = 1) -> tuple[Array, Array]:
    """Matches of a scene of depth in photographs by two lenses whose K are those of the cameras."""
    _, _, _, K = division.photographs(seed, (0.0, 0.0))
    x0, x1, _, _ = division.photographs(seed, (0.0, 0.0), noise=0.0)
    rng, ends = np.random.default_rng(seed), []
    for x, lens in ((x0, lens0), (x1, lens1)):
        x = lens.distort((x - K[:2, 2]) / K[0, 0] * [lens.fx, lens.fy] + [lens.cx, lens.cy])
        ends.append(x + rng.normal(0, 0.3, x.shape))
    return ends[0], ends[1]


def surroundings(seed: int, nearest: float, farthest: float, flat: bool = False) -> tuple[Array, Array, Array, Array]:
    """Matches of what is all around, or flat, at so many degrees from `WIDE`'s axis, a fifth of them wrong; R and t."""
    rng, low, high = np.random.default_rng(seed), *np.cos(np.radians([farthest, nearest]))
    z, azimuth = rng.uniform(low, high, 900), rng.uniform(0, 2 * np.pi, 900)
    X = np.c_[np.sqrt(1 - z * z)[:, None] * np.c_[np.cos(azimuth), np.sin(azimuth)], z]
    X *= 4 / z[:, None] if flat else rng.uniform(3, 12, (900, 1))
    R, t = Rotation.from_rotvec(rng.normal(0, 0.15, 3)).as_matrix(), rng.normal(size=3)
    t /= np.linalg.norm(t)
    Y = X @ R.T + t
    angle = np.degrees(np.arctan2(np.hypot(Y[:, 0], Y[:, 1]), Y[:, 2]))
    X, Y = (Z[(nearest < angle) & (angle < farthest)][:300] for Z in (X, Y))
    ends = [WIDE.distort(Z[:, :2] / Z[:, 2:] @ WIDE.K[:2, :2] + WIDE.K[:2, 2], Z[:, 2] < 0) for Z in (X, Y)]
    x0, x1 = (x + rng.normal(0, 0.5, x.shape) for x in ends)
    return x0, np.r_[rng.permutation(x1[:60]), x1[60:]], R, t


def test_covariances_of_matches_alone_in_lists_and_behind_lenses() -> None:
    x0, x1 = photographs(PINHOLE, PINHOLE)
    C = np.diag([0.3, 2.0]) * np.random.default_rng(0).uniform(0.5, 2, (len(x0), 1, 1))
    alone, part = (FUNDAMENTAL(x0[:n], x1[:n], noise=C[:n], **SIZES) for n in (None, 90))
    listed = FUNDAMENTAL([x0, x0[:90]], [x1, x1[:90]], noise=[C, torch.from_numpy(C[:90])], **SIZES)
    assert torch.equal(listed.F, torch.cat([alone.F, part.F]))
    assert not torch.equal(alone.F, FUNDAMENTAL(x0, x1, noise=np.full(len(x0), 0.77), **SIZES).F)
    bent = Lens(512.0, 512.0, 319.5, 239.5, "SIMPLE_RADIAL", (1e-12,))  # which is there, and bends nothing
    behind = fmtorch.find_essential(x0, x1, noise=C, lens=bent)
    assert_close(behind.F, fmtorch.find_essential(x0, x1, bent.K, bent.K, noise=C).F, rtol=0, atol=1e-7)
    assert bool(HOMOGRAPHY(x0, x1, noise=C).ok.all())
    for wrong, options, said in (
        (-C, {}, "noise of match 0 of pair 0 is nan; it is a standard deviation, positive, or a covariance"),
        (C, {"lens": "shared"}, "needs a lens that is calibrated, not shared"),
    ):
        with pytest.raises(ValueError, match=said):
            FUNDAMENTAL(x0, x1, noise=wrong, **SIZES, **options)


@pytest.mark.parametrize(("nearest", "farthest"), [(0, 75), (0, 100), (80, 100), (95, 120)])
def test_rays_beyond_90_degrees(nearest: float, farthest: float) -> None:
    """In front or behind: the rotation and the direction, with its sign, of 19 scenes of 20, and most inliers."""
    scenes = [surroundings(seed, nearest, farthest) for seed in range(20)]
    together = fmtorch.find_essential([s[0] for s in scenes], [s[1] for s in scenes], lens=WIDE, pair_type=True)
    right = []
    for i, (x0, x1, R, t) in enumerate(scenes):
        pose = together[i]
        if i < 3:
            assert torch.equal(pose.R, fmtorch.find_essential(x0, x1, lens=WIDE).R)
        turned = np.degrees(Rotation.from_matrix(R.T @ pose.R[0].numpy()).magnitude())
        off = np.degrees(np.arccos(np.clip(t @ pose.t[0].numpy(), -1, 1)))
        seen = pose.inliers[0, 60:].float().mean() > 0.95 and pose.pair_type == ("general",)
        right.append(turned < 0.3 and off < 1.5 and seen)
    assert sum(right) >= 19


def by_hand(lenses: tuple[Lens | None, Lens | None], x0: Array, x1: Array) -> tuple[Array, Array, Array]:
    ends, noise = [x0, x1], np.ones(len(x0))
    for i, lens in enumerate(lenses):
        if lens is not None:
            ends[i] = undistorted_points(lens, ends[i])
            noise *= np.abs(np.linalg.det(lens.derivatives(ends[i]))) ** -0.25
    return ends[0], ends[1], noise


def residuals(model: Array, lenses: tuple[Lens | None, Lens | None], x0: Array, x1: Array, plane: bool) -> Array:
    """Tangent Sampson errors of F or H, px: corrections of photographs' points to its constraint, by differences."""

    def constraint(x: Array) -> Array:
        ends = [x[:, :2], x[:, 2:]]
        seen = [end if lens is None else undistorted_points(lens, end) for lens, end in zip(lenses, ends, strict=True)]
        h0, h1 = (np.c_[end, np.ones(len(end))] for end in seen)
        at = h0 @ model.T
        return at[:, :2] - at[:, 2:] * h1[:, :2] if plane else (at * h1).sum(1, keepdims=True)

    x = np.c_[x0, x1]
    J, e = np.stack([constraint(x + d) - constraint(x - d) for d in 0.01 * np.eye(4)], -1) / 0.02, constraint(x)
    return np.sqrt((e * np.linalg.solve(J @ J.swapaxes(1, 2), e[..., None])[..., 0]).sum(1))


def with_noise(find: Any, lenses: Any, x0: Array, x1: Array, **known: Any) -> Any:
    """The estimate of undistorted matches whose noise is that across the lines, or towards the points, of one."""
    (*ends, noise), plane = by_hand(lenses, x0, x1), find is HOMOGRAPHY
    first = find(*ends, noise=noise, **known).matrix[0].numpy()
    of = residuals(first, (None, None), *ends, plane) / residuals(first, lenses, x0, x1, plane)
    return find(*ends, noise=of, **known)


def test_right_matches_of_planes_are_inliers() -> None:
    """Of a fish-eye of 150 degrees, where a pinhole has many times the pixels."""
    x0, x1, _, _ = surroundings(2, 0, 75, flat=True)
    plane = fmtorch.find_homography(x0, x1, lens=WIDE)
    r = residuals(plane.H[0].numpy(), (WIDE, WIDE), x0, x1, True)
    assert plane.inliers[0].tolist() == (r <= 2.5).tolist()
    assert plane.inliers[0, 60:].all()


@pytest.mark.parametrize("lenses", [(FISHEYE, FISHEYE), (RADIAL, FISHEYE), (RADIAL, None)])
def test_points_are_as_undistorted_by_hand(lenses: tuple[Lens, Lens | None]) -> None:
    x0, x1 = photographs(lenses[0], lenses[1] or PINHOLE)
    before = x0.copy()
    second = {"K1": PINHOLE.K} if lenses[1] is None else {}
    given = fmtorch.find_fundamental(x0, x1, lens=lenses, **second, pair_type=True, covariance=True)
    assert np.array_equal(x0, before)
    K = {"K0": lenses[0].K, "K1": (lenses[1] or PINHOLE).K}
    known = with_noise(FUNDAMENTAL, lenses, x0, x1, **K)
    assert_close(given.F, known.F, rtol=0, atol=2e-5)
    assert_close(given.t, known.t, rtol=0, atol=2e-3)
    assert given.inliers[0].tolist() == (residuals(given.F[0].numpy(), lenses, x0, x1, False) <= 1.5).tolist()
    assert given.pair_type == ("general",)
    truth = torch.nn.functional.normalize(torch.tensor([-0.8, 0.1, 0.3]).double(), dim=0)
    assert torch.rad2deg(torch.arccos(given.t[0] @ truth)) < 1
    assert_close(fmtorch.find_essential(x0, x1, lens=lenses, **second).t, given.t, rtol=0, atol=0.02)


def test_a_lens_that_does_not_bend_changes_nothing() -> None:
    x0, x1, _, K = division.photographs(2, (0.0, 0.0))
    pinhole = Lens(K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    given, known = fmtorch.find_essential(x0, x1, lens=pinhole), fmtorch.find_essential(x0, x1, K, K)
    assert torch.equal(given.F, known.F)
    plane = fmtorch.find_homography(x0, x1, lens=pinhole)
    assert torch.equal(plane.H, fmtorch.find_homography(x0, x1).H)


@pytest.mark.parametrize("find", [fmtorch.find_fundamental, fmtorch.find_homography])
def test_pairs_keep_to_themselves(find: Any) -> None:
    """Beside others, padded, in another order, and beside a lens that is none and one that folds."""
    pairs = [planes(3, RADIAL), photographs(RADIAL, FISHEYE), photographs(FISHEYE, FISHEYE, 5)]
    lenses: list[Any] = [(RADIAL, RADIAL), (RADIAL, FISHEYE), (FISHEYE, FISHEYE), (FOLDED, RADIAL), (NAN, RADIAL)]
    pairs = [*pairs, pairs[0], pairs[0]]
    together = find([x for x, _ in pairs], [x for _, x in pairs], lens=lenses)
    for i in range(3):
        alone = find(*pairs[i], lens=lenses[i])
        assert torch.equal(together.matrix[i], alone.matrix[0])
        assert torch.equal(together.inliers[i, : len(pairs[i][0])], alone.inliers[0])
    assert together.ok.tolist()[3:] == [False, False]
    assert re.match(r"pinholes see \d+ of \d+ matches: the lens folds there", together.reason[3])
    assert together.reason[4] == "the lens of image 0 has coefficients that are not finite"
    assert not together.inliers[3:].any()
    assert find(*pairs[0], lens=FOLDED).reason[0].startswith("pinholes see")


@pytest.mark.parametrize("find", [fmtorch.find_fundamental, fmtorch.find_homography])
def test_gradients_reach_the_photographs_points(find: Any) -> None:
    """By finite differences, with the noise of the matches as it is."""
    x0, x1 = planes(3, RADIAL) if find is fmtorch.find_homography else photographs(RADIAL, RADIAL)
    points = [torch.from_numpy(x).requires_grad_() for x in (x0, x1)]
    direction = torch.from_numpy(np.random.default_rng(0).normal(size=(3, 3)))
    estimate = find(*points, lens=RADIAL)
    (estimate.matrix[0] * direction).sum().backward()
    inliers = estimate.inliers[0].nonzero()[:, 0].tolist()
    for image, i, axis in ((0, inliers[3], 0), (1, inliers[8], 1), (0, inliers[11], 1)):
        values = []
        for step in (0.05, -0.05):
            moved = [x0.copy(), x1.copy()]
            moved[image][i, axis] += step
            values.append(float((find(*moved, lens=RADIAL).matrix[0] * direction).sum()))
        slopes = (values[0] - values[1]) / 0.1, float(points[image].grad[i, axis])
        assert slopes[1] == pytest.approx(slopes[0], rel=0.05, abs=0.05 * float(points[image].grad.abs().max()))


@pytest.mark.parametrize(
    ("find", "said", "message"),
    [
        (FUNDAMENTAL, {"lens": NAN}, "the lens of image 0 has coefficients that are not finite"),
        (FUNDAMENTAL, {"lens": (None, Lens(-1.0, 1.0, 0.0, 0.0))}, "K of the lens of image 1 has focal lengths -1, 1"),
        (FUNDAMENTAL, {"lens": (RADIAL, -0.1)}, "holds a calibrated lens, so it must be a lens for both images"),
        (FUNDAMENTAL, {"lens": [(RADIAL, None), (None, RADIAL)]}, "lens has lenses for 2 pairs of 1"),
        (FUNDAMENTAL, {"lens": RADIAL, "K0": PINHOLE.K}, "K0 and a lens of image 0 are given, and the lens has"),
        (FUNDAMENTAL, {"lens": (RADIAL, None)}, "K0 alone needs the image sizes: give size0 and size1"),
        (FUNDAMENTAL, {"lens": "fisheye"} | SIZES, "lens is 'fisheye'; it must be None, 'unknown', 'shared', lambda"),
        (FUNDAMENTAL, {"lens": -0.6} | SIZES, "lens of image 0 of pair 0 is [-0.6, 0.0]; it is lambda in half diag"),
        (FUNDAMENTAL, {"lens": (-0.1, -1)} | SIZES, "lens of image 0 of pair 0 is"),
        *((find, {"lens": (RADIAL, FOLDED)} | SIZES, "image 1: its lens folds") for find in (FUNDAMENTAL, HOMOGRAPHY)),
        (FUNDAMENTAL, {"lens": (-0.1, None)} | SIZES, "lens is (-0.1, None); it must be None, 'unknown', 'shared', la"),
        (FUNDAMENTAL, {"lens": (0.1, 0.1, 0.1)} | SIZES, "lens has shape (3,)"),
        (FUNDAMENTAL, {"lens": "shared", "size0": "unknown", "size1": "unknown"}, "lens needs the image sizes"),
        (FUNDAMENTAL, {"lens": "shared"} | KNOWN, "lens needs the image"),
        (FUNDAMENTAL, UNKNOWN | {"estimator": "ransac"}, "lens needs an estimator with the option focal"),
        (fmtorch.find_essential, KNOWN | {"estimator": "homography"}, "needs one that gives fundamental matrices"),
        (HOMOGRAPHY, {"lens": -0.1}, "lens needs the image sizes, in whose half diagonals it is: give size0 and size1"),
        (HOMOGRAPHY, {"lens": -0.6} | SIZES, "lens of image 0 of pair 0 is [-0.6, 0.0]; it is lambda in half diag"),
        (HOMOGRAPHY, {"lens": "fisheye"} | SIZES, "lens is 'fisheye'; it must be None, 'unknown', 'shared', lambda"),
        (HOMOGRAPHY, {"lens": (-0.1, 0.02)} | SIZES, "must be a calibrated lens, lambda (exactly known), 'shared'"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(find: Any, said: dict[str, Any], message: str) -> None:
    x0, x1 = photographs(RADIAL, RADIAL)
    with pytest.raises((TypeError, ValueError), match=re.escape(message)):
        find(x0, x1, **said)
    with pytest.raises(ValueError, match="lens is given, and its estimates have no gradients"):
        fmtorch.find_homography(torch.from_numpy(x0).requires_grad_(), x1, **UNKNOWN)


def test_lenses_are_of_known_models_with_all_coefficients() -> None:
    for model, coefficients, said in (
        ("MAGIC", (), "lens model 'MAGIC'; there are: SIMPLE_PINHOLE, "),
        ("OPENCV", (0.1,), "a lens of the model OPENCV has coefficients k1, k2, p1, p2; 1 are given"),
        ("PINHOLE", 0.1, "of the model PINHOLE has no coefficients; 1 are given"),
        ("SIMPLE_RADIAL", "a", "a lens has 'a' among its parameters; they must be numbers"),
    ):
        with pytest.raises((TypeError, ValueError), match=said):
            Lens(500.0, 500.0, 320.0, 240.0, model, coefficients)  # type: ignore[arg-type]
    assert Lens(1, 1, 0, 0, "RADIAL", torch.ones(2)) == Lens(1, 1, 0, 0, "RADIAL", (1.0, 1.0))  # type: ignore[arg-type]
    x0, x1 = photographs(RADIAL, RADIAL)
    with pytest.raises(ValueError, match="lens has None for image 0 of some pairs"):
        fmtorch.find_fundamental(x0[None].repeat(2, 0), x1[None].repeat(2, 0), lens=[(RADIAL, None), (None, RADIAL)])


def test_normalised_points_have_no_lens() -> None:
    x0, x1 = photographs(RADIAL, RADIAL)
    for find in (fmtorch.find_essential, fmtorch.find_homography):
        with pytest.raises(ValueError, match="x0 runs from"):
            find(x0 / 500, x1 / 500, lens=RADIAL)
    with pytest.raises(ValueError, match="K1 is None"):
        fmtorch.find_essential(x0, x1, lens=(RADIAL, None))


def planes(seed: int, lens: Lens | float | tuple[float, float], wrong: float = 0.25) -> tuple[Array, Array]:
    """Matches of a plane in two photographs, whose homography between pinholes is PLANE."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform([20, 20], [620, 460], (300, 2))
    x1 = np.c_[x0, np.ones(len(x0))] @ PLANE.T
    ends = [x0, x1[:, :2] / x1[:, 2:]]
    for i, x in enumerate(ends):
        if isinstance(lens, Lens):
            ends[i] = lens.distort(x)
        else:
            ends[i] = np.array([division.bent(each, SIZE, np.broadcast_to(lens, 2)[i]) for each in x])
        ends[i] = ends[i] + rng.normal(0, 0.3, x.shape)
    ends[1][: int(wrong * len(x0))] = rng.permutation(ends[1][: int(wrong * len(x0))])
    inside = np.all([((x >= 0) & (x < (640, 480))).all(1) for x in ends], 0)
    return ends[0][inside], ends[1][inside]


def error(estimate: Any, i: int = 0) -> float:
    return float(corner_error(estimate.H[i : i + 1], torch.from_numpy(PLANE)[None], torch.tensor([SIZE])))


@pytest.mark.parametrize("lens", [-0.05, -0.3, (-0.2, 0.1)])
def test_a_known_lambda_of_a_plane(lens: Any) -> None:
    x0, x1 = planes(1, lens)
    pair = lens if isinstance(lens, tuple) else (lens, lens)
    attached = torch.from_numpy(x0).requires_grad_()
    known = fmtorch.find_homography(attached, x1, lens=[(value, 0.0) for value in pair], **SIZES)
    known.H[0, 0, 0].backward()
    assert bool(attached.grad.isfinite().all() & attached.grad.any())
    known = known.detach()
    assert error(known) < min(0.5, error(fmtorch.find_homography(x0, x1)) / 4)
    assert known.lens[0].tolist() == pytest.approx(pair)
    half = float(np.hypot(*SIZE)) / 2
    models = [Lens(half, half, 319.5, 239.5, "SIMPLE_DIVISION", (value,)) for value in pair]
    expected = with_noise(HOMOGRAPHY, models, x0, x1)
    assert_close(known.H, expected.H, rtol=0, atol=1e-4)  # 7e-4 where all directions count alike


@pytest.mark.parametrize(("lens", "which"), [(-0.1, "shared"), (-0.3, "shared"), ((-0.2, 0.0), "unknown")])
def test_an_unknown_lens_of_a_plane(lens: Any, which: Any) -> None:
    x0, x1 = planes(2, lens)
    estimate = fmtorch.find_homography(x0, x1, lens=which, **SIZES)
    assert estimate.lens[0].tolist() == pytest.approx(np.broadcast_to(lens, 2), abs=0.02)
    assert error(estimate) < min(1.5, error(fmtorch.find_homography(x0, x1)) / 2)


def test_planes_keep_to_themselves() -> None:
    """Bent ones, a straight one, which is that without a lens to the bit, and one that shows nothing."""
    pairs = [planes(1, -0.2), planes(2, 0.0), (np.full((30, 2), 100.0), planes(1, 0.0)[1][:30]), planes(3, -0.1)]
    together = fmtorch.find_homography([x for x, _ in pairs], [x for _, x in pairs], lens="shared", **SIZES)
    assert (together.ok.tolist(), together.lens[1].tolist()) == ([True, True, False, True], [0, 0])
    assert together.lens[2].isnan().all()
    assert torch.equal(together.H[1], fmtorch.find_homography(*pairs[1]).H[0])
    for i in (0, 3):
        alone = fmtorch.find_homography(*pairs[i], lens="shared", **SIZES)
        assert torch.equal(together.H[i], alone.H[0])
        assert torch.equal(together.lens[i], alone.lens[0])


def test_a_lens_of_a_photograph_of_a_map() -> None:
    x0, x1 = planes(4, RADIAL)
    board = undistorted_points(RADIAL, x0) / 1000
    estimate = fmtorch.find_homography(board, x1, lens=(None, RADIAL))
    estimate = estimate.derived(matrix=estimate.H @ torch.diag(torch.tensor([1e-3, 1e-3, 1.0])).double())
    assert error(estimate) < 1


@pytest.mark.parametrize("find", [fmtorch.find_fundamental, fmtorch.find_homography])
@pytest.mark.parametrize("garbage", [np.nan, np.inf, 1e30, 0.0])
def test_what_stands_in_masked_slots_means_nothing(find: Any, garbage: float) -> None:
    x0, x1 = planes(3, FISHEYE) if find is fmtorch.find_homography else photographs(FISHEYE, FISHEYE)
    gradients = []
    for slots in (0, 7):
        padded = [np.concatenate([x, np.full((slots, 2), garbage)])[None] for x in (x0, x1)]
        points = [torch.from_numpy(x).requires_grad_() for x in padded]
        mask = np.arange(len(x0) + slots)[None] < len(x0)
        estimate = find(*points, mask=mask, lens=FISHEYE)
        estimate.matrix.sum().backward()
        gradients.append((estimate.matrix.detach(), *(x.grad[:, : len(x0)] for x in points)))
        assert all(float(x.grad[:, len(x0) :].abs().sum()) == 0 for x in points)
    assert torch.equal(gradients[0][0], gradients[1][0])
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-16)  # whose sums have other last bits


def test_frames_go_with_their_points() -> None:
    x0, x1 = photographs(RADIAL, RADIAL)
    y0, y1, noise = by_hand((RADIAL, RADIAL), x0, x1)
    axes = np.random.default_rng(0).normal(size=(len(x0), 2, 2)) + 5 * np.eye(2)
    before, after = [], []
    for x, y in ((x0, y0), (x1, y1)):
        before.append(np.concatenate([axes, x[..., None]], -1))
        straightened = np.linalg.solve(RADIAL.derivatives(y), axes)
        after.append(np.concatenate([straightened, y[..., None]], -1))
    ratio = np.linspace(0.3, 0.9, len(x0))
    estimate = fmtorch.find_essential(x0, x1, lens=RADIAL, ratio=ratio, lafs0=before[0], lafs1=before[1])
    known = fmtorch.find_essential(y0, y1, *[RADIAL.K] * 2, noise=noise, ratio=ratio, lafs0=after[0], lafs1=after[1])
    assert_close(estimate.F, known.F, rtol=1e-3, atol=5e-6)  # its noise is of no direction
