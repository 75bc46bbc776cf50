"""PoseBench by its protocol, on samples of its layout from real matches, beside a run written from its definitions."""

import functools
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from fmtorch import data, presets
from fmtorch.core import Correspondences
from fmtorch.data import ImagePair
from scripts.benchmark import cameras as posebench
from scripts.benchmark.cameras import options_of
from scripts.benchmark.methods import pipeline_of, split
from scripts.benchmark.tables import Results
from tests.conftest import shared_path
from tests.io.writers import posebench_group
from tests.reference import metrics as reference
from tests.reference import solvers
from tests.scripts.samples import read, run

SET, THRESHOLD = "imc_london_bridge", 0.75
PAIRS = 4
PROTOCOL = {"max_epipolar_error": THRESHOLD, "max_iterations": 1000, "min_iterations": 100, "success_prob": 0.9999}
COLMAP = {"max_error": THRESHOLD, "max_num_trials": 1000, "min_num_trials": 100, "confidence": 0.9999, "random_seed": 0}


@functools.cache
def real() -> list[tuple[ImagePair, Correspondences]]:
    dataset = data.load("fmbench", root=shared_path("data/PhotoTourism"))
    outcomes = pipeline_of("sift_ratio").correspondences([dataset[i] for i in range(PAIRS)])
    return [(o.pair, o.correspondences) for o in outcomes if o.correspondences is not None]


def matched(c: Correspondences) -> tuple[np.ndarray, np.ndarray]:
    x0, x1 = (np.ascontiguousarray(x[0][c.mask[0]].double().numpy()) for x in (c.x0, c.x1))
    return x0, x1


def sample(folder: Path, name: str = SET) -> Path:
    """The real pairs as one of PoseBench's files, the last of them with three matches."""
    folder.mkdir(parents=True)
    with h5py.File(folder / f"{name}.h5", "w") as file:
        for i, (pair, c) in enumerate(real()):
            x = matched(c) if i < PAIRS - 1 else tuple(v[:3] for v in matched(c))
            sizes = [tuple(int(v) for v in s[0]) for s in (c.size0, c.size1)]
            posebench_group(file, f"{i:03d}", x, (pair.K0, pair.K1), (pair.R, pair.t), tuple(sizes))
    return folder


def direct(method: str) -> list[float]:
    """The larger angle of each pair: the libraries called as PoseBench calls them, judged by its definitions."""
    errors = []
    for pair, c in real()[:-1]:
        cameras = []
        for K, ((height, width),) in ((pair.K0, c.size0.tolist()), (pair.K1, c.size1.tolist())):
            params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
            cameras.append({"model": "PINHOLE", "width": width, "height": height, "params": params})
        F, R, t = CALLS[method](matched(c), cameras)
        poses = [(R, t)] if F is None else solvers.poses(pair.K1.T @ F @ pair.K0)
        errors.append(max(reference.closest_pose_error(poses, pair.R, pair.t)))
    return [*errors, 180.0]  # three matches


def _poselib_e(x: Any, cameras: Any) -> Any:
    poselib = pytest.importorskip("poselib")
    pose, _ = poselib.estimate_relative_pose(*x, *cameras, {**PROTOCOL, "seed": 0}, {})
    return None, np.asarray(pose.R), np.asarray(pose.t)


def _poselib_f(x: Any, cameras: Any) -> Any:
    poselib = pytest.importorskip("poselib")
    return np.asarray(poselib.estimate_fundamental(*x, {**PROTOCOL, "seed": 0}, {})[0]), None, None


def _colmap_e(x: Any, cameras: Any) -> Any:
    pycolmap = pytest.importorskip("pycolmap")
    own = pycolmap.RANSACOptions(**COLMAP)
    result = pycolmap.estimate_essential_matrix(*x, *(pycolmap.Camera(camera) for camera in cameras), own)
    return None, result["cam2_from_cam1"].rotation.matrix(), result["cam2_from_cam1"].translation


def _colmap_f(x: Any, cameras: Any) -> Any:
    pycolmap = pytest.importorskip("pycolmap")
    return pycolmap.estimate_fundamental_matrix(*x, pycolmap.RANSACOptions(**COLMAP))["F"], None, None


CALLS = {"E:poselib": _poselib_e, "F:poselib": _poselib_f, "E:colmap": _colmap_e, "F:colmap": _colmap_f}


@pytest.mark.parametrize("method", CALLS)
def test_peers_have_the_figures_of_posebenchs_own_protocol(method, tmp_path, capsys, monkeypatch):
    expected = direct(method)
    rows = tmp_path / "rows.jsonl"
    folder = sample(tmp_path / "relative")
    printed = run(capsys, monkeypatch, "posebench", folder, "--methods", method, "--rows", rows)
    errors = [max(each["rotation_error"], each["translation_error"]) for each in read(rows)]
    # arccos at a cosine near 1 is exact to the root of its rounding; pixels with a central principal point, to 1e-7
    assert errors == pytest.approx(expected, abs=1e-3)
    areas = [100 * area for area in reference.pose_auc(expected, (5.0, 10.0, 20.0))]
    results = Results(read(rows))
    assert list(posebench.areas(results, method, results.all_pairs).values()) == pytest.approx(areas, abs=0.02)
    published = {"E:poselib": "56.6", "F:colmap": "33.0"}  # of the whole set
    assert published.get(method, "") in printed
    assert [each["reason"] != "" for each in read(rows)] == [False] * (PAIRS - 1) + [True]


def test_our_estimators_run_by_the_protocol_and_a_run_goes_on_where_it_stopped(tmp_path, capsys, monkeypatch):
    rows, methods = tmp_path / "rows.jsonl", ["E:fmtorch", "F:fmtorch", "E:fmtorch:scaled=false"]
    arguments = [sample(tmp_path / "relative").parent, "--methods", *methods, "--rows", rows]
    printed = run(capsys, monkeypatch, "posebench", *arguments, "--every", 3)
    assert "1 sets, 1 of its 20; 2 pairs" in printed
    assert [line.split("|")[2].strip() for line in printed.splitlines() if "E:colmap" in line] == ["E:colmap"] * 2
    first = read(rows)
    assert len(first) == 2 * len(methods)
    run(capsys, monkeypatch, "posebench", *arguments)
    assert read(rows)[: len(first)] == first
    posed = [each for each in read(rows) if not each["reason"]]
    assert PAIRS * len(methods) >= len(posed) >= (PAIRS - 1) * len(methods) - 1
    assert np.median([max(each["rotation_error"], each["translation_error"]) for each in posed]) < 5


def test_the_protocol_gives_each_estimator_its_options() -> None:
    def protocol(text: str, px: float) -> dict[str, Any]:
        return options_of(*split(text.partition(":")[2]), px)

    assert protocol("F:poselib", 2.5) == {
        "threshold": 2.5, "iterations": 1000, "min_iterations": 100, "confidence": 0.9999,
    }  # fmt: skip
    assert [protocol(f"E:colmap{o}", 1.5)["two_view"] for o in ("", ":two_view=true")] == [False, True]
    preset, own = presets.load("estimator", "fmtorch"), protocol("E:fmtorch", 2.0)
    assert own["threshold"] == 2 * preset["threshold"]
    assert own["select"]["scale"] == 2 * preset["select"]["scale"]
    assert (own["hypotheses"], own["focal"]["rounds"] * preset["focal"]["samples"]) == (1000, 1000)
    kept = protocol("E:fmtorch:scaled=false,focal.rounds=12", 2.0)
    assert "threshold" not in kept
    assert kept["focal"] == {"rounds": 12}
    presets.build("estimator", "fmtorch", **own)
    for wrong in ("fmtorch", "H:fmtorch", "E:nobody"):
        with pytest.raises(SystemExit, match="write KIND:PRESET"):
            posebench.protocol(wrong, 1.0)


def test_what_is_not_posebenchs_is_named(tmp_path, capsys, monkeypatch):
    own = sample(tmp_path / "own", "mine")
    lmeds = ["--methods", "F:opencv:method=lmeds"]
    with pytest.raises(SystemExit, match=r"mine\.h5 is none of PoseBench's sets: give its threshold in pixels"):
        run(capsys, monkeypatch, "posebench", own)
    assert "published" not in run(capsys, monkeypatch, "posebench", own, "--threshold", 1, *lmeds).splitlines()[2]
    with pytest.raises(SystemExit, match=r"holds no file \.h5 or \.hdf5; give the folder `relative`"):
        run(capsys, monkeypatch, "posebench", tmp_path)
    with h5py.File(own / "mine.h5", "r+") as file:
        del file["001/camera1/model"]
        file["001/camera1/model"] = np.array(["OPENCV_FISHEYE"], dtype=h5py.string_dtype())
    assert f" {PAIRS - 1} pairs" in run(capsys, monkeypatch, "posebench", own, "--threshold", 1, *lmeds)
    with pytest.raises(SystemExit, match="--root: give the threshold in pixels"):
        run(capsys, monkeypatch, "posebench", "--root", shared_path("data/PhotoTourism"))
