"""Matches of synthetic scenes in the layouts of others, written from their published descriptions.

hloc: hloc/extract_features.py, match_features.py. RANSAC tutorial: parse_EF_data.ipynb. PoseBench: relative_pose.py.
OANet: dump_match/datasets.py and core/data.py. glue-factory: utils/export_predictions.py. vismatch: base_matcher.py."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import torch

from tests.geometry.scenes import Scene, scene

PAIRS, N = 3, 60
SIZE = (800, 1000)  # (h, w)


def scenes() -> list[Scene]:
    return [scene(N + 5 * i, i, noise=0.3) for i in range(PAIRS)]


def ratios(count: int) -> np.ndarray:
    return np.linspace(0.3, 0.9, count).astype(np.float32)


def truth(folder: Path) -> Path:
    """The scenes as an `fmbench` set: a subset for each pair, with cameras and blank images."""
    lines, subsets = [], []
    for i, s in enumerate(scenes()):
        images = folder / f"s{i}" / "Images"
        images.mkdir(parents=True)
        for name in ("00000000.png", "00000001.png"):
            cv2.imwrite(str(images / name), np.zeros(SIZE, np.uint8))
        motions = (s.K0, torch.eye(3), torch.zeros(3)), (s.K1, s.R, s.t)
        cameras = [np.concatenate([np.ravel(value) for value in motion]) for motion in motions]
        np.savetxt(folder / f"s{i}" / "Camera.txt", cameras, fmt="%.17g")
        lines.append("0 1 " + " ".join(f"{v:.17g}" for v in s.F.numpy().ravel()))
        subsets.append(f"s{i}/")
    (folder / "pairs_with_gt.txt").write_text("\n".join(lines) + "\n")
    (folder / "pairs_which_dataset.txt").write_text("\n".join(subsets) + "\n")
    return folder


def keypoints(s: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The matched points among others that found no partner, and matches0: the second image's are reversed."""
    lonely = np.array([[5.0, 7.0], [900.0, 3.0]])
    x0 = np.concatenate([lonely, s.x0.numpy()])
    x1 = s.x1.numpy()[::-1]
    matches = np.concatenate([[-1, -1], np.arange(len(s.x1))[::-1]])
    return x0.astype(np.float32), np.ascontiguousarray(x1, np.float32), matches.astype(np.int32)


def write_hloc(folder: Path, swapped: bool = False) -> Path:
    """feats.h5 with a group an image, matches.h5 with a group a pair, slashes within names as hyphens."""
    folder.mkdir(parents=True)
    with h5py.File(folder / "feats-sift.h5", "w") as f, h5py.File(folder / "feats-sift_matches-NN.h5", "w") as m:
        for i, s in enumerate(scenes()):
            x0, x1, matches = keypoints(s)
            for k, x in enumerate((x0, x1)):
                group = f.create_group(f"s{i}/Images/{k:08d}.png")
                group["keypoints"] = x
                group["image_size"] = np.array(SIZE[::-1])
                group["descriptors"] = np.zeros((128, len(x)), np.float16)
            names = [f"s{i}-Images-{k:08d}.png" for k in (0, 1)]
            if swapped:
                back = np.full(len(x1), -1)
                back[matches[matches >= 0]] = np.flatnonzero(matches >= 0)
                matches, names = back.astype(np.int32), names[::-1]
            group = m.create_group("/".join(names))
            group["matches0"] = matches
            group["matching_scores0"] = np.where(matches >= 0, 0.75, 0).astype(np.float16)
    return folder


def write_glue_factory(folder: Path) -> Path:
    """predictions.h5 with a group a pair; the first pixel's centre is at (0.5, 0.5)."""
    folder.mkdir(parents=True)
    with h5py.File(folder / "predictions.h5", "w") as file:
        for i, s in enumerate(scenes()):
            x0, x1, matches = keypoints(s)
            group = file.create_group(f"s{i}-Images-00000000.png/s{i}-Images-00000001.png")
            group["keypoints0"], group["keypoints1"] = x0 + np.float32(0.5), x1 + np.float32(0.5)
            group["matches0"] = matches.astype(np.int64)
            group["matching_scores0"] = np.where(matches >= 0, 0.75, 0).astype(np.float32)
    return folder


def write_vismatch(folder: Path) -> Path:
    """The dictionaries that its matchers return, a group a pair."""
    folder.mkdir(parents=True)
    with h5py.File(folder / "vismatch.h5", "w") as file:
        for i, s in enumerate(scenes()):
            group = file.create_group(f"s{i}-Images-00000000_s{i}-Images-00000001")
            group["matched_kpts0"], group["matched_kpts1"] = s.x0.numpy(), s.x1.numpy()
            group["all_kpts0"] = keypoints(s)[0]
            group["matched_confidences"] = np.full(len(s.x0), 0.75)
            group["H"], group["num_inliers"] = np.eye(3), 7
    return folder


def write_tutorial(folder: Path) -> Path:
    """A scene's folder with one file for each kind of entry; world to camera, T as a column, K1_K2 of one more axis."""
    scene_folder = folder / "church"
    scene_folder.mkdir(parents=True)
    files = {name: h5py.File(scene_folder / f"{name}.h5", "w") for name in
             ("matches", "match_conf", "K1_K2", "R", "T", "Fgt")}  # fmt: skip
    turn = scene(9, 99).R.numpy()  # the first camera is not at the origin
    for i, s in enumerate(scenes()):
        names = f"img_{i}a", f"img_{i}b-1"
        key = "-".join(names)
        files["matches"][key] = np.concatenate([s.x0.numpy(), s.x1.numpy()], 1)
        files["match_conf"][key] = ratios(len(s.x0))
        files["K1_K2"][key] = np.stack([s.K0.numpy(), s.K1.numpy()])[None]
        shift = np.array([1.0, 2.0, 3.0])
        files["R"][names[0]], files["T"][names[0]] = turn, shift[:, None]
        files["R"][names[1]] = s.R.numpy() @ turn
        files["T"][names[1]] = (s.R.numpy() @ shift + s.t.numpy())[:, None]
        files["Fgt"][key] = s.F.numpy()
    for file in files.values():
        file.close()
    return folder


def write_posebench(folder: Path) -> Path:
    folder.mkdir(parents=True)
    with h5py.File(folder / "imc_church.h5", "w") as file:
        for i, s in enumerate(scenes()):
            K, x = (s.K0.numpy(), s.K1.numpy()), (s.x0.numpy(), s.x1.numpy())
            posebench_group(file, f"pair{i}", x, K, (s.R.numpy(), s.t.numpy()), (SIZE, SIZE))
    return folder


def posebench_group(file: h5py.File, key: str, x, K, motion, sizes) -> None:
    """A pair of PINHOLE cameras; each entry of a camera is an array, also what is a single value.
    x, K, sizes: of both images. motion: R and t."""
    group = file.create_group(key)
    group["x1"], group["x2"] = x
    group["R"], group["t"] = motion
    for name, k, (h, w) in zip(("camera1", "camera2"), K, sizes, strict=True):
        camera = group.create_group(name)
        camera["model"] = np.array(["PINHOLE"], dtype=h5py.string_dtype())
        camera["width"], camera["height"] = np.array([w]), np.array([h])
        camera["params"] = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])


def write_oanet(folder: Path, outliers: int = 0) -> Path:
    """A file with a group for each kind of entry; matches in calibrated coordinates, t of length one.
    outliers: of the first so many matches the points of image 1 change places."""
    folder.mkdir(parents=True)
    with h5py.File(folder / "yfcc-sift-2000-test.hdf5", "w") as file:
        for i, s in enumerate(scenes()):
            K = s.K0.numpy(), s.K1.numpy()
            x = [(p.numpy() - k[:2, 2]) / k.diagonal()[:2] for p, k in zip((s.x0, s.x1), K, strict=True)]
            x[1][:outliers] = np.roll(x[1][:outliers], 1, axis=0)
            tx, ty, tz = s.t.tolist()
            E = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]]) @ s.R.numpy()
            h0, h1 = (np.column_stack([p, np.ones(len(p))]) for p in x)
            lines = h0 @ E.T, h1 @ E
            ys = (h1 * lines[0]).sum(1) ** 2 * sum(1 / (line[:, :2] ** 2).sum(1) for line in lines)
            entries: dict[str, Any] = {
                "xs": np.concatenate(x, 1)[None], "ys": ys[:, None], "Rs": s.R.numpy(),
                "ts": s.t.numpy()[:, None], "ratios": ratios(len(x[0])), "mutuals": np.arange(len(x[0])) % 2,
            }  # fmt: skip
            for which, k in zip("12", K, strict=True):
                entries |= {f"cx{which}s": [k[0, 2]], f"cy{which}s": [k[1, 2]], f"f{which}s": [[k[0, 0], k[1, 1]]]}
            for name, value in entries.items():
                file.create_dataset(f"{name}/{i}", data=np.asarray(value))
    return folder


WRITERS: dict[str, Callable[[Path], Path]] = {
    "hloc": write_hloc, "glue_factory": write_glue_factory, "vismatch": write_vismatch,
    "ransac_tutorial": write_tutorial, "posebench": write_posebench, "oanet": write_oanet,
}  # fmt: skip
