"""COLMAP databases verified by COLMAP and by ours, and what COLMAP's mappers make of either.

Features and matches are those of COLMAP's SIFT, or of our default pipeline, made once for each scene in --work. Every
method begins with the same database without geometries, on one thread, reading and writing included: `colmap:PX` is
`pycolmap.geometric_verification` at that threshold, `ours` is `fmtorch.verify`. Known cameras are the true ones. Images
that a mapper does not register count as wrong. Rows are kept in --work: an interrupted run goes on where it stopped.
"""

import argparse
import functools
import itertools
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

import fmtorch
from fmtorch.data import Lens, undistorted_points
from fmtorch.data.pairs import Camera, relative_pose
from fmtorch.io.colmap import imported, remove_database
from fmtorch.metrics import pose_auc, pose_error
from scripts.benchmark.runner import Kept, Row, add_command
from scripts.benchmark.tables import Record, Sheet, grouped, show

FEATURES = 4096
ORIGIN = 0.5  # px: COLMAP's coordinates of the first pixel's centre
FEATURE_KINDS = ("colmap", "ours")  # COLMAP's SIFT; our default pipeline
CAMERA_KINDS = ("unknown", "known")
KNOWN_MODELS = "COLMAP models, for dataset=colmap, of scenes with known cameras in FM-Bench's layout, by SIFT."
SCENES = (
    "Strecha/Herz-Jesus-P8", "PhotoTourism/sacre_coeur", "Strecha/fountain-P11", "Strecha_train/castle-P19",
    "TanksLike/fox",
)  # fmt: skip
METHODS = ("colmap:4", "colmap:1", "colmap:0.5", "ours")
MAPPERS = ("incremental", "global")
FIELDS = ("scene", "features", "cameras", "method", "seed", "mapper")  # what a row is of; no mapper: verification
THRESHOLDS = (1, 5, 10)  # degrees; of camera centres per cent of the scene's size
RIGHT, WRONG = 5, 10  # degrees, of the pose of a pair
MIN_MODEL = 3  # images
Array = NDArray[np.float64]


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "verify", run, __doc__)
    parser.add_argument("--root", type=Path, required=True, help="a folder of data sets in FM-Bench's layout")
    parser.add_argument("--scenes", nargs="+", default=SCENES, help="folders below it")
    parser.add_argument("--work", type=Path, required=True, help="a folder for databases and rows")
    parser.add_argument("--methods", nargs="+", default=METHODS, help="colmap:PX, or ours")
    parser.add_argument("--features", nargs="+", default=FEATURE_KINDS, choices=FEATURE_KINDS)
    parser.add_argument("--mappers", nargs="*", default=MAPPERS, choices=MAPPERS)
    parser.add_argument("--seeds", type=int, default=3)
    parser = add_command(commands, "known_models", run_known_models, KNOWN_MODELS)
    parser.add_argument("--root", type=Path, nargs="+", required=True, help="folders of scenes in FM-Bench's layout")
    parser.add_argument("--folder", type=Path, default=Path("models"), help="of the models; those there are kept")
    parser.add_argument("--lens", nargs="+", help="bends photographs: a model of fx, fy, cx, cy, ..., its coefficients")


class Scene(NamedTuple):
    """A folder of photographs with the true camera of each by name.
    single: whether one camera took them all."""

    name: str
    images: Path
    cameras: dict[str, Camera]
    single: bool = True


def read_scene(folder: Path) -> Scene:
    """FM-Bench's layout: `Images`, and `Camera.txt` with K, R and t of each image in a line.
    Raises SystemExit where one of them is missing."""
    if not (folder / "Images").is_dir() or not (folder / "Camera.txt").is_file():
        raise SystemExit(f"{folder} holds no Images and Camera.txt; give scenes in FM-Bench's layout")
    lines = np.loadtxt(folder / "Camera.txt").reshape(-1, 21)
    named = dict(zip(sorted(path.name for path in (folder / "Images").iterdir()), lines, strict=True))
    cameras = {name: Camera(row[:9].reshape(3, 3), row[9:18].reshape(3, 3), row[18:]) for name, row in named.items()}
    return Scene(folder.name, folder / "Images", cameras, bool((lines[:, :9] == lines[0, :9]).all()))


def run(arguments: argparse.Namespace) -> None:
    arguments.work.mkdir(parents=True, exist_ok=True)
    kept = Kept(arguments.work / "rows.jsonl")
    for name in arguments.scenes:
        scene = read_scene(arguments.root / name)
        kinds = itertools.product(arguments.features, CAMERA_KINDS)
        for features, cameras in ((f, c) for f, c in kinds if f == "colmap" or c == "unknown"):  # ours are shown once
            database = database_of(scene, features, cameras, arguments.work)
            for seed, method in itertools.product(range(arguments.seeds), arguments.methods):
                measure(scene, database, (scene.name, features, cameras, method, seed), arguments.mappers, kept)
    show(sheets(kept.rows), arguments.table)


def measure(scene: Scene, database: Path, key: tuple[Any, ...], mappers: Sequence[str], kept: Kept) -> None:
    """One verification, and what the mappers make of it, as far as there are no rows yet."""
    done = kept.by(*FIELDS)
    missing = [mapper for mapper in ("", *mappers) if (*key, mapper) not in done]
    if not missing:
        return
    _, _, cameras, method, seed = key
    path = database.with_name(f"{database.stem}-{method.replace(':', '-')}-{seed}.db")
    remove_database(path)
    shutil.copy(database, path)
    if method == "ours":
        warm_up(database)
    verified = verified_by(method, path, seed)
    for mapper in missing:
        figures = mapped(mapper, path, scene, cameras, seed) if mapper else verified | pair_poses(path, scene)
        kept.add([dict(zip(FIELDS, (*key, mapper), strict=True)) | figures])
    remove_database(path)


@functools.cache
def warm_up(database: Path) -> None:
    """Verify a database once and drop the result: what a process loads and compiles is no part of a pair's time."""
    copy = database.with_suffix(".warm")
    fmtorch.verify(database, output=copy, force=True)
    remove_database(copy)


def verified_by(method: str, path: Path, seed: int) -> Row:
    """Verify a database in place: pairs, those with a geometry, and processor seconds."""
    pycolmap = imported()
    kind, _, threshold = method.partition(":")
    start = time.process_time()
    if kind == "ours":
        fmtorch.verify(path, seed=seed)
    else:
        options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
        options.ransac.max_error, options.ransac.random_seed = float(threshold), seed
        one = pycolmap.GeometricVerifierOptions(num_threads=1)
        pycolmap.geometric_verification(path, verifier_options=one, two_view_geometry_options=options)
    seconds = time.process_time() - start
    with pycolmap.Database.open(path) as database:
        pairs, verified = len(database.read_num_matches()[0]), len(database.read_two_view_geometry_num_inliers()[0])
    speed = {"ms a pair": 1e3 * seconds / pairs, "pairs a second": pairs / seconds}
    return {"pairs": pairs, "verified": verified, "seconds": seconds, **speed}


def mapped(mapper: str, path: Path, scene: Scene, cameras: str, seed: int) -> Row:
    """The largest model of a mapper on one thread, with its processor seconds.
    Known intrinsics are held fixed. Unknown ones are calibrated from the view graph before the global mapper, as COLMAP
    asks for; that changes the database, so it works on a copy."""
    pycolmap = imported()
    poses: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(dir=path.parent) as output:
        copy = shutil.copy(path, output)
        start = time.process_time()
        if (mapper, cameras) == ("global", "unknown"):
            pycolmap.calibrate_view_graph(copy, pycolmap.ViewGraphCalibrationOptions(random_seed=seed))
        mapping = pycolmap.global_mapping if mapper == "global" else pycolmap.incremental_mapping
        models = mapping(copy, scene.images, output, _options(mapper, cameras == "unknown", seed))
    row: Row = {"seconds": time.process_time() - start, "registered": 0}
    if models:
        model = max(models.values(), key=lambda each: each.num_reg_images())
        row |= {
            "registered": model.num_reg_images(), "points": model.num_points3D(),
            "track": model.compute_mean_track_length(), "error": model.compute_mean_reprojection_error(),
        }  # fmt: skip
        poses = {image.name: image.cam_from_world() for image in model.images.values() if image.has_pose}
    row["registered, %"] = 100 * row["registered"] / len(scene.cameras)
    return row | accuracy(poses, scene)


def _options(mapper: str, refined: bool, seed: int) -> Any:
    pycolmap = imported()
    own: dict[str, Any] = {"min_model_size": MIN_MODEL, "num_threads": 1, "random_seed": seed}
    if mapper == "global":
        options: Any = pycolmap.GlobalPipelineOptions()
        steps: dict[str, Any] = {step: {"random_seed": seed} for step in ("global_positioning", "rotation_averaging")}
        steps["bundle_adjustment"] = {"refine_focal_length": refined, "refine_extra_params": refined}
        own["mapper"] = {"num_threads": 1, "random_seed": seed, **steps}
    else:
        options = pycolmap.IncrementalPipelineOptions()
        own |= {"extract_colors": False, "ba_refine_focal_length": refined, "ba_refine_extra_params": refined}
        own["mapper"] = {"abs_pose_refine_focal_length": refined, "abs_pose_refine_extra_params": refined}
    options.mergedict(own)
    return options


def accuracy(poses: dict[str, Any], scene: Scene) -> dict[str, float]:
    """AUC, per cent, of the errors of all relative poses and of all camera centres; no pose is a wrong one."""
    errors = [
        relative_error(poses[b] * poses[a].inverse(), scene, a, b) if a in poses and b in poses else 180.0
        for a, b in itertools.combinations(sorted(scene.cameras), 2)
    ]
    figures: dict[str, float] = {}
    for name, values in (("auc", np.array(errors)), ("centre", centre_errors(poses, scene))):
        areas = pose_auc(torch.from_numpy(values), THRESHOLDS).tolist()
        figures |= {f"{name}{limit}": 100 * area for limit, area in zip(THRESHOLDS, areas, strict=True)}
    return figures


def relative_error(relative: Any, scene: Scene, a: str, b: str) -> float:
    """The larger of the errors of rotation and direction of translation, in degrees."""
    true = relative_pose(scene.cameras[a], scene.cameras[b])
    given = [torch.tensor(np.array(value)) for value in (relative.rotation.matrix(), relative.translation, *true)]
    return float(max(pose_error(*given, up_to_sign=False)))


def centre_errors(poses: dict[str, Any], scene: Scene) -> Array:
    """Distances from the true centres after the best similarity (Umeyama 1991), per cent of the centres' RMS spread."""
    true = {name: -camera.R.T @ camera.t for name, camera in sorted(scene.cameras.items())}
    size = np.sqrt(np.var(list(true.values()), 0).sum())
    errors = dict.fromkeys(true, np.inf)
    if len(poses) >= MIN_MODEL:
        there = np.array([true[name] for name in poses])
        centres = np.array([pose.inverse().translation for pose in poses.values()])
        moved = np.c_[centres, np.ones(len(poses))] @ imported().estimate_sim3d(centres, there).matrix().T
        errors |= dict(zip(poses, np.linalg.norm(moved - there, axis=1) / size * 100, strict=True))
    return np.array(list(errors.values()))


def pair_poses(path: Path, scene: Scene) -> dict[str, int]:
    """How many pairs have a relative pose, and how many of them are right within 5 degrees, or off by more than 10."""
    pycolmap = imported()
    with pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        ends = [pycolmap.pair_id_to_image_pair(pair) for pair in database.read_two_view_geometries()[0]]
        poses = [database.read_two_view_geometry(*pair).cam2_from_cam1 for pair in ends]
    posed = [(pose, names[a], names[b]) for pose, (a, b) in zip(poses, ends, strict=True) if pose is not None]
    errors = np.array([relative_error(pose, scene, a, b) for pose, a, b in posed])
    return {"poses": len(errors), "right": int((errors < RIGHT).sum()), "wrong": int((errors > WRONG).sum())}


VERIFICATION = {"pairs": 0, "verified": 0, "ms a pair": 1, "pairs a second": 0, "poses": 0, "right": 0, "wrong": 0}
MODEL = {"registered": 1, "points": 0, "track": 2, "error": 2}
MODEL |= {f"{name}{limit}": 1 for name in ("auc", "centre") for limit in THRESHOLDS} | {"seconds": 1}
"""Columns, which are fields of the rows, and their digits; error: px."""


def sheets(rows: Sequence[Row]) -> list[Sheet]:
    """Means of the scenes; pairs and models of each scene and method, means of the seeds."""
    each: dict[str, list[Record]] = {"means": [], "pairs": [], "models": []}
    for place, placed in grouped(rows, "features", "cameras", "method").items():
        about: Record = dict(zip(("features", "intrinsics", "verified by"), place, strict=True))
        of_scenes: dict[str, list[Row]] = {mapper: [] for mapper in ("", *MAPPERS)}  # means of the seeds
        for (mapper, scene), own in grouped(placed, "mapper", "scene").items():
            digits = MODEL if mapper else VERIFICATION
            means = {name: _mean(own, name) for name in own[0].keys() | MODEL.keys() if name not in FIELDS}
            of_scenes[mapper].append(means)
            line: Record = {**about, **({"mapper": mapper} if mapper else {}), "scene": scene, "seeds": len(own)}
            line |= {name: _text(means[name], of) for name, of in digits.items()}
            each["models" if mapper else "pairs"].append(line)
        scenes = of_scenes[""]
        speed = sum(of["pairs"] for of in scenes) / max(sum(of["seconds"] for of in scenes), 1e-9)
        about |= {"scenes": len(scenes), "pairs a second": f"{speed:.0f}"}
        for mapper, field in itertools.product(MAPPERS, ("registered, %", *(f"auc{n}" for n in THRESHOLDS))):
            about[f"{mapper}: {field}"] = _text(_mean(of_scenes[mapper], field), 1)
        each["means"].append(about)
    return [Sheet(name, f"Verified databases: {name}", records) for name, records in each.items()]


def _mean(rows: Sequence[Row], name: str) -> float:
    values = [row[name] for row in rows if name in row]
    return float(np.mean(values)) if values else float("nan")


def _text(value: float, digits: int) -> str:
    return "" if np.isnan(value) else f"{value:.{digits}f}"


def database_of(scene: Scene, features: str, cameras: str, work: Path) -> Path:
    """The database of all pairs' matches without geometries, made at most once in `work`.
    cameras: "unknown", COLMAP's guess of a SIMPLE_RADIAL, or "known", the true PINHOLE with a prior focal length."""
    path = work / f"{scene.name}-{features}-{cameras}.db"
    if path.exists():
        return path
    begun = path.with_suffix(".begun")
    begun.unlink(missing_ok=True)
    if cameras == "known":
        shutil.copy(database_of(scene, features, "unknown", work), begun)
        calibrate(begun, scene)
    elif features == "colmap":
        match(scene, begun, verified=False)
    else:
        _match_by_ours(scene, begun, work)
    return begun.rename(path)


def match(scene: Scene, path: Path, verified: bool) -> None:
    """COLMAP's SIFT of a scene and its matches of all pairs, in a new database; verified: by the true cameras."""
    pycolmap = imported()
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1)
    extraction.sift.max_num_features = FEATURES
    mode = pycolmap.CameraMode.SINGLE if scene.single else pycolmap.CameraMode.PER_IMAGE
    cpu = pycolmap.Device.cpu
    pycolmap.extract_features(path, scene.images, camera_mode=mode, extraction_options=extraction, device=cpu)
    if verified:
        calibrate(path, scene)
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, skip_geometric_verification=not verified)
    pycolmap.match_exhaustive(path, matching_options=matching, device=cpu)


def _match_by_ours(scene: Scene, path: Path, work: Path) -> None:
    """`fmtorch match images=`, of which the geometries are removed again."""
    output, camera = work / f"{scene.name}-match", "shared" if scene.single else "per_image"
    words = [f"images={scene.images}", "export=colmap", f"camera={camera}", f"output={output}"]
    if subprocess.run([sys.executable, "-m", "fmtorch", "match", *words], check=False).returncode:
        raise SystemExit(f"{scene.images} could not be matched; see above")
    shutil.copy(output / "database.db", path)
    with imported().Database.open(path) as database:
        database.clear_two_view_geometries()


def calibrate(path: Path, scene: Scene) -> None:
    pycolmap = imported()
    with pycolmap.Database.open(path) as database:
        for image in database.read_all_images():
            K, camera = scene.cameras[image.name].K, database.read_camera(image.camera_id)
            params: list[Any] = [K[0, 0], K[1, 1], K[0, 2] + ORIGIN, K[1, 2] + ORIGIN]
            known = pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=params)
            known.camera_id, known.has_prior_focal_length = image.camera_id, True
            database.update_camera(known)


def run_known_models(arguments: argparse.Namespace) -> None:
    pycolmap = imported()
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0, extract_colors=False)
    for path in (file.parent for root in arguments.root for file in sorted(root.glob("*/Camera.txt"))):
        target, scene = arguments.folder / path.name, read_scene(path)
        if target.is_dir():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as temporary:
            folder, database = Path(temporary) / "scene", Path(temporary) / "database.db"
            match(scene, database, verified=True)
            given = posed(scene, database)
            model = pycolmap.triangulate_points(given, database, scene.images, Path(temporary), options=options)
            (folder / "sparse").mkdir(parents=True)
            shutil.copytree(scene.images, folder / "images")
            if arguments.lens:
                bend(model, folder / "images", arguments.lens[0], *map(float, arguments.lens[1:]))
            model.write_text(folder / "sparse")
            folder.rename(target)
        seen = model.compute_mean_observations_per_reg_image()
        print(f"{target}: {model.num_points3D()} points, {seen:.0f} seen in an image")


def bend(model: Any, images: Path, kind: str, *coefficients: float) -> None:
    """Photographs as cameras of this model and these coefficients take them, and such cameras for pinholes."""
    for camera in model.cameras.values():
        camera.model, camera.params = kind, [*camera.params, *coefficients]
    for image in model.images.values():
        fx, fy, cx, cy = image.camera.params[:4]
        lens, path = Lens(fx, fy, cx - ORIGIN, cy - ORIGIN, kind, coefficients), str(images / image.name)
        pixels: Any = cv2.imread(path)
        grid = np.stack(np.meshgrid(*(np.arange(float(n)) for n in pixels.shape[1::-1])), -1)
        x, y = undistorted_points(lens, grid.reshape(-1, 2)).T.reshape(2, *grid.shape[:2]).astype(np.float32)
        cv2.imwrite(path, cv2.remap(pixels, x, y, cv2.INTER_CUBIC))


def posed(scene: Scene, database: Path) -> Any:
    """A reconstruction of the true cameras, with the numbers that images have in a database, and without points."""
    pycolmap = imported()
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            if image.camera_id not in model.cameras:
                model.add_camera_with_trivial_rig(opened.read_camera(image.camera_id))
            camera = scene.cameras[image.name]
            given = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(given, pycolmap.Rigid3d(pycolmap.Rotation3d(camera.R), camera.t))
    return model
