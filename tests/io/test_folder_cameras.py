"""Folders of photographs with what is known of their cameras: intrinsics and two-view geometries of the exports."""

import math
import shutil
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
import torch
from PIL import ExifTags, Image

import fmtorch
from fmtorch.commands import match as match_command
from fmtorch.data import Lens, load, read_image
from fmtorch.io import DATABASE, MATCHES
from fmtorch.metrics import pose_error
from tests.commands.test_match_cameras import BENT, photographed
from tests.conftest import shared_path
from tests.helpers import compose

SIDE = 768  # px


class Scene:
    """The first pair of castle-P19 at half its size, as photographs of a lens with distortion if so asked."""

    def __init__(self, folder: Path, coefficients: tuple[float, ...] = (), equivalent: int | None = None) -> None:
        self.folder = folder
        self.pair = load("fmbench", root=shared_path("data/Strecha_train"))[0]
        half = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
        self.K = half @ self.pair.K0
        fx, fy, cx, cy = self.K[[0, 1, 0, 1], [0, 1, 2, 2]]
        self.lens = Lens(fx, fy, cx, cy, "OPENCV" if coefficients else "PINHOLE", coefficients)
        folder.mkdir()
        exif = Image.Exif()
        if equivalent is not None:
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = equivalent
        for name, source in (("a.jpg", self.pair.image0), ("b.jpg", self.pair.image1)):
            image = cv2.resize(read_image(source), (768, 512), interpolation=cv2.INTER_AREA)
            image = photographed(image, self.lens) if coefficients else image
            Image.fromarray(image).save(folder / name, quality=97, exif=exif)

    def match(self, output: Path, *words: str) -> Path:
        given = (f"images={self.folder}", f"output={output}", f"longest_side={SIDE}", "cache=off", *words)
        return match_command.run(compose("match", ("pipeline=sift_fmtorch", *given)), "sift_fmtorch")

    def error(self, R: np.ndarray, t: np.ndarray) -> float:
        """The larger angle of the pose error, with the sign of t, in degrees."""
        given = (torch.from_numpy(np.array(v, np.float64))[None] for v in (R, t, self.pair.R, self.pair.t))
        return float(pose_error(*given, up_to_sign=False).worst)


def stored(folder: Path) -> tuple[Any, Any]:
    """The first camera and the geometry of a database of one pair."""
    with pycolmap.Database.open(folder / DATABASE) as file:
        return file.read_camera(1), file.read_two_view_geometry(1, 2)


def kind(geometry: Any) -> str:
    return str(pycolmap.TwoViewGeometryConfiguration(geometry.config).name)


def test_a_calibration_of_all_gives_what_verify_gives(tmp_path: Path) -> None:
    scene = Scene(tmp_path / "photos")
    K = ",".join(map(str, scene.K[[0, 1, 0, 1], [0, 1, 2, 2]]))
    output = scene.match(tmp_path / "out", f"K=[{K}]", "export='h5,colmap'")
    camera, geometry = stored(output)
    assert str(camera.model_name) == "PINHOLE"
    assert camera.has_prior_focal_length
    np.testing.assert_allclose(camera.calibration_matrix(), scene.K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
    assert kind(geometry) == "CALIBRATED"
    pose = geometry.cam2_from_cam1
    assert scene.error(pose.rotation.matrix(), pose.translation) < 0.5
    with h5py.File(output / MATCHES) as file:
        attributes = dict(file["a.jpg/b.jpg"].attrs)
    np.testing.assert_allclose(attributes["R"], pose.rotation.matrix(), atol=1e-9)
    assert attributes["configuration"] == "calibrated"
    assert attributes["E"].shape == (3, 3)

    # The same matches by `verify`, which reads the cameras of the database.
    done = fmtorch.verify(output / DATABASE, output=tmp_path / "verified.db", force=True)
    assert done.verified == 1
    shutil.move(tmp_path / "verified.db", tmp_path / DATABASE)
    _, again = stored(tmp_path)
    assert kind(again) == "CALIBRATED"
    other = again.cam2_from_cam1
    assert np.degrees(pose.rotation.angle_to(other.rotation)) < 0.2
    ours, theirs = (set(map(tuple, g.inlier_matches.tolist())) for g in (geometry, again))
    assert len(ours & theirs) > 0.9 * len(ours | theirs)

    with pytest.raises(ValueError, match=r"holds matches of other settings; .*: cameras"):
        scene.match(tmp_path / "out", "cameras=unknown")


def test_a_file_of_a_lens(tmp_path: Path) -> None:
    """Keypoints are those of the photographs; the camera has the lens, and E and the pose are of pinholes."""
    scene = Scene(tmp_path / "photos", BENT)
    lens = scene.lens
    parameters = " ".join(map(str, [lens.fx, lens.fy, lens.cx + 0.5, lens.cy + 0.5, *lens.coefficients]))
    (tmp_path / "cameras.txt").write_text(f"1 OPENCV 768 512 {parameters}\n")
    output = scene.match(tmp_path / "out", f"cameras={tmp_path / 'cameras.txt'}", "export=colmap")
    camera, geometry = stored(output)
    assert str(camera.model_name) == "OPENCV"
    np.testing.assert_allclose(camera.params, [float(word) for word in parameters.split()])
    assert kind(geometry) == "CALIBRATED"
    pose = geometry.cam2_from_cam1
    assert scene.error(pose.rotation.matrix(), pose.translation) < 0.6
    with pycolmap.Database.open(output / DATABASE) as file:
        x = [file.read_keypoints(i)[:, :2][geometry.inlier_matches[:, k]] for k, i in ((0, 1), (1, 2))]
    rays = [np.column_stack([camera.cam_from_img(p.astype(np.float64)), np.ones(len(p))]) for p in x]
    lines = rays[0] @ geometry.E.T
    distance = np.abs((rays[1] * lines).sum(1)) / np.linalg.norm(lines[:, :2], axis=1) * lens.fx
    assert np.median(distance) < 1  # px: points of the photographs, undistorted, lie on epipolar lines

    (tmp_path / "cameras.txt").write_text(f"1 OPENCV 700 512 {parameters}\n")
    with pytest.raises(ValueError, match=r"768 x 512 px, but its camera is of 700 x 512 px"):
        scene.match(tmp_path / "other", f"cameras={tmp_path / 'cameras.txt'}")


def test_focal_lengths_by_exif_and_shared_ones(tmp_path: Path) -> None:
    equivalent = 32  # mm: 683 px, for 690 px
    scene = Scene(tmp_path / "photos", equivalent=equivalent)
    camera, geometry = stored(scene.match(tmp_path / "exif", "cameras=exif", "export=colmap"))
    focal = equivalent * math.hypot(768, 512) / math.hypot(36, 24)
    assert str(camera.model_name) == "SIMPLE_RADIAL"
    assert camera.has_prior_focal_length
    assert camera.focal_length == pytest.approx(focal)
    assert kind(geometry) == "CALIBRATED"
    pose = geometry.cam2_from_cam1
    assert scene.error(pose.rotation.matrix(), pose.translation) < 3
    output = scene.match(tmp_path / "shared", "cameras=shared", "export=colmap")
    with pycolmap.Database.open(output / DATABASE) as file:
        assert file.num_cameras() == 1
    camera, geometry = stored(output)
    assert not camera.has_prior_focal_length
    assert kind(geometry) == "UNCALIBRATED"
    assert np.linalg.norm(geometry.F) > 0


def test_what_colmap_makes_of_turned_photographs_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene(tmp_path / "photos")
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    with Image.open(scene.folder / "b.jpg") as image:
        image.save(scene.folder / "b.jpg", exif=exif)
    for orient, height in (("true", 768), ("false", 512)):
        output = scene.match(tmp_path / orient, "export=colmap", f"orient={orient}")
        said = " ".join(capsys.readouterr().out.split())
        assert ("turned by their orientation tags: b.jpg" in said) == (orient == "true")
        assert ("COLMAP reads files as they are stored" in said) == (orient == "true")
        with pycolmap.Database.open(output / DATABASE) as file:
            assert [camera.height for camera in file.read_all_cameras()] == [512, height]
