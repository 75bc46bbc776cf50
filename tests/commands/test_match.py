"""Two photographs: the function, the command, and the name `fmtorch.match` that both have."""

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

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
from fmtorch.core.files import conf_dir
from fmtorch.core.types import RELATED, WARNINGS
from fmtorch.data import ImageError, read_image
from fmtorch.geometry import homography_points, sampson
from fmtorch.metrics import nsgd
from fmtorch.pipeline.pipeline import load_pipeline
from tests.conftest import own_cache, shared_path
from tests.matching import stand_in
from tests.processes import run_command

ROWS = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a sideways camera: epipolar lines are rows
BANDS = (30, 5, 42, 18, 36, 11)  # disparities of bands of the picture, from the top, in 1/640 of its width


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
def pipeline() -> fmtorch.pipeline.pipeline.Pipeline:
    return load_pipeline("sift_gms", overrides=["features.max_features=1500", "estimator.hypotheses=500"])


def distance(F: torch.Tensor, shape: tuple[int, ...]) -> float:
    """NSGD to the true F."""
    size = torch.tensor([shape[:2]])
    return float(nsgd(torch.from_numpy(ROWS)[None], F[None], size, size)[0])


def test_matches_and_fundamental_matrix_of_arrays(pipeline: fmtorch.pipeline.pipeline.Pipeline) -> None:
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


def test_equal_to_the_pipeline_on_files(pipeline: fmtorch.pipeline.pipeline.Pipeline, tmp_path: Path) -> None:
    images = stereo()
    for i in (0, 1):
        cv2.imwrite(str(tmp_path / f"{i}.png"), images[i][..., ::-1])
    by_path = fmtorch.match(str(tmp_path / "0.png"), tmp_path / "1.png", pipeline=pipeline)
    by_array = fmtorch.match(*images, pipeline=pipeline)
    assert torch.equal(by_path.F, by_array.F)
    source = [fmtorch.data.ImageSource(f"{i}", tmp_path / f"{i}.png") for i in (0, 1)]
    outcome = pipeline.correspondences([fmtorch.data.ImagePair("p", "f", "s", *source, ROWS)])[0]
    # Correspondences do not depend on the pair's key, which the pipeline hashes from its identity.
    assert torch.equal(outcome.correspondences.x0, by_path.correspondences.x0)
    grey = fmtorch.match(*(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images), pipeline=pipeline)
    assert torch.equal(grey.F, by_array.F)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tiff", "webp"])
def test_formats(suffix: str, pipeline: fmtorch.pipeline.pipeline.Pipeline, tmp_path: Path) -> None:
    images = stereo()
    for i in (0, 1):
        Image.fromarray(images[i]).save(tmp_path / f"{i}.{suffix}", ratio=95)
    result = fmtorch.match(tmp_path / f"0.{suffix}", tmp_path / f"1.{suffix}", pipeline=pipeline)
    assert result.ok
    assert distance(result.F, images[0].shape) < 0.01


# How a stored image must be turned for each value of the EXIF orientation, undone.
STORED = {
    1: lambda image: image,
    3: lambda image: np.rot90(image, 2),
    6: lambda image: np.rot90(image, 1),  # shown after a quarter turn clockwise
    8: lambda image: np.rot90(image, -1),
    2: lambda image: image[:, ::-1],
}


@pytest.mark.parametrize("orientation", STORED)
def test_exif_orientation(orientation: int, pipeline: fmtorch.pipeline.pipeline.Pipeline, tmp_path: Path) -> None:
    image0, image1 = stereo()
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = Image.fromarray(np.ascontiguousarray(STORED[orientation](image1)))
    stored.save(tmp_path / "1.jpg", exif=exif, ratio=95)
    assert read_image(tmp_path / "1.jpg", orient=True).shape == image1.shape
    result = fmtorch.match(image0, tmp_path / "1.jpg", pipeline=pipeline)
    assert torch.equal(result.correspondences.size1, torch.tensor([image1.shape[:2]]))
    assert distance(result.F, image0.shape) < 0.01


def test_reduction_gives_pixels_of_the_originals(pipeline: fmtorch.pipeline.pipeline.Pipeline) -> None:
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
    # The same F: the same residuals x1^T F x0 up to scale and rounding of the points.
    both = [r.correspondences for r in (reduced, directly)]
    ends = [(torch.cat([x.double(), torch.ones_like(x[..., :1])], -1)[0] for x in (c.x0, c.x1)) for c in both]
    values = [torch.einsum("ni,ij,nj->n", x1, F, x0) for (x0, x1), F in zip(ends, (reduced.F, directly.F), strict=True)]
    ratio = (values[0] @ values[1]) / (values[1] @ values[1])
    # A residual moves by |gradient| * 1e-4 px; 1e-3 px of a gradient near 1 (F scaled so that normals have norm 1).
    assert (values[0] - ratio * values[1]).abs().max() < 1e-3 * values[0].abs().max() + 1e-3 * float(
        reduced.F[:2].norm()
    )


def test_reduced_and_full_size_agree_with_the_scene(pipeline: fmtorch.pipeline.pipeline.Pipeline) -> None:
    image0, image1 = stereo(960, 1280)
    keypoints = []
    for longest_side in (1280, 500):
        result = fmtorch.match(image0, image1, pipeline=pipeline, longest_side=longest_side)
        c = result.correspondences
        true = 2 * torch.tensor(BANDS)[(c.x0[0, :, 1] / 160).long().clamp(0, 5)]
        error = (c.x0 - c.x1)[0, :, 0] - true
        # SIFT's own error, some 0.1 px of the image that it sees.
        assert error[result.inliers].abs().median() < 0.1 * 1280 / longest_side
        assert distance(result.F, image0.shape) < 0.01
        keypoints.append(result.keypoints0)
    # The same keypoints stand at the same place. Without the half pixels they would be (2.56 - 1) / 2 = 0.78 px apart.
    gap, nearest = torch.cdist(keypoints[1], keypoints[0]).min(1)
    apart = (keypoints[0][nearest] - keypoints[1])[gap < 2]
    assert len(apart) > 100
    assert apart.median(0).values.abs().max() < 0.2


def test_photographs_that_cannot_be_related(pipeline: fmtorch.pipeline.pipeline.Pipeline) -> None:
    image = stereo()[0]
    flat = np.full((100, 120, 3), 90, np.uint8)
    for other, reason in ((flat, "no keypoints in image1"), (image[:1], "no keypoints in image1")):
        result = fmtorch.match(image, other, pipeline=pipeline)
        assert not result.ok
        assert reason in result.reason
        assert not result.F.any()
        assert len(result.kept) == len(result.inliers) == 0
        assert result.correspondences.mask.shape == (1, 0)
    unrelated = fmtorch.match(image, stereo(seed=1)[0], pipeline=pipeline)
    assert "at least 8 are needed" in unrelated.reason
    assert not unrelated.related
    assert unrelated.significance == -math.inf
    same = fmtorch.match(image, image, pipeline=pipeline)
    assert "no motion" in same.warning


def test_photographs_that_determine_no_f(pipeline: fmtorch.pipeline.pipeline.Pipeline) -> None:
    """A turned camera, a plane, a crop and a recompressed copy, made of a photograph, with H; not so with depth."""
    image = read_image(shared_path("data/Strecha/fountain-P11/Images/00000002.jpg"))
    h, w = image.shape[:2]
    f, angle = 1.2 * w, math.radians(6)
    K = np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])
    R = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    R = R @ np.array([[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]])
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


LMEDS = ("estimator=lmeds_eight_point",)


def test_an_f_of_photographs_with_nothing_in_common() -> None:
    """Some F is found, and the verdict tells that it means nothing."""
    overrides = [*LMEDS, "features.max_features=1500", "pruner.ratio.threshold=0.95"]
    lenient = load_pipeline("sift_ratio", overrides=overrides)
    images = stereo()[0], stereo(seed=1)[0]
    result = fmtorch.match(*images, pipeline=lenient)
    assert result.ok
    assert not result.related
    assert result.significance < RELATED
    assert (result.pair_type, result.homography) == ("unrelated", None)
    good = fmtorch.match(*stereo(), pipeline=lenient)
    assert good.related
    assert good.significance > 10
    # In other pixels the same; here of images reduced by half.
    halved = fmtorch.match(*stereo(), pipeline=lenient, longest_side=320)
    assert halved.related


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
def test_errors(
    arguments: tuple[object, ...], options: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        fmtorch.match(*arguments, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", presets.available("pipeline"))
def test_every_pipeline_composes_by_name(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in.install(tmp_path, monkeypatch)
    for module in ("features.kornia_features", "matching.lightglue"):  # without fetching others' weights
        monkeypatch.setattr(f"fmtorch.{module}.pretrained", lambda load, *_: torch.nn.Identity())
    built = load_pipeline(name)
    assert built.pruners or name in ("aliked_lightglue", "disk_lightglue", "given_fmtorch")


def test_overrides_and_a_callers_own_hydra() -> None:
    with initialize_config_dir(str(conf_dir()), version_base=None):
        before = GlobalHydra.instance().hydra
        built = load_pipeline("paper/sift_gms", overrides=["pruner.gms.with_scale=true"])
        assert GlobalHydra.instance().hydra is before
        assert compose("match").longest_side == 1600
    assert list(built.pruners) == ["ratio", "gms"]
    assert built.pruners["gms"].with_scale  # type: ignore[attr-defined]
    assert built.pruners["gms"].threshold_factor == 4  # type: ignore[attr-defined]
    assert not GlobalHydra.instance().is_initialized()
    with pytest.raises(ValueError, match=r"pruner\.gms\.angle"):
        load_pipeline("sift_gms", overrides=["pruner.gms.angle=1"])


def run_python(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command as a user does, or other arguments of Python."""
    if arguments[:2] == ("-m", "fmtorch"):
        return run_command(*arguments[2:], cwd=cwd, environment={"CUDA_VISIBLE_DEVICES": ""})
    source = str(Path(__file__).resolve().parents[2])
    own = {"COLUMNS": "200", "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1", "FMTORCH_CACHE": str(own_cache(cwd))}
    env = {**os.environ, "PYTHONPATH": source, **own}
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, timeout=300, check=False)


def test_the_command(tmp_path: Path) -> None:
    image0, image1 = stereo(240, 320)
    Image.fromarray(image0).save(tmp_path / "a.png")
    Image.fromarray(image1).save(tmp_path / "b.webp", ratio=95)
    (tmp_path / "F.txt").write_text("0 0 0\n0 0 -2\n0, 2, 0\n")
    done = run_python("-m", "fmtorch", "match", "image0=a.png", "image1=b.webp", "truth=F.txt", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "RuntimeWarning" not in done.stderr
    for text in ("hesaffnet_fast_fmtorch", "one_to_one", "inliers", "seconds", "NSGD", "matches/a-b"):
        assert text in done.stdout
    folder = tmp_path / "matches" / "a-b"
    assert {path.name for path in folder.iterdir()} == {"result.json", "matches.png", "pruning.png", "epipolar.png"}
    assert {path.name for path in tmp_path.iterdir()} == {"a.png", "b.webp", "F.txt", "matches", "cache"}
    report = json.loads((folder / "result.json").read_text())
    assert report["pipeline"] == "hesaffnet_fast_fmtorch"
    assert report["overrides"] == []
    assert report["size0"] == report["size1"] == [240, 320]
    assert report["reason"] == ""
    assert report["related"] is True
    assert report["significance"] > 100
    assert "not the same scene" not in done.stderr
    assert report["nsgd"] < 0.01
    kept = report["matches"]["frame_consistency"]
    assert np.shape(report["x0"]) == np.shape(report["x1"]) == (kept, 2)
    assert len(report["ratio"]) == len(report["inliers"]) == kept
    assert max(report["ratio"]) < 0.8
    assert sum(report["inliers"]) == report["matches"]["estimation"]
    result = fmtorch.match(tmp_path / "a.png", tmp_path / "b.webp")
    assert np.array_equal(np.array(report["F"]), result.F.numpy())
    for name in ("matches.png", "pruning.png", "epipolar.png"):
        assert read_image(folder / name).ndim == 3

    # Without F, into the same folder: a picture, the reason, status 0, and nothing left of the earlier pair.
    cv2.imwrite(str(tmp_path / "flat.png"), np.full((300, 20), 90, np.uint8))
    other = ("image1=flat.png", f"output={folder}", "pipeline=sift_gms", "pruner=[ratio]")
    done = run_python("-m", "fmtorch", "match", "image0=a.png", *other, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "sift_gms pruner=[ratio]: a.png, flat.png" in done.stdout
    assert "no keypoints in image1" in done.stderr
    assert {path.name for path in folder.iterdir()} == {"result.json", "matches.png"}
    report = json.loads((folder / "result.json").read_text())
    assert report["overrides"] == ["pruner=[ratio]"]
    assert report["F"] is None
    assert "no keypoints" in report["reason"]
    assert report["related"] is False
    assert report["significance"] is None

    # With F, of photographs that show nothing in common.
    Image.fromarray(stereo(240, 320, seed=1)[0]).save(tmp_path / "other.png")
    other = ("image1=other.png", f"output={folder}", "pipeline=sift_ratio", *LMEDS, "pruner.ratio.threshold=0.95")
    done = run_python("-m", "fmtorch", "match", "image0=a.png", *other, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "probably not the same scene" in done.stderr
    report = json.loads((folder / "result.json").read_text())
    assert np.shape(report["F"]) == (3, 3)
    assert report["related"] is False
    assert report["significance"] < RELATED
    assert (report["pair_type"], report["homography"]) == ("unrelated", None)
    assert done.stderr.count("nothing in common") == 0  # which is said already

    # One photograph twice: the table and a warning say it.
    done = run_python("-m", "fmtorch", "match", "image0=a.png", "image1=a.png", "output=same", cwd=tmp_path)
    assert "identical" in done.stdout
    assert "no motion" in done.stderr
    report = json.loads((tmp_path / "same" / "result.json").read_text())
    assert report["pair_type"] == "identical"
    np.testing.assert_allclose(np.array(report["homography"]) / report["homography"][2][2], np.eye(3), atol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["image0=a.png"], "image1 is missing"),
        (["image0=a.png", "image1=no.png"], "no.png: cannot be read"),
        (["image0=a.png", "image1=a.png", "truth=F.txt"], "F.txt: holds 3 numbers"),
        (["image0=a.png", "image1=a.png", "pipeline=sift_magic"], "sift_gms"),
    ],
)
def test_what_cannot_be_done_is_told(arguments: list[str], message: str, tmp_path: Path) -> None:
    Image.fromarray(stereo()[0]).save(tmp_path / "a.png")
    (tmp_path / "F.txt").write_text("1 2 3\n")
    done = run_python("-m", "fmtorch", "match", *arguments, cwd=tmp_path)
    assert done.returncode == 1
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "matches").exists()


def test_on_a_real_pair() -> None:
    images = shared_path("data/Strecha/fountain-P11/Images")
    subsets = shared_path("data/Strecha/pairs_which_dataset.txt").read_text().split()
    lines = shared_path("data/Strecha/pairs_with_gt.txt").read_text().splitlines()
    truth = next(
        np.array(line.split()[2:], float).reshape(3, 3)
        for subset, line in zip(subsets, lines, strict=True)
        if subset == "fountain-P11/" and line.split()[:2] == ["2", "6"]
    )
    for name in ("sift_gms", "sift_lpm"):
        result = fmtorch.match(images / "00000002.jpg", images / "00000006.jpg", pipeline=name, longest_side=800)
        sizes = result.correspondences.size0, result.correspondences.size1
        assert float(nsgd(torch.from_numpy(truth)[None], result.F[None], *sizes)[0]) < 0.01


def test_others_of_the_same_names_overwrite_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    paths = [Path("x/a.jpg"), Path("x/b.jpg")]
    others = [Path("y/a.jpg"), Path("y/b.jpg")]
    settings = {"pipeline": "sift_gms", "seed": 0, "cameras": None}
    folder = match_command._default_output(paths, settings)
    assert folder == Path("matches/a-b")
    folder.mkdir(parents=True)
    (folder / "result.json").write_text(json.dumps({"image0": "x/a.jpg", "image1": "x/b.jpg", **settings}))
    assert match_command._default_output(paths, settings) == folder
    assert match_command._default_output([path.absolute() for path in paths], settings) == folder
    elsewhere = match_command._default_output(others, settings)
    assert re.fullmatch(r"a-b-[0-9a-f]{8}", elsewhere.name)
    assert match_command._default_output(others, settings) == elsewhere
    for changed in ({"seed": 1}, {"pipeline": "sift_lpm"}, {"cameras": "unknown"}):
        other = match_command._default_output(paths, settings | changed)
        assert other not in (folder, elsewhere)
        assert other == match_command._default_output(paths, settings | changed)
