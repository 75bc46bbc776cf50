"""`fmtorch.match` and its command with what is known of the cameras: poses of real photographs."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import ExifTags, Image

import fmtorch
from fmtorch.commands.match import photographs, pose_line
from fmtorch.data import ImageError, ImagePair, Lens, load
from fmtorch.data.cameras import undistorted_points
from fmtorch.geometry import sampson
from fmtorch.metrics import nsgd, pose_error
from fmtorch.pipeline import load_pipeline
from tests.conftest import shared_path

SIDE = 768  # px, to which photographs are reduced for matching


@pytest.fixture(scope="module")
def pair() -> ImagePair:
    return load("fmbench", root=shared_path("data/Strecha_train"))[0]


@pytest.fixture(scope="module")
def pipeline() -> fmtorch.Pipeline:
    return load_pipeline("sift_fmtorch")


def matched(pair: ImagePair, pipeline: fmtorch.Pipeline, **cameras: object) -> fmtorch.MatchResult:
    return fmtorch.match(pair.image0.path, pair.image1.path, pipeline=pipeline, longest_side=SIDE, **cameras)


def error(result: fmtorch.MatchResult, pair: ImagePair) -> float:
    """The larger angle of the pose error, with the sign of t, in degrees."""
    R, t = (torch.from_numpy(np.array(value)) for value in (pair.R, pair.t))
    return float(pose_error(result.R.double(), result.t.double(), R, t, up_to_sign=False).worst)


def test_the_pose_of_reduced_photographs_by_what_is_known(pair: ImagePair, pipeline: fmtorch.Pipeline) -> None:
    focal = math.sqrt(pair.K0[0, 0] * pair.K0[1, 1])
    plain = matched(pair, pipeline)
    assert plain.R is plain.t is plain.focals is None
    known = matched(pair, pipeline, K0=pair.K0, K1=pair.K1)
    assert error(known, pair) < 0.5
    assert known.focals.tolist() == pytest.approx([focal, focal], rel=1e-6)  # in pixels of the photographs
    assert known.R.double() @ known.R.double().T == pytest.approx(np.eye(3), abs=1e-6)
    for cameras in (
        {"focal": (1.05 * focal, 0.06)}, {"focal": "shared"}, {"focal": [(focal, 0.0), None]},
        {"K0": pair.K0}, {"K0": pair.K0, "K1": pair.K1, "focal": 0.1},
    ):  # fmt: skip
        result = matched(pair, pipeline, **cameras)
        assert error(result, pair) < 3, cameras
        assert result.focals.tolist() == pytest.approx([focal, focal], rel=0.1), cameras
    unknown = matched(pair, pipeline, focal="unknown")
    assert torch.equal(unknown.F, plain.F)


def test_calibrations_follow_the_reduction(pair: ImagePair, pipeline: fmtorch.Pipeline) -> None:
    """Reduced by hand, with K scaled by hand, everything is the same."""
    images = [fmtorch.data.read_image(image) for image in (pair.image0, pair.image1)]
    small = [cv2.resize(image, (768, 512), interpolation=cv2.INTER_AREA) for image in images]
    half = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
    by_hand = fmtorch.match(*small, pipeline=pipeline, K0=half @ pair.K0, K1=half @ pair.K1)
    reduced = fmtorch.match(*images, pipeline=pipeline, longest_side=768, K0=pair.K0, K1=pair.K1)
    assert torch.equal(by_hand.R, reduced.R)
    assert torch.equal(by_hand.t, reduced.t)
    assert (2 * by_hand.focals).tolist() == pytest.approx(reduced.focals.tolist(), rel=1e-9)


BENT = (-0.25, 0.06, 1e-3, -1e-3)  # OPENCV's coefficients: corners of these photographs move by some 50 px


def photographed(image: np.ndarray, lens: Lens) -> np.ndarray:
    """What the lens makes of a pinhole's image."""
    h, w = image.shape[:2]
    pixels = np.stack(np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float)), -1)
    x = undistorted_points(lens, pixels).astype(np.float32)
    return cv2.remap(image, x[..., 0], x[..., 1], cv2.INTER_CUBIC)


def test_a_lens_bends_points_and_not_images(pair: ImagePair, pipeline: fmtorch.Pipeline) -> None:
    """Photographs through a lens that distorts: F and the pose are those of pinholes, points those of photographs."""
    K0, K1 = pair.K0, pair.K1
    lenses = [Lens(K[0, 0], K[1, 1], K[0, 2], K[1, 2], "OPENCV", BENT) for K in (K0, K1)]
    plain = [fmtorch.data.read_image(image) for image in (pair.image0, pair.image1)]
    bent = [photographed(image, lens) for image, lens in zip(plain, lenses, strict=True)]
    given = {"pipeline": pipeline, "longest_side": SIDE}
    lens0, lens1 = lenses
    result = fmtorch.match(*bent, **given, lens0=lens0, lens1=lens1)
    ignored = fmtorch.match(*bent, **given, K0=K0, K1=K1)
    assert torch.equal(result.keypoints0, ignored.keypoints0)  # features are of the photographs
    assert torch.equal(result.correspondences.x0, ignored.correspondences.x0)
    assert ignored.undistorted is None
    assert error(result, pair) < 0.5 < error(ignored, pair)
    x0, x1 = (x[0][result.inliers].double() for x in (result.undistorted.x0, result.undistorted.x1))
    expected = undistorted_points(lens0, result.correspondences.x0[0][result.inliers].numpy())
    np.testing.assert_allclose(x0.numpy(), expected, atol=1e-3)
    assert sampson(result.F[None], x0[None], x1[None]).sqrt().median() < 1
    sizes = torch.tensor([plain[0].shape[:2]])
    truth = torch.from_numpy(pair.F)[None]
    assert nsgd(truth, result.F[None], sizes, sizes) < 0.005 < nsgd(truth, ignored.F[None], sizes, sizes)


def test_a_lens_that_nobody_calibrated(pair: ImagePair, pipeline: fmtorch.Pipeline) -> None:
    """It is suggested of bent photographs, and estimated; F is then of undistorted points, and pictures straight."""
    plain = [fmtorch.data.read_image(image) for image in (pair.image0, pair.image1)]
    h, w = plain[0].shape[:2]
    half = math.hypot(h, w) / 2
    division = Lens(half, half, (w - 1) / 2, (h - 1) / 2, "SIMPLE_DIVISION", (-0.1,))
    bent = [photographed(image, division) for image in plain]
    given, size, truth = {"pipeline": pipeline, "longest_side": SIDE}, torch.tensor([[h, w]]), torch.from_numpy(pair.F)
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
    with pytest.raises(ValueError, match="lens and lens0 or lens1 are given"):
        fmtorch.match(*bent, **given, lens="shared", lens0=division)
    with pytest.raises(ValueError, match="lens needs an estimator with the option focal"):
        fmtorch.match(*bent, pipeline="sift_gms", lens="shared")


def with_exif(folder: Path, name: str, **tags: int) -> Path:
    """A picture of 60 x 40 px with these tags."""
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update({ExifTags.Base[key]: value for key, value in tags.items()})
    Image.new("RGB", (60, 40)).save(folder / name, exif=exif)
    return folder / name


def test_words_files_and_numbers_as_arguments(tmp_path: Path) -> None:
    paths = [with_exif(tmp_path, "a.jpg", FocalLengthIn35mmFilm=36), with_exif(tmp_path, "b.jpg")]
    assert photographs(paths, None, None, True).knowledge == {}
    for word in ("shared", "unknown"):
        assert photographs(paths, Path(word), None, True).knowledge == {"focal": word}
    exif = photographs(paths, Path("exif"), None, True)
    focal, nothing = exif.knowledge["focal"]
    assert focal == pytest.approx((60, math.hypot(0.06, 1 / math.sqrt(12) / 36)))
    assert nothing is None
    assert exif.notes == ("b.jpg: focal length not known: no EXIF data",)
    neither = photographs([paths[1], paths[1]], Path("exif"), None, True)
    assert neither.knowledge == {"focal": "unknown"}
    for K in ("70,71,30,20", [70, 71, 30, 20], "[70, 71, 30, 20]"):
        given = photographs(paths, None, K, True).knowledge
        assert given["K0"].tolist() == given["K1"].tolist() == [[70, 0, 30], [0, 71, 20], [0, 0, 1]]
    file = tmp_path / "k.json"
    file.write_text(json.dumps({"a.jpg": [70, 71, 30, 20], "b.jpg": None}))
    given = photographs(paths, file, None, True).knowledge
    assert given["K0"].tolist() == [[70, 0, 30], [0, 71, 20], [0, 0, 1]]
    assert given["K1"] is None
    file.write_text(json.dumps({"a.jpg": None, "b.jpg": None}))
    assert photographs(paths, file, None, True).knowledge == {"K0": None, "K1": None, "focal": "unknown"}


def test_distortion_is_taken_out_and_sizes_must_fit(tmp_path: Path) -> None:
    paths = [with_exif(tmp_path, name) for name in ("a.jpg", "b.jpg")]
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_RADIAL 60 40 50 30 20 0.2\n")
    bent = photographs(paths, tmp_path / "cameras.txt", None, True)
    assert bent.knowledge["K0"].tolist() == [[50, 0, 29.5], [0, 50, 19.5], [0, 0, 1]]
    assert "b.jpg: F and the pose are of the image without the distortion of its SIMPLE_RADIAL lens" in bent.notes[1]
    assert bent.knowledge["lens1"].coefficients == (0.2,)
    assert np.array_equal(bent.images[0], fmtorch.data.read_image(paths[0]))  # as it was taken
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 50 40 50 50 30 20\n")
    with pytest.raises(ImageError, match=r"a\.jpg: 60 x 40 px, but its camera is of 50 x 40"):
        photographs(paths, tmp_path / "cameras.txt", None, True)


@pytest.mark.parametrize(("cameras", "K", "message"), [
    (Path("none.json"), None, "cameras=none.json: no such file; it must be unknown, shared, exif"),
    (Path("exif"), "1,2,3,4", "cameras and K are given"), (None, "1,2,3", "K=1,2,3; it must be fx,fy,cx,cy"),
    (None, "0,1,2,3", "it must be fx"), (None, "a,b,c,d", "it must be fx"),
])  # fmt: skip
def test_what_is_no_camera_of_a_command(cameras: Path | None, K: object, message: str, tmp_path: Path) -> None:
    path = with_exif(tmp_path, "a.jpg")
    with pytest.raises(ValueError, match=message):
        photographs([path, path], cameras, K, True)  # type: ignore[arg-type]


def test_a_pose_that_is_not_determined_is_said(pair: ImagePair, pipeline: fmtorch.Pipeline) -> None:
    image = np.random.default_rng(0).integers(0, 255, (300, 400, 3)).astype(np.uint8)
    K = np.array([[400.0, 0, 199.5], [0, 400, 149.5], [0, 0, 1]])
    nothing = fmtorch.match(image, np.full((300, 400, 3), 9, np.uint8), pipeline=pipeline, K0=K, K1=K)
    assert not nothing.ok
    assert pose_line(nothing) == ""
    assert "R" not in nothing.report()
    known = matched(pair, pipeline, K0=pair.K0, K1=pair.K1)
    assert known.report()["R"] == known.R.tolist()
    angle = math.degrees(math.acos((np.trace(pair.R) - 1) / 2))
    shown = pose_line(known)
    assert float(shown.split()[1].rstrip("°,")) == pytest.approx(angle, abs=0.5)
    assert "focal lengths 1381, 1381 px" in shown


def test_the_command(pair: ImagePair, command: Callable[..., str], tmp_path: Path) -> None:
    fx, fy, cx, cy = pair.K0[[0, 1, 0, 1], [0, 1, 2, 2]]
    words = (str(pair.image0.path), str(pair.image1.path), "pipeline=sift_fmtorch", f"longest_side={SIDE}")
    said = command("match", *words, f"K={fx},{fy},{cx},{cy}", "output=out", cwd=tmp_path)
    assert "rotation " in said
    assert "translation (" in said
    report = json.loads((tmp_path / "out" / "result.json").read_text())
    assert report["focals"] == pytest.approx([math.sqrt(fx * fy)] * 2)
    assert np.shape(report["R"]) == (3, 3)
    assert np.linalg.norm(report["t"]) == pytest.approx(1)
    assert "K=1,2,3; it must be fx,fy,cx,cy" in command("match", "images=.", "K=1,2,3", cwd=tmp_path)
