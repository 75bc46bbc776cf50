"""`fmtorch.cv2` takes the calls of OpenCV's documentation and returns what OpenCV returns."""

from typing import Any

import cv2 as opencv
import numpy as np
import pytest

from fmtorch import cv2
from tests.estimators.pairs import apart
from tests.reference.homography import mapped
from tests.reference.known_cameras import K0, SIZE, angle, scene
from tests.reference.solvers import homogeneous, sampson, skew

SCENE = scene(3, 200, noise=0.3, cameras=(K0, K0))
PTS1, PTS2 = SCENE.x0, SCENE.x1
EPIPOLAR_FLAGS = ("FM_RANSAC", "FM_LMEDS", "USAC_DEFAULT", "USAC_FAST", "USAC_ACCURATE", "USAC_PROSAC", "USAC_MAGSAC")
FORMS = (np.float32, np.float64, np.int32, lambda x: x[:, None], lambda x: x[None], np.ndarray.tolist)


def both(name: str, *arguments: Any, **named: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """What OpenCV and this project return of one call."""
    return getattr(opencv, name)(*arguments, **named), getattr(cv2, name)(*arguments, **named)


def expect_same_kind(theirs: tuple[Any, ...], ours: tuple[Any, ...]) -> None:
    """Same number of values, of the same types and shapes."""
    assert len(theirs) == len(ours)
    for a, b in zip(theirs, ours, strict=True):
        assert type(a) is type(b)
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.shape) == (b.dtype, b.shape)


def homography_points(wrong: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    H = np.array([[0.9, -0.1, 40], [0.08, 0.95, -10], [1e-4, -5e-5, 1]])
    x = rng.uniform([0, 0], SIZE[::-1], (120, 2))
    y = mapped(H, x)
    bad = rng.random(120) < wrong
    y[bad] = rng.uniform([0, 0], SIZE[::-1], (int(bad.sum()), 2))
    return x, y, H


def test_epipolar_geometry_tutorial() -> None:
    """py_epipolar_geometry: whole numbers, F and a mask that selects points by `mask.ravel() == 1`."""
    pts1, pts2 = np.int32(PTS1), np.int32(PTS2)
    theirs, (F, mask) = both("findFundamentalMat", pts1, pts2, cv2.FM_LMEDS)
    expect_same_kind(theirs, (F, mask))
    pts1, pts2 = pts1[mask.ravel() == 1], pts2[mask.ravel() == 1]
    assert 0.5 * SCENE.right.sum() < len(pts1) < 1.2 * SCENE.right.sum()
    lines1 = cv2.computeCorrespondEpilines(pts2.reshape(-1, 1, 2), 2, F)  # OpenCV's own, by the same module
    assert lines1.reshape(-1, 3).shape == (len(pts1), 3)


def test_ransac_with_threshold_and_confidence() -> None:
    """The call of the reference, `findFundamentalMat(points1, points2, FM_RANSAC, 3, 0.99)`, and its other forms."""
    theirs, ours = both("findFundamentalMat", PTS1, PTS2, cv2.FM_RANSAC, 3, 0.99)
    expect_same_kind(theirs, ours)
    F, mask = ours
    assert F[2, 2] == 1
    assert float((mask.ravel() == SCENE.right).mean()) > 0.9
    for form in (PTS1[:, None], PTS1[None], PTS1.tolist(), np.asfortranarray(PTS1)):
        np.testing.assert_array_equal(cv2.findFundamentalMat(form, PTS2, cv2.FM_RANSAC, 3, 0.99)[0], F)
    scaled, plain = 2 * homogeneous(PTS1), homogeneous(PTS2)[:, None]
    np.testing.assert_allclose(cv2.findFundamentalMat(scaled, plain, cv2.FM_RANSAC, 3, 0.99)[0], F, rtol=1e-9)
    out = np.zeros((200, 1), np.uint8)
    cv2.findFundamentalMat(PTS1, PTS2, cv2.FM_RANSAC, 3, 0.99, out)
    np.testing.assert_array_equal(out, mask)
    expect_same_kind(*both("findFundamentalMat", PTS1, PTS2, cv2.FM_RANSAC, 3, 0.99, 500))
    by_name = {"method": cv2.USAC_MAGSAC, "ransacReprojThreshold": 1.0, "confidence": 0.999, "maxIters": 500}
    expect_same_kind(*both("findFundamentalMat", PTS1, PTS2, **by_name))
    for usual in (0, -1):  # is a threshold of 3
        np.testing.assert_array_equal(cv2.findFundamentalMat(PTS1, PTS2, cv2.FM_RANSAC, usual, 0.99)[0], F)
        expect_same_kind(*both("findHomography", PTS1, PTS2, cv2.RANSAC, usual))
    few = cv2.findFundamentalMat(PTS1, PTS2, cv2.FM_RANSAC, 0.2)[1]
    assert few.sum() < 0.7 * mask.sum()


@pytest.mark.parametrize("flag", EPIPOLAR_FLAGS)
def test_every_flag_gives_the_right_geometry(flag: str) -> None:
    F, mask = cv2.findFundamentalMat(PTS1, PTS2, getattr(cv2, flag))
    assert np.median(np.abs(sampson(F, PTS1, PTS2))[SCENE.right]) < 0.35
    assert float(mask.ravel()[SCENE.right].mean()) > 0.8
    E, inliers = cv2.findEssentialMat(PTS1, PTS2, K0, getattr(cv2, flag))
    R = cv2.recoverPose(E, PTS1, PTS2, K0, mask=inliers)[1]
    assert angle(R, SCENE.R) < 1.5


def test_methods_of_all_points_are_opencvs() -> None:
    for points, method in ((7, cv2.FM_7POINT), (60, cv2.FM_8POINT)):
        theirs, ours = both("findFundamentalMat", PTS1[:points], PTS2[:points], method)
        np.testing.assert_array_equal(theirs[0], ours[0])
    x, y, _ = homography_points(wrong=0.0)
    theirs, ours = both("findHomography", x, y)
    np.testing.assert_array_equal(theirs[0], ours[0])
    x[3, 0] = np.nan
    of_F, of_H = cv2.findFundamentalMat, cv2.findHomography
    for count, function, method in ((7, of_F, cv2.FM_7POINT), (60, of_F, cv2.FM_8POINT), (60, of_H, 0)):
        assert function(x[:count], y[:count], method)[0] is None


def test_nothing_where_opencv_has_nothing() -> None:
    assert both("findFundamentalMat", PTS1[:5], PTS2[:5], cv2.FM_RANSAC) == ((None, None), (None, None))
    assert both("findEssentialMat", PTS1[:3], PTS2[:3], K0)[1] == (None, None)
    same = np.ones((30, 2)) * 50
    assert cv2.findFundamentalMat(same, same) == (None, None)
    (H, _), (own, mask) = both("findHomography", same, same, cv2.RANSAC, 5.0)
    assert (H, own) == (None, None)
    assert (mask.dtype, mask.shape, int(mask.sum())) == (np.uint8, (30, 1), 0)


def test_feature_homography_tutorial() -> None:
    """py_feature_homography: float32 (n, 1, 2), `M, mask = cv.findHomography(src_pts, dst_pts, cv.RANSAC, 5.0)`."""
    x, y, H = homography_points()
    src_pts, dst_pts = np.float32(x).reshape(-1, 1, 2), np.float32(y).reshape(-1, 1, 2)
    theirs, ours = both("findHomography", src_pts, dst_pts, cv2.RANSAC, 5.0)
    expect_same_kind(theirs, ours)
    matches_mask = ours[1].ravel().tolist()
    assert matches_mask == theirs[1].ravel().tolist()
    np.testing.assert_allclose(ours[0], H, rtol=1e-3, atol=1e-5)
    corners = np.float32([[0, 0], [0, 479], [639, 479], [639, 0]]).reshape(-1, 1, 2)
    assert np.abs(cv2.perspectiveTransform(corners, ours[0]) - cv2.perspectiveTransform(corners, H)).max() < 0.05
    for method in (cv2.LMEDS, cv2.RHO, cv2.USAC_MAGSAC):
        np.testing.assert_allclose(cv2.findHomography(x, y, method)[0], H, rtol=1e-3, atol=1e-5)


def test_essential_matrices_in_all_forms() -> None:
    """`findEssentialMat(points1, points2, cameraMatrix, RANSAC, 0.999, 1.0)` of the reference, and its overloads."""
    theirs, ours = both("findEssentialMat", PTS1, PTS2, K0, cv2.RANSAC, 0.999, 1.0)
    expect_same_kind(theirs, ours)
    number, R, t, mask = cv2.recoverPose(ours[0], PTS1, PTS2, K0, mask=ours[1].copy())
    assert angle(R, SCENE.R) < 0.5
    assert float(t[:, 0] @ SCENE.t) > 0.999
    assert number == np.count_nonzero(mask)
    none = np.zeros(5)
    by_two = cv2.findEssentialMat(PTS1, PTS2, K0, none, K0, none, cv2.RANSAC, 0.999, 1.0)
    np.testing.assert_allclose(by_two[0], ours[0], rtol=0, atol=1e-12)
    square = cv2.findEssentialMat(PTS1, PTS2, focal=510.0, pp=(310, 250), method=cv2.RANSAC, prob=0.999, threshold=3.0)
    assert angle(cv2.recoverPose(square[0], PTS1, PTS2, K0)[1], SCENE.R) < 5
    theirs, ours = both("recoverPose", PTS1, PTS2, K0, none, K0, none)
    expect_same_kind(theirs, ours)
    assert angle(ours[2], SCENE.R) < 0.5


def test_wrong_arguments_are_named() -> None:
    for arguments, said in (
        ((PTS1, PTS2, 3), "method is 3; it must be one of"),
        ((PTS1.ravel(), PTS2), r"points1 has shape \(400,\)"),
        ((PTS1 / 1000, PTS2 / 1000), "no pixels"),
        ((PTS1, PTS2[:50]), "must be equal"),
        ((PTS1, PTS2.astype(str)), "points2 is a ndarray of <U32; it must be an array or tensor of numbers"),
        ((np.ma.masked_less(PTS1, 300), PTS2), "points1 is a masked array; give its data"),
        ((PTS1, PTS2, opencv.UsacParams()), "UsacParams are of OpenCV's own search"),
    ):
        with pytest.raises((ValueError, TypeError), match=said):
            cv2.findFundamentalMat(*arguments)
    with pytest.raises(TypeError, match="findEssentialMat takes points1, points2, cameraMatrix, method"):
        cv2.findEssentialMat(PTS1, PTS2, K0, focal=3)


def test_points_in_another_unit_with_a_threshold_in_it() -> None:
    """Of a focal length of one, as VIO programs give them: matches are told apart as in pixels."""
    for unit in (1.0, 1e7):
        n1, n2 = (unit * mapped(np.linalg.inv(K0), x) for x in (PTS1, PTS2))
        F, mask = cv2.findFundamentalMat(n1, n2, cv2.FM_RANSAC, unit * 1.5 / 510, 0.999)
        assert float((mask.ravel() == SCENE.right).mean()) > 0.9
        S = np.diag([unit, unit, 1])
        assert apart(S @ F @ S, skew(SCENE.t) @ SCENE.R) < 0.05
        assert float((cv2.findFundamentalMat(n1, n2, cv2.FM_LMEDS)[1].ravel() == SCENE.right).mean()) > 0.9
        E, mask = cv2.findEssentialMat(n1, n2, S, cv2.RANSAC, 0.999, unit / 510)
        assert angle(cv2.recoverPose(E, n1, n2, S)[1], SCENE.R) < 0.5
        assert float((mask.ravel() == SCENE.right).mean()) > 0.9
    x, y, H = homography_points()
    right = cv2.findHomography(x, y, cv2.RANSAC, 3.0)[1].ravel().tolist()
    corners = np.array([[0, 0], [640, 0], [640, 480], [0, 480.0]])
    far = np.array([5e5, 4.2e6])  # on a map, in m; without it a board in m, a court in m, mm
    units = [(500, 500, 0), (5e5, 5e5, 0), (1000, 1, 0), (1, 40, 0), (1, 0.025, 0), (1, 2e-4, 0)]
    for u, v, at in (*units, (1, 1, far), (1, 40, far), (1, 0.025, far)):
        homography, inliers = cv2.findHomography(x / u, y / v + at, cv2.RANSAC, 3 / v)
        assert np.abs(v * (mapped(homography, corners / u) - at) - mapped(H, corners)).max() < 0.05
        assert inliers.ravel().tolist() == right


@pytest.mark.parametrize("name", ["findFundamentalMat", "findHomography", "findEssentialMat"])
def test_the_mask_is_zeroed_where_there_is_no_model(name: str) -> None:
    same, mask = np.tile([[40.0, 90.0]], (15, 1)), np.ones((15, 1), np.uint8)
    given = {"findEssentialMat": (K0,)}.get(name, ())
    assert getattr(cv2, name)(same, same + 7, *given, method=cv2.RANSAC, mask=mask)[0] is None
    assert not mask.any()


def test_eight_points_that_determine_no_matrix_have_none() -> None:
    """Of a plane, exactly: OpenCV returns one of the many."""
    x, y, _ = homography_points(wrong=0.0)
    assert opencv.findFundamentalMat(x, y, cv2.FM_8POINT)[0] is not None
    mask = np.ones((120, 1), np.uint8)
    assert cv2.findFundamentalMat(x, y, cv2.FM_8POINT, mask=mask) == (None, None)
    assert not mask.any()


@pytest.mark.parametrize("baseline", [0.004, 0.04])
def test_poses_of_small_baselines(baseline: float) -> None:
    rng = np.random.default_rng(1)
    X = np.c_[rng.uniform(-2, 2, (120, 2)), rng.uniform(3, 9, 120)]
    t = np.array([0.8, 0.1, 0.59])
    x1, x2 = ((Y / Y[:, 2:] @ K0.T)[:, :2] for Y in (X, X + baseline * t))
    E, mask = cv2.findEssentialMat(x1, x2, K0)
    R, out = np.zeros((3, 3)), np.zeros((3, 1))
    number, rotation, direction, _ = cv2.recoverPose(E, x1, x2, K0, R, out, mask.copy())
    assert number == 120
    assert angle(rotation, np.eye(3)) < 0.01
    assert float(direction[:, 0] @ t / np.linalg.norm(t)) > 0.999
    np.testing.assert_array_equal(R, rotation)
    assert cv2.recoverPose(E=E, points1=x1, points2=x2, cameraMatrix=K0)[0] == 120
    assert cv2.recoverPose(E, *(mapped(np.linalg.inv(K0), x) for x in (x1, x2)))[0] == 120
    assert cv2.recoverPose(x1, x2, K0, None, K0, None)[0] == 120


def test_undistortion_runs_to_its_end() -> None:
    """A wide lens, exact matches: OpenCV's five steps leave 0.1 degrees."""
    rng = np.random.default_rng(3)
    bend, K = np.array([-0.33, 0.13, 0.001, 0, -0.02]), np.array([[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1.0]])
    X = np.c_[rng.uniform(-3, 3, (200, 2)), rng.uniform(3, 6, 200)]
    X = X[np.hypot(X[:, 0], X[:, 1]) / X[:, 2] < 1]
    Y = X @ SCENE.R.T + [0.4, 0.1, 0.2]
    x1, x2 = (opencv.projectPoints(Z, np.zeros(3), np.zeros(3), K, bend)[0][:, 0] for Z in (X, Y))
    R = cv2.recoverPose(x1, x2, K, bend, K, bend)[2]
    assert angle(R, SCENE.R) < 0.005
    E, _ = cv2.findEssentialMat(x1, x2, K, bend, K, bend)
    assert angle(cv2.recoverPose(E, *(Z[:, :2] / Z[:, 2:] for Z in (X, Y)), np.eye(3))[1], SCENE.R) < 0.01


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["findFundamentalMat", "findHomography", "findEssentialMat"])
def test_generated_calls_return_what_opencv_returns(name: str, seed: int) -> None:
    """Kinds, shapes and types of values for any form, count and arrangement; the differences are in the guide."""
    rng = np.random.default_rng(seed)
    forms = FORMS[: len(FORMS) - (name == "findEssentialMat")]
    for k, kind in enumerate(("sound", "few", "minimal", "collinear", "coincident")):
        count = {"few": 3, "minimal": 8}.get(kind, 60)
        at = rng.permutation(200)[:count]
        x1, x2 = PTS1[at], PTS2[at]
        if kind == "collinear":
            x1, x2 = (np.outer(np.arange(60), [7.0, 3]) + shift for shift in ([5, 9], [30, 2]))
        if kind == "coincident":
            x1, x2 = (np.tile(x[:1], (60, 1)) for x in (x1, x2))
        form = forms[(k + 5 * seed) % len(forms)]
        a, b = form(x1), form(x2)
        given = (a, b, K0) if name == "findEssentialMat" else (a, b)
        method = int(rng.choice([cv2.RANSAC, cv2.LMEDS, cv2.USAC_MAGSAC]))
        try:
            theirs = getattr(opencv, name)(*given, method=method)
        except (opencv.error, TypeError):
            theirs = None
        ours = getattr(cv2, name)(*given, method=method) if theirs is not None else None
        if theirs is None or ours is None or ours[0] is None:
            assert kind != "sound" or theirs is None
            continue
        assert ours[0].shape == (3, 3)
        assert (ours[1].dtype, ours[1].shape) == (np.uint8, (count, 1))
        if kind == "sound" and theirs[0] is not None:
            expect_same_kind(theirs, ours)
