"""Two photographs: the function, the command, and the name `fmtorch.match` that both have."""

import dataclasses
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from PIL import Image

import fmtorch
from fmtorch import presets
from fmtorch.commands import match as match_command
from fmtorch.commands.match import pose_line
from fmtorch.core import WARNINGS, conf_dir
from fmtorch.data import ImageError, ImagePair, Lens, load, read_image, undistorted_points
from fmtorch.geometry import homography_points, sampson
from fmtorch.metrics import nsgd
from fmtorch.pipeline import PhotographCameras, load_pipeline
from tests.conftest import shared_path
from tests.data.test_images import with_exif
from tests.helpers import ROWS, write_file
from tests.matching import stand_in
from tests.reference.known_cameras import pose_error

BANDS = (30, 5, 42, 18, 36, 11)  # disparities of bands of the picture, from the top, in 1/640 of its width
SIDE = 768  # px, to which photographs are reduced for matching
BENT = (-0.25, 0.06, 1e-3, -1e-3)  # OPENCV's coefficients: corners of these photographs move by some 50 px


def stereo(h: int = 480, w: int = 640, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A blurred random picture and how a camera to its right sees it: bands at several depths; RGB."""
    noise = np.random.default_rng(seed).uniform(0, 255, (h * 96 // 480, w * 140 // 640, 3))
    wide = cv2.resize(noise, (round(w * 1.1), h), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)
    right = np.empty((h, w, 3), np.uint8)
    edges = np.linspace(0, h, len(BANDS) + 1).astype(int)
    for top, bottom, shift in zip(edges[:-1], edges[1:], BANDS, strict=True):
        start = round(shift * w / 640)
        right[top:bottom] = wide[top:bottom, start : start + w]
    return np.ascontiguousarray(wide[:, :w]), right


@pytest.fixture(scope="module")
def pipeline() -> fmtorch.Pipeline:
    return load_pipeline("sift_gms", overrides=["features.max_features=1500", "estimator.hypotheses=500"])


def distance(F: torch.Tensor, shape: tuple[int, ...]) -> float:
    size = torch.tensor([shape[:2]])
    return float(nsgd(torch.from_numpy(ROWS)[None], F[None], size, size)[0])


def test_matches_and_fundamental_matrix_of_arrays(pipeline: fmtorch.Pipeline) -> None:
    image0, image1 = stereo()
    result = fmtorch.match(image0, image1, pipeline=pipeline)
    assert result.ok
    assert result.reason == result.warning == ""
    c = result.correspondences
    assert len(c) == 1
    assert bool(c.mask.all())
    assert int(result.kept.sum()) == c.mask.shape[1] == result.counts["gms"]
    assert result.putative.mask.shape == (1, len(result.kept))
    assert torch.equal(result.putative.x0[:, result.kept], c.x0)
    assert torch.equal(result.putative.x1[:, result.kept], c.x1)
    assert list(result.counts) == ["matching", "ratio", "one_to_one", "gms", "estimation"]
    steps = ["features", "matching", "ratio", "one_to_one", "gms", "estimation", "pair_type"]
    assert list(result.seconds) == steps
    assert result.counts["estimation"] == int(result.inliers.sum()) > 100
    assert sorted(result.counts.values(), reverse=True) == list(result.counts.values())
    assert result.F.norm() == pytest.approx(1)
    assert distance(result.F, image0.shape) < 0.005
    # Inliers are those of the estimator: within 1 px.
    on_lines = sampson(result.F[None], c.x0[:, result.inliers].double(), c.x1[:, result.inliers].double())
    assert on_lines.max() <= 1.001  # the threshold, scored in float32
    assert torch.equal(c.size0, torch.tensor([[480, 640]]))


def test_reduction_gives_pixels_of_the_originals(pipeline: fmtorch.Pipeline) -> None:
    image0, image1 = stereo(961, 1281)  # rounding scales the sides differently: 500 / 1281 and 375 / 961
    small = [cv2.resize(image, (500, 375), interpolation=cv2.INTER_AREA) for image in (image0, image1)]
    scale = torch.tensor([500 / 1281, 375 / 961])
    reduced = fmtorch.match(image0, image1, pipeline=pipeline, longest_side=500)
    directly = fmtorch.match(*small, pipeline=pipeline)
    assert reduced.counts == directly.counts
    for name in ("x0", "x1"):
        ours, theirs = getattr(reduced.correspondences, name), getattr(directly.correspondences, name)
        # Rounding of float32 coordinates up to 1281: some 2^-24 * 1281 px = 1e-4.
        torch.testing.assert_close((ours + 0.5) * scale - 0.5, theirs, rtol=0, atol=5e-4)
    lafs = reduced.correspondences.lafs0
    assert torch.equal(lafs[..., 2], reduced.correspondences.x0)
    torch.testing.assert_close(lafs[..., :2] * scale[:, None], directly.correspondences.lafs0[..., :2])
    # The same F, by the distances of the matches from it, up to the rounding of the points.
    A = torch.diag(torch.tensor([*scale, 1.0], dtype=torch.float64))
    A[:2, 2] = (scale - 1) / 2
    points = [getattr(reduced.correspondences, name).double() for name in ("x0", "x1")]
    ours, theirs = (sampson(F[None].double(), *points).abs() for F in (reduced.F, A.T @ directly.F.double() @ A))
    torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3)


def test_photographs_that_cannot_be_related(pipeline: fmtorch.Pipeline) -> None:
    image = stereo()[0]
    for other in (np.full((100, 120, 3), 90, np.uint8), image[:1]):
        result = fmtorch.match(image, other, pipeline=pipeline)
        assert not result.ok
        assert "no keypoints in image1" in result.reason
        assert not result.F.any()
        assert len(result.kept) == len(result.inliers) == 0
        assert result.correspondences.mask.shape == (1, 0)
    unrelated = fmtorch.match(image, stereo(seed=1)[0], pipeline=pipeline)
    assert "at least 8 are needed" in unrelated.reason
    assert not unrelated.related
    assert unrelated.significance == -math.inf
    same = fmtorch.match(image, image, pipeline=pipeline)
    assert "no motion" in same.warning


def test_photographs_that_determine_no_f(pipeline: fmtorch.Pipeline) -> None:
    """A turned camera, a plane, a crop and a recompressed copy, made of a photograph, with H; not so with depth."""
    image = read_image(shared_path("data/Strecha/fountain-P11/Images/00000002.jpg"))
    h, w = image.shape[:2]
    f, angle = 1.2 * w, math.radians(6)
    K = np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])
    R = cv2.Rodrigues(np.array([0, angle, 0]))[0] @ cv2.Rodrigues(np.array([angle, 0, 0]))[0]
    turned = K @ R @ np.linalg.inv(K)
    leaning = K @ (R + np.outer([0.4, 0.1, 0.2], [0.3, 0.1, 1])) @ np.linalg.inv(K)  # of a plane, seen from elsewhere
    crop = np.array([[1.0, 0, -100], [0, 1, -60], [0, 0, 1]])
    copy = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 40])[1], cv2.IMREAD_COLOR)
    for kind, second, H in (
        ("rotation", cv2.warpPerspective(image, turned, (w, h)), turned),
        ("planar", cv2.warpPerspective(image, leaning, (w, h)), leaning),
        ("identical", np.ascontiguousarray(image[60:, 100:]), crop), ("identical", copy, np.eye(3)),
    ):  # fmt: skip
        result = fmtorch.match(image, second, pipeline=pipeline, longest_side=800)
        assert result.pair_type == kind
        assert result.warning == WARNINGS[kind] or "no motion" in result.warning
        corners = torch.tensor([[0.0, 0], [w, 0], [w, h], [0, h]], dtype=torch.float64)
        off = homography_points(result.homography, corners) - homography_points(torch.from_numpy(H), corners)
        assert off.abs().max() < 6  # px of 1536 x 1024
    other = read_image(shared_path("data/Strecha/fountain-P11/Images/00000004.jpg"))
    general = fmtorch.match(image, other, pipeline=pipeline, longest_side=800)
    assert (general.pair_type, general.warning, general.homography) == ("general", "", None)


@pytest.mark.parametrize(
    ("arguments", "options", "error", "message"),
    [
        (("absent.jpg", "absent.jpg"), {}, ImageError, "absent.jpg"),
        ((np.zeros((4, 4, 4), np.uint8),) * 2, {}, ValueError, r"image0 is uint8 \(4, 4, 4\)"),
        ((np.zeros((0, 4), np.uint8),) * 2, {}, ValueError, "must be non-empty uint8"),
        ((np.zeros((4, 4), np.uint8),) * 2, {"pipeline": "sift_magic"}, ValueError, "there are: .*sift_gms"),
        ((np.zeros((4, 4), np.uint8),) * 2, {"longest_side": 0}, ValueError, "longest_side is 0"),
    ],
)
def test_errors(arguments, options, error, message):
    with pytest.raises(error, match=message):
        fmtorch.match(*arguments, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", presets.available("pipeline"))
def test_every_pipeline_composes_by_name(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in.install(tmp_path, monkeypatch)
    for module in ("features.kornia_features", "matching.lightglue"):  # without fetching others' weights
        monkeypatch.setattr(f"fmtorch.{module}.pretrained", lambda load, *_: torch.nn.Identity())
    built = load_pipeline(name)
    assert built.pruners or name in ("aliked_lightglue", "disk_lightglue", "xfeat_lighterglue", "given_fmtorch")


def test_overrides_and_a_callers_own_hydra() -> None:
    with initialize_config_dir(str(conf_dir()), version_base=None):
        before = GlobalHydra.instance().hydra
        built = load_pipeline("paper/sift_gms", overrides=["pruner.gms.with_scale=true"])
        assert GlobalHydra.instance().hydra is before
        assert compose("match").longest_side == 1600
    assert list(built.pruners) == ["ratio", "gms"]
    assert built.pruners["gms"]._options["with_scale"]  # type: ignore[attr-defined]
    assert built.pruners["gms"]._options["threshold_factor"] == 4  # type: ignore[attr-defined]
    assert not GlobalHydra.instance().is_initialized()
    for words, said in ((["pruner.gms.angle=1"], r"pruner\.gms\.angle"), (["matcher=lightglue"], "Glue for SIFT"),
                        (["matcher=lightglue", "features=disk"], r"give matcher\.features=disk")):  # fmt: skip
        with pytest.raises(ValueError, match=said):
            load_pipeline("sift_gms", overrides=words)


def test_the_command(command: Callable[..., str], tmp_path: Path) -> None:
    image0, image1 = stereo(240, 320)
    Image.fromarray(image0).save(tmp_path / "a.png")
    Image.fromarray(image1).save(tmp_path / "b.webp", quality=95)
    (tmp_path / "F.txt").write_text("0 0 0\n0 0 -2\n0, 2, 0\n")
    said = command("match", "image0=a.png", "image1=b.webp", "truth=F.txt", cwd=tmp_path)
    for text in ("hesaffnet_fast_fmtorch", "one_to_one", "inliers", "seconds", "NSGD", "matches/a-b"):
        assert text in said
    assert "not the same scene" not in said
    folder = tmp_path / "matches" / "a-b"
    assert {path.name for path in folder.iterdir()} == {"result.json", "matches.png", "pruning.png", "epipolar.png"}
    assert {path.name for path in tmp_path.iterdir()} == {"a.png", "b.webp", "F.txt", "matches", "cache"}
    report = json.loads((folder / "result.json").read_text())
    assert (report["pipeline"], report["overrides"]) == ("hesaffnet_fast_fmtorch", [])
    assert report["size0"] == report["size1"] == [240, 320]
    assert (report["reason"], report["related"]) == ("", True)
    assert report["significance"] > 100
    assert report["nsgd"] < 0.01
    kept = report["matches"]["frame_consistency"]
    assert np.shape(report["x0"]) == np.shape(report["x1"]) == (kept, 2)
    assert len(report["ratio"]) == len(report["inliers"]) == kept
    assert max(report["ratio"]) < 0.8
    assert sum(report["inliers"]) == report["matches"]["estimation"]
    result = fmtorch.match(tmp_path / "a.png", tmp_path / "b.webp")
    assert np.array_equal(np.array(report["F"]), result.F.numpy())

    # Without F: a picture, the reason, status 0. The folder of the earlier pair is refused.
    cv2.imwrite(str(tmp_path / "flat.png"), np.full((300, 20), 90, np.uint8))
    other = ("image0=a.png", "image1=flat.png", "pipeline=sift_gms", "pruner=[ratio]")
    said = command("match", *other, f"output={folder}", cwd=tmp_path)
    assert f"ended: error: output={folder} holds the matches of other images or settings" in said
    folder = tmp_path / "flat"
    said = command("match", *other, f"output={folder}", cwd=tmp_path)
    assert "sift_gms pruner=[ratio]: a.png, flat.png" in said
    assert "no keypoints in image1" in said
    assert "ended" not in said
    assert {path.name for path in folder.iterdir()} == {"result.json", "matches.png"}
    report = json.loads((folder / "result.json").read_text())
    assert report["overrides"] == ["pruner=[ratio]"]
    assert report["F"] is report["significance"] is None
    assert "no keypoints" in report["reason"]
    assert report["related"] is False

    # With F, of photographs that show nothing in common; and of one photograph twice.
    Image.fromarray(stereo(240, 320, seed=1)[0]).save(tmp_path / "other.png")
    stages = ("pipeline=sift_ratio", "estimator=lmeds_eight_point", "pruner.ratio.threshold=0.95")
    said = command("match", "image0=a.png", "image1=other.png", "output=other", *stages, cwd=tmp_path)
    folder = tmp_path / "other"
    assert "probably not the same scene" in said
    assert "nothing in common" not in said  # which is said already
    report = json.loads((folder / "result.json").read_text())
    assert (report["pair_type"], report["homography"]) == ("unrelated", None)
    said = command("match", "image0=a.png", "image1=a.png", "output=same", "pipeline=sift_gms", cwd=tmp_path)
    assert "identical" in said
    assert "no motion" in said


def test_others_of_the_same_names_overwrite_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    paths = [Path("x/a.jpg"), Path("x/b.jpg")]
    others = [Path("y/a.jpg"), Path("y/b.jpg")]
    settings = {"pipeline": "sift_gms", "seed": 0, "cameras": None}
    folder = Path("matches/a-b")

    def output(*given: Any) -> Path:
        return match_command._output(None, *given)

    assert output(paths, settings) == folder
    write_file(folder / "result.json", json.dumps({"image0": "x/a.jpg", "image1": "x/b.jpg", **settings}))
    assert output(paths, settings) == output([path.absolute() for path in paths], settings) == folder
    changes = ({"seed": 1}, {"pipeline": "sift_lpm"}, {"cameras": "unknown"})
    calls = [(others, settings), *((paths, settings | changed) for changed in changes)]
    elsewhere = [output(*call) for call in calls]
    assert all(re.fullmatch(r"a-b-[0-9a-f]{8}", other.name) for other in elsewhere)
    assert (len(set(elsewhere)), [output(*call) for call in calls]) == (len(calls), elsewhere)


@pytest.fixture(scope="module")
def pair() -> ImagePair:
    return load("fmbench", root=shared_path("data/Strecha_train"))[0]


@pytest.fixture(scope="module")
def pipeline_with_cameras(tmp_path_factory: pytest.TempPathFactory) -> fmtorch.Pipeline:
    return load_pipeline("sift_fmtorch", overrides=[f"cache={tmp_path_factory.mktemp('features')}"])


def matched(pair: ImagePair, pipeline: fmtorch.Pipeline, **cameras: object) -> fmtorch.MatchResult:
    return fmtorch.match(pair.image0.path, pair.image1.path, pipeline=pipeline, longest_side=SIDE, **cameras)


def error(result: fmtorch.MatchResult, pair: ImagePair) -> float:
    return pose_error(result.R.double().numpy(), result.t.double().numpy(), pair)  # type: ignore[arg-type]


def test_the_pose_of_reduced_photographs_by_what_is_known(pair, pipeline_with_cameras):
    focal = math.sqrt(pair.K0[0, 0] * pair.K0[1, 1])
    plain = matched(pair, pipeline_with_cameras)
    assert plain.R is plain.t is plain.focals is None
    known = matched(pair, pipeline_with_cameras, K0=pair.K0, K1=pair.K1)
    assert error(known, pair) < 0.5
    assert known.focals.tolist() == pytest.approx([focal, focal], rel=1e-6)  # in pixels of the photographs
    assert known.R.double() @ known.R.double().T == pytest.approx(np.eye(3), abs=1e-6)
    for cameras in (
        {"focal": (1.05 * focal, 0.06)}, {"focal": "shared"}, {"focal": [(focal, 0.0), None]},
        {"K0": pair.K0}, {"K0": pair.K0, "K1": pair.K1, "focal": 0.1},
    ):  # fmt: skip
        result = matched(pair, pipeline_with_cameras, **cameras)
        assert error(result, pair) < 3, cameras
        assert result.focals.tolist() == pytest.approx([focal, focal], rel=0.1), cameras
    unknown = matched(pair, pipeline_with_cameras, focal="unknown")
    assert torch.equal(unknown.F, plain.F)
    assert known.report()["R"] == known.R.tolist()
    angle, shown = math.degrees(math.acos((np.trace(pair.R) - 1) / 2)), pose_line(known)
    assert float(shown.split()[1].rstrip("°,")) == pytest.approx(angle, abs=0.5)
    assert "focal lengths 1381, 1381 px" in shown
    flat = np.full((300, 400, 3), 9, np.uint8)
    nothing = fmtorch.match(flat, flat, pipeline=pipeline_with_cameras, K0=pair.K0 / 4, K1=pair.K1 / 4)
    assert (nothing.ok, pose_line(nothing), "R" in nothing.report()) == (False, "", False)


def test_calibrations_follow_the_reduction(pair: ImagePair, pipeline_with_cameras: fmtorch.Pipeline) -> None:
    """Reduced by hand, with K scaled by hand, everything is the same."""
    images = [read_image(image) for image in (pair.image0, pair.image1)]
    small = [cv2.resize(image, (768, 512), interpolation=cv2.INTER_AREA) for image in images]
    half = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
    by_hand = fmtorch.match(*small, pipeline=pipeline_with_cameras, K0=half @ pair.K0, K1=half @ pair.K1)
    reduced = fmtorch.match(*images, pipeline=pipeline_with_cameras, longest_side=768, K0=pair.K0, K1=pair.K1)
    assert torch.equal(by_hand.R, reduced.R)
    assert torch.equal(by_hand.t, reduced.t)
    assert (2 * by_hand.focals).tolist() == pytest.approx(reduced.focals.tolist(), rel=1e-9)


def photographed(image: np.ndarray, lens: Lens) -> np.ndarray:
    h, w = image.shape[:2]
    every = np.stack(np.meshgrid(np.arange(0.0, w + 8, 8), np.arange(0.0, h + 8, 8)), -1)
    at = np.meshgrid(np.arange(w, dtype=np.float32) / 8, np.arange(h, dtype=np.float32) / 8)
    # Between points 8 px apart the map is linear to some 1e-3 px.
    x = cv2.remap(undistorted_points(lens, every).astype(np.float32), *at, cv2.INTER_LINEAR)
    return cv2.remap(image, x[..., 0], x[..., 1], cv2.INTER_CUBIC)


def test_a_lens_bends_points_and_not_images(pair: ImagePair, pipeline_with_cameras: fmtorch.Pipeline) -> None:
    """Photographs through a lens that distorts: F and the pose are those of pinholes, points those of photographs."""
    K0, K1 = pair.K0, pair.K1
    lenses = [Lens(K[0, 0], K[1, 1], K[0, 2], K[1, 2], "OPENCV", BENT) for K in (K0, K1)]
    plain = [read_image(image) for image in (pair.image0, pair.image1)]
    bent = [photographed(image, lens) for image, lens in zip(plain, lenses, strict=True)]
    given = {"pipeline": pipeline_with_cameras, "longest_side": SIDE}
    result = fmtorch.match(*bent, **given, lens=lenses)
    ignored = fmtorch.match(*bent, **given, K0=K0, K1=K1)
    assert torch.equal(result.keypoints0, ignored.keypoints0)  # features are of the photographs
    assert torch.equal(result.correspondences.x0, ignored.correspondences.x0)
    assert ignored.undistorted is None
    assert error(result, pair) < 0.5 < error(ignored, pair)
    x0, x1 = (x[0][result.inliers].double() for x in (result.undistorted.x0, result.undistorted.x1))
    expected = undistorted_points(lenses[0], result.correspondences.x0[0][result.inliers].numpy())
    np.testing.assert_allclose(x0.numpy(), expected, atol=1e-3)
    assert sampson(result.F[None], x0[None], x1[None]).sqrt().median() < 1
    sizes = torch.tensor([plain[0].shape[:2]])
    truth = torch.from_numpy(pair.F)[None]
    assert nsgd(truth, result.F[None], sizes, sizes) < 0.005 < nsgd(truth, ignored.F[None], sizes, sizes)


def test_a_lens_that_nobody_calibrated(pair: ImagePair, pipeline_with_cameras: fmtorch.Pipeline) -> None:
    """It is suggested of bent photographs, and estimated; F is then of undistorted points, and pictures straight."""
    plain = [read_image(image) for image in (pair.image0, pair.image1)]
    h, w = plain[0].shape[:2]
    half = math.hypot(h, w) / 2
    division = Lens(half, half, (w - 1) / 2, (h - 1) / 2, "SIMPLE_DIVISION", (-0.1,))
    bent = [photographed(image, division) for image in plain]
    given, size = {"pipeline": pipeline_with_cameras, "longest_side": SIDE}, torch.tensor([[h, w]])
    truth = torch.from_numpy(pair.F)
    ignored = fmtorch.match(*bent, **given)
    result = fmtorch.match(*bent, **given, lens="shared")
    assert "a lens bends the images (lambda about -0.1" in ignored.warning
    assert result.warning == ""
    assert result.lens.tolist() == pytest.approx([-0.1, -0.1], abs=0.02)
    assert torch.equal(result.correspondences.x0, ignored.correspondences.x0)  # of the photographs
    assert nsgd(truth[None], result.F[None], size, size) < 0.005 < nsgd(truth[None], ignored.F[None], size, size)
    estimated = dataclasses.replace(division, coefficients=(float(result.lens[0]),))
    expected = undistorted_points(estimated, result.correspondences.x0[0][result.inliers].numpy())
    np.testing.assert_allclose(result.undistorted.x0[0][result.inliers].numpy(), expected, atol=1e-3)
    assert result.report()["lens"] == result.lens.tolist()
    calibrated = fmtorch.match(*bent, **given, lens=-0.1, K0=pair.K0, K1=pair.K1)
    assert error(calibrated, pair) < 0.5
    straight = fmtorch.match(*plain, **given, lens="shared")
    assert straight.lens.tolist() == [0, 0]
    assert straight.undistorted is None
    with pytest.raises(ValueError, match="K0 and a lens of image 0 are given"):
        fmtorch.match(*bent, **given, lens=division, K0=pair.K0)
    with pytest.raises(ValueError, match="lens needs an estimator with the option focal"):
        fmtorch.match(*bent, pipeline="sift_gms", lens="shared")


def photographs(paths: list[Path], cameras: Path | None, K: Any) -> SimpleNamespace:
    known = PhotographCameras(cameras, K)
    images = [read_image(known.source(path)) for path in paths]
    ends = [known.of(path, image.shape[:2]) for path, image in zip(paths, images, strict=True)]
    notes = [end.note for end in ends if end.note]
    return SimpleNamespace(images=images, knowledge=known.knowledge(*ends), notes=notes)


def test_words_files_and_numbers_as_arguments(tmp_path: Path) -> None:
    paths = [with_exif(tmp_path, (40, 60), "a.jpg", FocalLengthIn35mmFilm=36), with_exif(tmp_path, (40, 60), "b.jpg")]
    assert photographs(paths, None, None).knowledge == {}
    for word in ("shared", "unknown"):
        assert photographs(paths, Path(word), None).knowledge == {"focal": word}
    exif = photographs(paths, Path("exif"), None)
    focal, nothing = exif.knowledge["focal"]
    assert focal == pytest.approx((60, math.hypot(0.06, 1 / math.sqrt(12) / 36)))
    assert nothing is None
    assert exif.notes == ["b.jpg: focal length not known: no EXIF data"]
    neither = photographs([paths[1], paths[1]], Path("exif"), None)
    assert neither.knowledge == {"focal": "unknown"}
    for K in ("70,71,30,20", [70, 71, 30, 20], "[70, 71, 30, 20]"):
        given = photographs(paths, None, K).knowledge
        assert given["K0"].tolist() == given["K1"].tolist() == [[70, 0, 30], [0, 71, 20], [0, 0, 1]]
    file = tmp_path / "k.json"
    file.write_text(json.dumps({"a.jpg": [70, 71, 30, 20], "b.jpg": None}))
    given = photographs(paths, file, None).knowledge
    assert given["K0"].tolist() == [[70, 0, 30], [0, 71, 20], [0, 0, 1]]
    assert given["K1"] is None
    file.write_text(json.dumps({"a.jpg": None, "b.jpg": None}))
    assert photographs(paths, file, None).knowledge == {"K0": None, "K1": None, "focal": "unknown"}


def test_distortion_is_taken_out_and_sizes_must_fit(tmp_path: Path) -> None:
    paths = [with_exif(tmp_path, (40, 60), name) for name in ("a.jpg", "b.jpg")]
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_RADIAL 60 40 50 30 20 0.2\n")
    bent = photographs(paths, tmp_path / "cameras.txt", None)
    assert bent.knowledge["K0"] is None
    assert "b.jpg: F and the pose are of the image without the distortion of its SIMPLE_RADIAL lens" in bent.notes[1]
    assert bent.knowledge["lens"][1] == Lens(50, 50, 29.5, 19.5, "SIMPLE_RADIAL", (0.2,))
    assert np.array_equal(bent.images[0], read_image(paths[0]))  # as it was taken
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 50 40 50 50 30 20\n")
    with pytest.raises(ImageError, match=r"a\.jpg: 60 x 40 px, but its camera is of 50 x 40"):
        photographs(paths, tmp_path / "cameras.txt", None)


@pytest.mark.parametrize(("cameras", "K", "message"), [
    (Path("none.json"), None, "cameras=none.json: no such file; it must be unknown, shared, exif"),
    (Path("exif"), "1,2,3,4", "cameras and K are given"), (None, "1,2,3", "K=1,2,3; it must be fx,fy,cx,cy"),
    (None, "0,1,2,3", "it must be fx"), (None, "a,b,c,d", "it must be fx"),
])  # fmt: skip
def test_what_is_no_camera_of_a_command(cameras: Path | None, K: object, message: str, tmp_path: Path) -> None:
    path = with_exif(tmp_path, (40, 60), "a.jpg")
    with pytest.raises(ValueError, match=message):
        photographs([path, path], cameras, K)


def test_the_command_with_cameras(pair: ImagePair, command: Callable[..., str], tmp_path: Path) -> None:
    fx, fy, cx, cy = pair.K0[[0, 1, 0, 1], [0, 1, 2, 2]]
    words = (str(pair.image0.path), str(pair.image1.path), "pipeline=sift_fmtorch", f"longest_side={SIDE}")
    said = command("match", *words, f"K={fx},{fy},{cx},{cy}", "output=out", cwd=tmp_path)
    assert "rotation " in said
    assert "translation (" in said
    report = json.loads((tmp_path / "out" / "result.json").read_text())
    assert report["focals"] == pytest.approx([math.sqrt(fx * fy)] * 2)
    assert (np.shape(report["R"]), np.linalg.norm(report["t"])) == ((3, 3), pytest.approx(1))
    assert "K=1,2,3; it must be fx,fy,cx,cy" in command("match", "images=.", "K=1,2,3", cwd=tmp_path)
