"""COLMAP's mappers on a verified database, and the errors of the models that they build."""

from __future__ import annotations

import itertools
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.metrics import pose_auc, pose_error
from scripts.benchmark.verify_scenes import Scene, Truth

THRESHOLDS = (1, 5, 10)  # degrees; of camera centres per cent of the scene's size
RIGHT, WRONG = 5, 10  # degrees, of the pose of a pair
MIN_MODEL = 3  # images
MAPPERS = ("incremental", "global")

Array = NDArray[np.float64]


def mapped(mapper: str, path: Path, scene: Scene, cameras: str, seed: int) -> dict[str, Any]:
    """The largest model of a mapper on one thread, with its processor seconds.

    Known intrinsics are held fixed. Unknown ones are calibrated from the view graph before the global mapper, as
    COLMAP asks for; that changes the database, so it works on a copy.
    """
    import pycolmap

    output = path.with_suffix(f".{mapper}")
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir()
    copy = output / "database.db"
    shutil.copy(path, copy)
    start = time.process_time()
    if mapper == "global":
        if cameras == "unknown":
            pycolmap.calibrate_view_graph(copy, pycolmap.ViewGraphCalibrationOptions(random_seed=seed))
        models = pycolmap.global_mapping(copy, scene.images, output, _global(cameras, seed))
    else:
        models = pycolmap.incremental_mapping(copy, scene.images, output, _incremental(cameras, seed))
    row: dict[str, Any] = {"seconds": time.process_time() - start, "registered": 0, "images": len(scene.truth.R)}
    if models:
        model = max(models.values(), key=lambda each: each.num_reg_images())
        row |= {
            "registered": model.num_reg_images(), "points": model.num_points3D(),
            "track": model.compute_mean_track_length(), "error": model.compute_mean_reprojection_error(),
        }  # fmt: skip
        row |= accuracy(
            {image.name: image.cam_from_world() for image in model.images.values() if image.has_pose}, scene
        )
    else:
        row |= accuracy({}, scene)
    shutil.rmtree(output)
    return row


def _incremental(cameras: str, seed: int) -> Any:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(
        min_model_size=MIN_MODEL, num_threads=1, random_seed=seed, extract_colors=False
    )
    if cameras == "known":
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    return options


def _global(cameras: str, seed: int) -> Any:
    import pycolmap

    options = pycolmap.GlobalPipelineOptions(min_model_size=MIN_MODEL, num_threads=1, random_seed=seed)
    options.mapper.num_threads, options.mapper.random_seed = 1, seed
    options.mapper.global_positioning.random_seed = options.mapper.rotation_averaging.random_seed = seed
    if cameras == "known":
        adjustment = options.mapper.bundle_adjustment
        adjustment.refine_focal_length = adjustment.refine_extra_params = False
    return options


def accuracy(poses: dict[str, Any], scene: Scene) -> dict[str, float]:
    """AUC, per cent, of the errors of all relative poses and of all camera centres; no pose is a wrong one."""
    truth = scene.truth
    errors = [
        relative_error(poses[b] * poses[a].inverse(), truth, a, b) if a in poses and b in poses else 180.0
        for a, b in itertools.combinations(sorted(truth.R), 2)
    ]
    return _areas("auc", np.array(errors)) | _areas("centre", centre_errors(poses, truth))


def _areas(name: str, errors: Array) -> dict[str, float]:
    areas = pose_auc(torch.from_numpy(errors), THRESHOLDS).tolist()
    return {f"{name}{limit}": 100 * area for limit, area in zip(THRESHOLDS, areas, strict=True)}


def relative_error(relative: Any, truth: Truth, a: str, b: str) -> float:
    """The larger of the errors of rotation and direction of translation, in degrees."""
    R = truth.R[b] @ truth.R[a].T
    t = truth.t[b] - R @ truth.t[a]
    given = [torch.tensor(np.array(value)) for value in (relative.rotation.matrix(), relative.translation, R, t)]
    return float(max(pose_error(*given, up_to_sign=False)))


def centre_errors(poses: dict[str, Any], truth: Truth) -> Array:
    """Distances from the true centres after the best similarity (Umeyama 1991), per cent of the centres' RMS spread."""
    names = sorted(truth.R)
    true = np.array([-truth.R[name].T @ truth.t[name] for name in names])
    size, errors = np.sqrt(((true - true.mean(0)) ** 2).sum(1).mean()), np.full(len(names), np.inf)
    here = [i for i, name in enumerate(names) if name in poses]
    if len(here) < MIN_MODEL:
        return errors
    centres = np.array([poses[names[i]].inverse().translation for i in here])
    P, Q = centres - centres.mean(0), true[here] - true[here].mean(0)
    U, D, Vt = np.linalg.svd(Q.T @ P)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    scale = (D * signs).sum() / (P**2).sum()
    errors[here] = np.linalg.norm(scale * P @ (U * signs @ Vt).T - Q, axis=1) / size * 100
    return errors


def pair_poses(path: Path, truth: Truth) -> dict[str, int]:
    """How many pairs have a relative pose, and how many of them are right within 5 degrees, or off by more than 10."""
    import pycolmap

    with pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        ends = [pycolmap.pair_id_to_image_pair(pair) for pair in database.read_two_view_geometries()[0]]
        poses = [database.read_two_view_geometry(*pair).cam2_from_cam1 for pair in ends]
    errors = np.array([
        relative_error(pose, truth, names[pair[0]], names[pair[1]])
        for pose, pair in zip(poses, ends, strict=True) if pose is not None
    ])  # fmt: skip
    return {"poses": len(errors), "right": int((errors < RIGHT).sum()), "wrong": int((errors > WRONG).sum())}
