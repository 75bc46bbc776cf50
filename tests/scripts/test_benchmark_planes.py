"""Benchmarks with programs of their own: related pairs, planes, cameras, verified databases; PoseBench by its protocol,
on samples of its layout from real matches, beside a run written from its definitions."""

import functools
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
import torch
from skimage import data as images

from fmtorch import data, presets
from fmtorch.core import Correspondences, Estimate
from fmtorch.data import ImagePair, ImageSource
from fmtorch.geometry import homography_transfer
from fmtorch.scenes import PICTURES, Plan, RenderedPairs
from fmtorch.two_view.known_cameras import KnownCameras
from fmtorch.two_view.pair_type import classify
from scripts.benchmark import cameras, pairs, pipelines, planes, verify
from scripts.benchmark.cameras import LEVELS, TAKES, applies, bougnoux, calibrations, described, options_of
from scripts.benchmark.methods import pipeline_of, read_specs, split
from scripts.benchmark.runner import Item, Kept, Method, Row
from scripts.benchmark.tables import Results
from scripts.benchmark.verify import Scene, accuracy, calibrate, centre_errors, sheets
from tests.conftest import shared_path
from tests.helpers import draw_set
from tests.io.writers import posebench_group
from tests.reference import metrics, solvers
from tests.reference.known_cameras import fundamental
from tests.scripts.samples import item as plain_item
from tests.scripts.samples import pair, read, run
from tests.verification import databases


def seen_pair(scene: str, i: int, j: int) -> ImagePair:
    images = [ImageSource(f"{scene}/{k}", Path(f"{scene}{k}.png")) for k in (i, j)]
    return ImagePair(f"family/{scene}/{i}-{j}", "family", scene, *images, np.eye(3))


def test_unrelated_pairs_cross_scenes_and_are_chosen_once() -> None:
    ours = [seen_pair(scene, i, i + 1) for scene in ("a", "b", "c") for i in range(4)]
    every = pairs.unrelated_pairs(ours, [], 100)
    assert len(every) == len({frozenset((p.image0.identity, p.image1.identity)) for p in every}) == 3 * 5 * 5
    assert all(p.image0.identity[0] != p.image1.identity[0] for p in every)
    some = pairs.unrelated_pairs(ours, [], 7)
    assert {p.identity for p in some} < {p.identity for p in every}
    assert len(some) == 3 * 7
    assert all(p.family.startswith(pairs.UNRELATED) and not p.F.any() for p in every)


def test_rendered_scenes_that_show_one_photograph_are_not_paired(tmp_path, monkeypatch):
    dataset = RenderedPairs("train", families=["indoor"], root=tmp_path, plan=Plan(1, 2, 1, scale=0.2), workers=1)
    (shown,) = pairs.photographs_shown(dataset).values()
    assert shown
    assert shown <= set(PICTURES["train"])
    shows = {"a": frozenset({"moon"}), "b": frozenset({"moon", "text"}), "c": frozenset({"text"}), "d": frozenset()}
    monkeypatch.setattr(pairs, "photographs_shown", lambda dataset: shows)
    monkeypatch.setattr(pairs, "RenderedPairs", list)
    ours = [*(seen_pair(scene, 0, 1) for scene in "abcd"), seen_pair("real", 0, 1)]
    crossed = {p.scene.replace("family/", "") for p in pairs.unrelated_pairs(ours, [[]], 100)}
    assert crossed == {"a | c", "a | d", "b | d", "c | d"}  # neither a | b, b | c, nor a drawn and a real one


def test_the_command_tells_pairs_apart(tmp_path, capsys, monkeypatch):
    rows, named = tmp_path / "rows.jsonl", ["sift_gms", "sift_ratio*"]
    root = draw_set(tmp_path / "Set", "ab", images=2)
    run(capsys, monkeypatch, "related", "--root", root, "--unrelated", 3, "--pipelines",
        *named, "--cache", "off", "--rows", rows, "--figure", tmp_path / "roc.svg")  # fmt: skip
    own = read(rows)
    assert len(own) == 2 * (2 + 3)
    assert all(r["called"] == r["true"] for each in pipelines.verdicts(own).values() for r in each)
    assert "sift_gms" in run(capsys, monkeypatch, "related", "--rows", rows)
    assert "estimator=lmeds_eight_point" in (tmp_path / "roc.svg").read_text()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    for name in ("astronaut", "coffee", "chelsea", "rocket"):
        cv2.imwrite(str(folder / f"{name}.png"), getattr(images, name)()[..., ::-1])
    return folder


def test_pairs_are_of_their_kinds(folder: Path) -> None:
    items = list(planes.kinds(sorted(folder.iterdir())[:2]))[:5]
    truths = [item.facts["truth"] for item in items]
    assert truths == ["planar", "rotation", "identical", "identical", "unrelated"]
    estimator = presets.build("estimator", "fmtorch")
    assert [planes.by_ours(estimator, True, item.matches) for item in items] == truths
    c = items[1].matches
    R = classify(c, KnownCameras(estimator)(c, 0), focal_deviation=0).evidence.R
    near = homography_transfer(c.K1 @ R @ torch.linalg.inv(c.K0), c.x0.double(), c.x1.double())[1][c.mask] < 2
    assert float(near.double().mean()) > 0.5


def cells(printed: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")] for line in printed.splitlines() if line.startswith("| ")]


def test_the_commands(folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap")
    arguments = ["--photographs", folder, "--limit", 2]
    printed = run(capsys, monkeypatch, "pair_types", *arguments, "--colmap", 4)
    assert [line[-2] for line in cells(printed) if line[1].startswith("fmtorch")] == ["100.0"] * 5
    assert "COLMAP, 4 px" in printed
    methods = ["--methods", "ours", "ours:pool=6", "usac_magsac:1", "--kinds", "warped", "hard", "--seeds", 1]
    printed = run(capsys, monkeypatch, "homography", *arguments, *methods)
    lines = cells(printed)
    assert [(line[1], line[3]) for line in lines[2:]] == [(k, m) for k in ("hard", "warped") for m in methods[1:4]]
    assert all(float(line[6]) > 80 for line in lines[2:])  # AUC@5 px


def test_an_estimate_is_judged_where_the_plane_is_seen(folder: Path) -> None:
    (item,) = planes.warped(sorted(folder.iterdir())[:1], 1, hard_too=False)
    shifted = np.array([[1, 0, 3], [0, 1, 4], [0, 0, 1]]) @ item.pair.H
    errors = [planes.Homography("x:", lambda c, seed, H=H: H).figures(item, 0)["corner_error"]
              for H in (item.pair.H, shifted, None)]  # fmt: skip
    assert errors == [pytest.approx(0, abs=1e-9), pytest.approx(5), np.inf]


K = np.array([[950.0, 0, 499.5], [0, 950, 379.5], [0, 0, 1]])
R = cv2.Rodrigues(np.array([0.05, 0.3, 0.02]))[0]
T = np.array([-1.0, 0.1, 0.3])
ROTATION = {"known": 1, "rough": 3, "wrong": 180, "one_sided": 3, "shared": 3, "unknown": 3}  # degrees, at most


def item(K0: np.ndarray = K, name: str = "orbit/s/0") -> Item:
    """A pair of cameras with 200 right matches, of 0.1 px of noise, and 50 wrong ones of larger ratio."""
    rng = np.random.default_rng(0)
    X = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (250, 3))
    x0, x1 = (Y[:, :2] / Y[:, 2:] + rng.normal(0, 0.1, (250, 2)) for Y in (X @ K0.T, (X @ R.T + T) @ K.T))
    x1[200:] = rng.uniform(0, 760, (50, 2))
    of = pair(name, fundamental(R, T, (K0, K)), K0=K0, K1=K, R=R, t=T)
    ratio = torch.linspace(0.3, 0.8, 250)[None]
    size, frame = torch.tensor([[760, 1000]]), torch.diag(torch.tensor([4.0, 4])).expand(1, 250, 2, 2)
    points = [torch.from_numpy(x)[None].float() for x in (x0, x1)]
    lafs0, lafs1 = (torch.cat([frame, x[..., None]], -1) for x in points)
    matches = Correspondences(
        *points, torch.ones(1, 250, dtype=torch.bool), ratio=ratio, lafs0=lafs0, lafs1=lafs1, size0=size,
        size1=size, key=torch.tensor([of.key]),
    )  # fmt: skip
    return plain_item(of, matches)


def zoomed(factor: float) -> np.ndarray:
    return K @ np.diag([factor, factor, 1])


def test_levels_tell_what_they_say() -> None:
    own = item()
    levels = ("known", "wrong", "one_sided", "shared", "unknown")
    known, wrong, one_sided, shared, unknown = (described(each, own.pair, own.matches, 0) for each in levels)
    assert known.focal[0, :, 1].tolist() == [0, 0]
    assert np.array_equal(known.K0[0], K)
    assert np.allclose(wrong.K1[0], zoomed(1.5))
    given = [k is not None for c in (one_sided, shared, unknown) for k in (c.K0, c.K1)]
    assert given == [True, False, False, False, False, False]
    assert [bool(c.shared_focal) for c in (shared, unknown)] == [True, False]
    assert np.array_equal(calibrations(unknown, np.array([3.0, 4]))[1], [[4, 0, 499.5], [0, 4, 379.5], [0, 0, 1]])
    assert applies("shared", own.pair)
    assert not applies("shared", item(zoomed(1.01)).pair)
    assert applies("unknown", item(zoomed(1.01)).pair)


def test_bougnoux_gives_the_focal_lengths_of_a_true_matrix() -> None:
    own = item(zoomed(1.3))
    unknown = described("unknown", own.pair, own.matches, 0)
    assert bougnoux(own.pair.F, unknown) == pytest.approx([1.3 * 950, 950], rel=1e-8)
    forward = fundamental(np.eye(3), np.array([0, 0, 1.0]), (K, K))  # axes that are one line determine none
    assert bougnoux(forward, unknown) == pytest.approx([1200, 1200])


@pytest.mark.parametrize(("name", "level"), [(name, level) for name, levels in TAKES.items() for level in levels])
def test_every_method_solves_an_easy_pair_at_each_level_that_it_takes(name: str, level: str) -> None:
    kind = name.partition("_")[0]
    pytest.importorskip({"poselib": "poselib", "fastpose": "fastpose", "colmap": "pycolmap"}.get(kind, "cv2"))
    ours = kind == "fmtorch"
    found = cameras.method_of(f"{name}:{level}" + ("" if ours else ":threshold=1")).figures(item(), 0)
    assert found["ok"]
    assert found["flipped"] is False
    assert ("focal_10" in found) == (level != "known")
    if ours or level not in ("rough", "wrong"):  # which peers take for exact
        assert found["rotation_error"] < ROTATION[level]
        assert found["nsgd"] < 0.01
        assert found.get("focal_10", 1.0) == 1.0 or level == "wrong"  # the usual focal length is off by a quarter


@pytest.mark.parametrize(("text", "message"), [
    ("poselib", "write NAME:LEVEL"), ("poselib:some", "with a level of known, rough"),
    ("opencv:shared", "opencv has no estimator for 'shared'"), ("peer:known", "no method 'peer'; there are fmtorch"),
])  # fmt: skip
def test_a_method_that_there_is_not_is_refused(text: str, message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        cameras.method_of(text)


def test_the_methods_of_the_page_are_methods() -> None:
    texts = read_specs(Path(cameras.__file__).with_name("cameras.txt"))
    assert len(set(texts)) == len(texts)
    assert {cameras.method_of(text).name.split(":")[1] for text in texts} == set(LEVELS)


def judged(level: str, R: np.ndarray | None, t: np.ndarray = T, focals: tuple[float, float] | None = None) -> Row:
    given = item()
    posed = {} if R is None else {"R": torch.from_numpy(R)[None], "t": torch.from_numpy(t)[None]}
    posed |= {} if focals is None else {"focals": torch.tensor([focals], dtype=torch.float64)}
    ok, mask = torch.tensor([R is not None]), given.matches.mask
    F = torch.from_numpy(given.pair.F / np.linalg.norm(given.pair.F))[None] * ok
    reason, samples = ("" if R is not None else "nothing",), torch.zeros(1, dtype=torch.int64)
    answer = Estimate(F, mask & ok, ok, reason, samples, **posed)
    view = functools.partial(cameras.viewed, level)
    return Method("x", "", lambda family: {}, lambda pair, c, seed: answer, view=view).figures(given, 0)


def test_judgement_of_a_true_a_flipped_and_no_pose() -> None:
    true = judged("unknown", R, T / np.linalg.norm(T), (950.0, 1000.0))
    assert [true[key] for key in ("rotation_error", "translation_error", "nsgd")] == pytest.approx([0, 0, 0], abs=1e-5)
    assert (true["focal_5"], true["focal_10"], true["flipped"]) == (0.5, 1.0, False)
    flipped = judged("known", R, -T / np.linalg.norm(T))
    assert flipped["flipped"] is True
    assert flipped["translation_error"] == pytest.approx(0, abs=1e-5)
    nothing = judged("shared", None)
    assert (nothing["rotation_error"], nothing["translation_error"], nothing["nsgd"]) == (180, 90, 1)
    assert nothing["focal_10"] == 0
    assert "flipped" not in nothing


CALIBRATION = np.array([[700.0, 0, 310], [0, 701, 250], [0, 0, 1]])
AREAS = [f"{name}{limit}" for name in ("auc", "centre") for limit in (1, 5, 10)]


def walk_scene(count: int = 5) -> tuple[Scene, dict[str, Any]]:
    """Cameras, and their poses in a frame that is turned, moved and twice as large."""
    cameras = databases.scene(count)
    names = [f"{i:03d}.jpg" for i in range(count)]
    true = {name: verify.Camera(CALIBRATION, *pose) for name, *pose in zip(names, cameras.R, cameras.t, strict=True)}
    turn = databases.scene(2).R[1]
    poses = {}
    for name, camera in true.items():
        centre, rotation = 2 * turn @ (-camera.R.T @ camera.t) + [1.0, 2, 3], camera.R @ turn.T
        poses[name] = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
    return Scene("walk", Path(), true), poses


def test_true_poses_have_no_error_in_any_frame_and_an_image_without_a_pose_counts_as_wrong() -> None:
    """Without one, four of the ten pairs, and one of the five centres."""
    walk, poses = walk_scene()
    figures = accuracy(poses, walk)
    assert set(figures) == set(AREAS)
    assert min(figures.values()) > 99.99
    assert centre_errors(poses, walk).max() < 1e-6
    del poses["002.jpg"]
    figures = accuracy(poses, walk)
    assert figures["auc10"] == pytest.approx(60, abs=0.01)
    assert figures["centre10"] == pytest.approx(80, abs=0.01)
    assert accuracy({}, walk)["centre10"] == 0


def test_known_cameras_are_the_true_ones(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    databases.write(path, databases.scene(5), prior=False)
    calibrate(path, walk_scene()[0])
    with pycolmap.Database.open(path) as database:
        (camera,) = database.read_all_cameras()
    assert (camera.model_name, camera.has_prior_focal_length) == ("PINHOLE", True)
    assert camera.params.tolist() == [700, 701, 310.5, 250.5]


def test_an_interrupted_run_measures_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    databases.write(tmp_path / "walk.db", databases.scene(3))
    mapped: list[str] = []

    def interrupted(mapper: str, *_: Any) -> dict[str, Any]:
        mapped.append(mapper)
        if len(mapped) == 2:
            raise KeyboardInterrupt
        return {"seconds": 1.0, "registered": 3, "registered, %": 100.0, **dict.fromkeys(AREAS, 50.0)}

    monkeypatch.setattr(verify, "mapped", interrupted)
    key = ("walk", "colmap", "known", "ours", 0)
    walk = walk_scene(3)[0]
    for _ in range(2):
        kept = Kept(tmp_path / "rows.jsonl")
        try:
            verify.measure(walk, tmp_path / "walk.db", key, ["incremental", "global"], kept)
        except KeyboardInterrupt:
            assert [row["mapper"] for row in kept.rows] == ["", "incremental"]
    assert mapped == ["incremental", "global", "global"]
    assert [row["mapper"] for row in kept.rows] == ["", "incremental", "global"]
    assert (kept.rows[0]["pairs"], kept.rows[0]["verified"], kept.rows[0]["poses"]) == (3, 3, 3)
    assert [path.name for path in tmp_path.glob("*.db*")] == ["walk.db"]
    means, pairs, models = ([list(line.values()) for line in sheet.records] for sheet in sheets(kept.rows))
    assert means[0][:4] == ["colmap", "known", "ours", 1]
    assert means[0][5:9] == ["100.0", "50.0", "50.0", "50.0"]
    assert pairs[0][3:7] == ["walk", 1, "3", "3"]
    assert [line[3:7] for line in models] == [[m, "walk", 1, "3.0"] for m in ("incremental", "global")]


SET, THRESHOLD = "imc_london_bridge", 0.75
SAMPLES = 4
PROTOCOL = {"max_epipolar_error": THRESHOLD, "max_iterations": 1000, "min_iterations": 100, "success_prob": 0.9999}
COLMAP = {"max_error": THRESHOLD, "max_num_trials": 1000, "min_num_trials": 100, "confidence": 0.9999, "random_seed": 0}


@functools.cache
def real() -> list[tuple[ImagePair, Correspondences]]:
    dataset = data.load("fmbench", root=shared_path("data/PhotoTourism"))
    outcomes = pipeline_of("sift_ratio").correspondences([dataset[i] for i in range(SAMPLES)])
    return [(o.pair, o.correspondences) for o in outcomes if o.correspondences is not None]


def matched(c: Correspondences) -> tuple[np.ndarray, np.ndarray]:
    x0, x1 = (np.ascontiguousarray(x[0][c.mask[0]].double().numpy()) for x in (c.x0, c.x1))
    return x0, x1


def sample(folder: Path, name: str = SET) -> Path:
    """The real pairs as one of PoseBench's files, the last of them with three matches."""
    folder.mkdir(parents=True)
    with h5py.File(folder / f"{name}.h5", "w") as file:
        for i, (pair, c) in enumerate(real()):
            x = matched(c) if i < SAMPLES - 1 else tuple(v[:3] for v in matched(c))
            sizes = [tuple(int(v) for v in s[0]) for s in (c.size0, c.size1)]
            posebench_group(file, f"{i:03d}", x, (pair.K0, pair.K1), (pair.R, pair.t), tuple(sizes))
    return folder


def direct(method: str) -> list[float]:
    """The larger angle of each pair: the libraries called as PoseBench calls them, judged by its definitions."""
    errors = []
    for true, c in real()[:-1]:
        known = []
        for K, ((height, width),) in ((true.K0, c.size0.tolist()), (true.K1, c.size1.tolist())):
            params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
            known.append({"model": "PINHOLE", "width": width, "height": height, "params": params})
        F, R, t = called(method, matched(c), known)
        poses = [(R, t)] if F is None else solvers.poses(true.K1.T @ F @ true.K0)
        errors.append(max(metrics.closest_pose_error(poses, true.R, true.t)))
    return [*errors, 180.0]  # three matches


def called(method: str, x: Any, cameras: Any) -> Any:
    peer = pytest.importorskip({"poselib": "poselib", "colmap": "pycolmap"}[method.partition(":")[2]])
    if method == "E:poselib":
        pose, _ = peer.estimate_relative_pose(*x, *cameras, {**PROTOCOL, "seed": 0}, {})
        return None, np.asarray(pose.R), np.asarray(pose.t)
    if method == "F:poselib":
        return np.asarray(peer.estimate_fundamental(*x, {**PROTOCOL, "seed": 0}, {})[0]), None, None
    own = peer.RANSACOptions(**COLMAP)
    if method == "F:colmap":
        return peer.estimate_fundamental_matrix(*x, own)["F"], None, None
    pose = peer.estimate_essential_matrix(*x, *map(peer.Camera, cameras), own)["cam2_from_cam1"]
    return None, pose.rotation.matrix(), pose.translation


@pytest.mark.parametrize("method", ["E:poselib", "F:poselib", "E:colmap", "F:colmap"])
def test_peers_have_the_figures_of_posebenchs_own_protocol(method, tmp_path, capsys, monkeypatch):
    expected = direct(method)
    rows = tmp_path / "rows.jsonl"
    folder = sample(tmp_path / "relative")
    printed = run(capsys, monkeypatch, "posebench", folder, "--methods", method, "--rows", rows)
    errors = [max(each["rotation_error"], each["translation_error"]) for each in read(rows)]
    # arccos at a cosine near 1 is exact to the root of its rounding; pixels with a central principal point, to 1e-7
    assert errors == pytest.approx(expected, abs=1e-3)
    areas = [100 * area for area in metrics.pose_auc(expected, (5.0, 10.0, 20.0))]
    results = Results(read(rows))
    assert list(cameras.areas(results, method, results.all_pairs).values()) == pytest.approx(areas, abs=0.02)
    published = {"E:poselib": "56.6", "F:colmap": "33.0"}  # of the whole set
    assert published.get(method, "") in printed
    assert [each["reason"] != "" for each in read(rows)] == [False] * (SAMPLES - 1) + [True]


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
    assert SAMPLES * len(methods) >= len(posed) >= (SAMPLES - 1) * len(methods) - 1
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
            cameras.protocol(wrong, 1.0)


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
    assert f" {SAMPLES - 1} pairs" in run(capsys, monkeypatch, "posebench", own, "--threshold", 1, *lmeds)
    with pytest.raises(SystemExit, match="--root: give the threshold in pixels"):
        run(capsys, monkeypatch, "posebench", "--root", shared_path("data/PhotoTourism"))
