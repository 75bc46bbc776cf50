"""The commands that export: a folder of images and an evaluation, resumed, refused, and read back as a data set."""

import itertools
import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
from omegaconf import DictConfig
from PIL import ExifTags, Image

import fmtorch
from fmtorch import data
from fmtorch.commands import match as match_command
from fmtorch.data import Lens, load, read_image
from fmtorch.io import DATABASE
from fmtorch.io.export import FEATURES, MATCHES
from fmtorch.pipeline import chosen_pairs, images_below
from fmtorch.runs import RunFolder
from tests.commands.test_match import BENT, photographed
from tests.conftest import shared_path
from tests.helpers import call_command, compose, draw, draw_set
from tests.reference.known_cameras import pose_error

OPTIONS = ("features.max_features=400", "estimator=lmeds", "estimator.hypotheses=100", "cache=off")


def config(command: str, *words: str) -> DictConfig:
    return compose(command, ("pipeline=sift_ratio", *OPTIONS, *words))


@pytest.fixture
def images(tmp_path: Path) -> Path:
    for i, name in enumerate(("a.png", "b.png", "more/c.png")):
        draw(tmp_path / "images" / name, seed=0, shift=12 * i)
    draw(tmp_path / "images" / "other.png", seed=1)
    (tmp_path / "images" / "notes.txt").write_text("no image")
    return tmp_path / "images"


def match(images: Path, output: Path, *words: str) -> Path:
    return match_command.run(config("match", f"images={images}", f"output={output}", *words), "sift_ratio")


def test_a_folder_of_images(images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = match(images, tmp_path / "out", "export=[h5,colmap]")
    said = capsys.readouterr().out
    assert "3 of 6 pairs show one scene" in said
    assert "taken from" not in said
    with h5py.File(output / FEATURES) as features, h5py.File(output / MATCHES) as matches:
        points = {name: features[f"{name}/keypoints"][:] for name in ("a.png", "more/c.png")}
        group = matches["a.png/more-c.png"]
        i = np.flatnonzero(group["inliers0"])
        moved = points["more/c.png"][group["matches0"][:][i]] - points["a.png"][i]
        assert len(i) > 50
        np.testing.assert_allclose(np.median(moved, axis=0), [-24, 0], atol=0.1)
    with pycolmap.Database.open(output / DATABASE) as file:
        assert (file.num_images(), file.num_cameras()) == (4, 4)
        assert file.num_verified_image_pairs() == 3

    graph = json.loads((output / "graph.json").read_text())
    assert graph["components"] == [["a.png", "b.png", "more/c.png"], ["other.png"]]
    assert sum(pair["related"] for pair in graph["pairs"]) == 3
    assert "connected images: 3; 1 image is in no related pair" in said
    assert len((output / "graph.csv").read_text().splitlines()) == 7
    assert (output / "graph.svg").read_text().count("<line") == 3

    # Again: nothing is computed, the files are the same.
    before = (output / MATCHES).read_bytes()
    match(images, tmp_path / "out", "export=h5")
    assert "6 of 6 pairs taken from an earlier run" in capsys.readouterr().out
    assert (output / MATCHES).read_bytes() == before

    # Interrupted: what is missing is computed. Another image of a name: its pairs are computed anew.
    next((output / "export" / "pairs").iterdir()).unlink()
    draw(images / "other.png", seed=0, shift=30)
    match(images, tmp_path / "out", "export=h5")
    said = capsys.readouterr().out
    assert re.search(r"[23] of 6 pairs taken from an earlier run", said)
    assert "6 of 6 pairs show one scene" in said

    with pytest.raises(ValueError, match=r"holds matches of other settings; .*: seed: 0 -> 3\. Choose another output"):
        match(images, tmp_path / "out", "seed=3")


def test_one_bad_image_does_not_end_the_work(images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (images / "bad.png").write_bytes(b"\x89PNG and no more")
    output = match(images, tmp_path / "out", "export=h5")
    assert len(re.findall("bad.png", capsys.readouterr().err)) == 1
    with h5py.File(output / FEATURES) as file:
        assert sorted(file) == ["a.png", "b.png", "more", "other.png"]
    for path in images.rglob("*.png"):
        path.write_bytes(b"\x89PNG and no more")
    with pytest.raises(ValueError, match="no pair could be matched, the first because: ImageError"):
        match(images, tmp_path / "out2", "export=h5")


def test_pairs_that_look_alike(images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (images / "bad.png").write_bytes(b"\x89PNG and no more")
    output = match(images, tmp_path / "out", "pairs=similar:2")
    names = [(pair["image0"], pair["image1"]) for pair in json.loads((output / "graph.json").read_text())["pairs"]]
    assert set(itertools.combinations(["a.png", "b.png", "more/c.png"], 2)) < set(names)
    assert not any("bad.png" in pair for pair in names)
    assert len(re.findall("bad.png", capsys.readouterr().err)) == 1
    match(images, tmp_path / "out", "pairs=sequential:1")  # of the same matches
    assert re.search("[234] of 4 pairs taken from an earlier run", capsys.readouterr().out)


def test_lists_of_pairs(images: Path, tmp_path: Path) -> None:
    paths = images_below(images)
    assert [path.relative_to(images).as_posix() for path in paths] == ["a.png", "b.png", "more/c.png", "other.png"]
    assert len(chosen_pairs(images, paths, Path("exhaustive"))) == 6
    (tmp_path / "pairs.txt").write_text("b.png a.png\n# again\na.png b.png\na.png other.png\n")
    chosen = chosen_pairs(images, paths, tmp_path / "pairs.txt")
    assert [(a.name, b.name) for a, b in chosen] == [("b.png", "a.png"), ("a.png", "other.png")]
    with pytest.raises(ValueError, match=r"list\.txt: no such file; it must be exhaustive, sequential:N, .* file"):
        chosen_pairs(images, paths, tmp_path / "list.txt")
    for text, said in {
        "a.png\n": "line 1: 'a.png'; it must be the names of two images",
        "# two\n\na.png a.png\n": "line 3: 'a.png a.png'; it must be",
        "a.png nowhere.png\n": "line 1: no image nowhere.png in ",
        "\n": "names no pair",
    }.items():
        (tmp_path / "pairs.txt").write_text(text)
        with pytest.raises(ValueError, match=said):
            chosen_pairs(images, paths, tmp_path / "pairs.txt")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["images=nowhere"], "images=nowhere is no folder"),
        (["images=.", "image0=a.png"], "images takes a folder; image0, image1, truth and lens are of a single pair"),
        (["image0=a.png", "image1=b.png", "export=h5"], "export and pairs are of a folder of images"),
        (["images=.", "pairs=similar:0"], "pairs=similar:0; it must be similar:N with a whole number N"),
        (["images=.", "pairs=similar:2", "features=l2net"], "no codebook for the descriptors l2net"),
        (["images=.", "export=bundler"], "'bundler' is none of h5, colmap"),
        (["images=.", "camera=mine"], "camera=mine; it must be one of: per_image, shared"),
    ],
)
def test_mistakes_are_reported(words: list[str], said: str, images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(images)
    with pytest.raises(ValueError, match=said):
        match_command.run(config("match", *words), "sift_ratio")


def test_an_evaluation_and_its_way_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = draw_set(tmp_path / "Set", pairs=[(0, 1), (0, 2), (1, 2)])
    camera = np.concatenate([[300, 0, 160, 0, 300, 120, 0, 0, 1], np.eye(3).ravel()])
    np.savetxt(root / "scene" / "Camera.txt", [np.concatenate([camera, [-i, 0, 0]]) for i in range(3)])
    for name, line in (("gt", "2 0 nan 0 0 0 0 -1 0 1 0"), ("which_dataset", "scene/")):
        path = next(root.glob(f"pairs_*{name}.txt"))
        path.write_text(f"{path.read_text()}{line}\n")

    def run(run_dir: str, *words: str) -> tuple[Path, dict[str, list[Any]]]:
        call_command(monkeypatch, tmp_path, "eval", "pipeline=sift_ratio", *OPTIONS, f"output={run_dir}", *words)
        path = tmp_path / run_dir
        return path, RunFolder.load(path).read().sort_by("pair").to_pydict()

    ours = ("dataset=fmbench", f"dataset.root={tmp_path / 'Set'}")
    _, plain = run("run", *ours)
    path, rows = run("run", *ours, "export=h5,colmap")  # its pairs are done, but were not kept
    assert rows == plain
    with pycolmap.Database.open(path / DATABASE) as file:
        assert (file.num_images(), file.num_cameras(), file.num_matched_image_pairs()) == (3, 1, 3)
        assert file.read_camera(1).has_prior_focal_length
        geometry = file.read_two_view_geometry(1, 2)
    planar = pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC  # pictures that are shifted
    assert geometry.config == int(planar)
    np.testing.assert_allclose(geometry.H / geometry.H[2, 2], [[1, 0, -9], [0, 1, 0], [0, 0, 1]], atol=0.2)
    with h5py.File(path / MATCHES) as file:
        group = file["00000000.png/00000001.png"]
        assert group.attrs["configuration"] == "planar_or_panoramic"
        H = group.attrs["H"]
        np.testing.assert_allclose(H / H[2, 2], [[1, 0, -9], [0, 1, 0], [0, 0, 1]], atol=0.2)
    kept = sorted((path / "export").rglob("*.npz"))
    assert len(kept) == 6
    changed = [file.stat().st_mtime_ns for file in kept]
    run("run", *ours, "export=h5")  # and now there is nothing to do
    assert [file.stat().st_mtime_ns for file in kept] == changed

    known = {"layout": "hloc", "truth": str(tmp_path / "Set")}
    dataset = data.load("h5", root=path, **known)
    assert [pair.problem is None for pair in dataset] == [True, True, True, False]
    words = ["dataset=h5", f"dataset.root={path}", *(f"dataset.{key}={value}" for key, value in known.items())]
    _, theirs = run("theirs", *words, "pruner=[]")
    for column in ("pair", "ok", "corrs_before", "inlier_rate_before"):
        assert theirs[column] == plain[column]
    assert theirs["features0"][:3] == plain["features0"][:3]
    assert all(np.isnan(seconds or np.nan) for seconds in theirs["seconds_features"])
    with pytest.raises(SystemExit, match="no pair has images in which a pipeline finds keypoints"):
        run("none", *words, "pruner=[]", "export=h5")


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
        given = (f"images={self.folder}", f"output={output}", "longest_side=768", "cache=off", *words)
        return match_command.run(compose("match", ("pipeline=sift_fmtorch", *given)), "sift_fmtorch")


def stored(folder: Path) -> tuple[Any, Any]:
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
    assert pose_error(pose.rotation.matrix(), pose.translation, scene.pair) < 0.5
    with h5py.File(output / MATCHES) as file:
        attributes = dict(file["a.jpg/b.jpg"].attrs)
    np.testing.assert_allclose(attributes["R"], pose.rotation.matrix(), atol=1e-9)
    assert (attributes["configuration"], attributes["E"].shape) == ("calibrated", (3, 3))

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
    assert pose_error(pose.rotation.matrix(), pose.translation, scene.pair) < 0.6
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
    assert (camera.focal_length, kind(geometry)) == (pytest.approx(focal), "CALIBRATED")
    pose = geometry.cam2_from_cam1
    assert pose_error(pose.rotation.matrix(), pose.translation, scene.pair) < 3
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
