"""Small native data sets: cameras on a path, planes, images of noise, files as the sources describe them."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from tests.conftest import shared_path

SIZE = (24, 32)  # h, w of the images


def write_image(path: Path, seed: int = 0, size: tuple[int, int] = SIZE) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, size).astype(np.uint8)
    assert cv2.imwrite(str(path), pixels)
    return path


def turned(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def write_kitti(root: Path, names: tuple[str, ...] = ("06",), frames: int = 14) -> Path:
    """Sequences in KITTI's layout at 10 frames a second, driving along a curve."""
    for name in names:
        folder = root / "sequences" / name
        for i in range(frames):
            write_image(folder / "image_0" / f"{i:06d}.png", i)
        K = "40 0 15.5 {} 0 40 11.5 0 0 0 1 0"
        (folder / "calib.txt").write_text(f"P0: {K.format(0)}\nP1: {K.format(-21.5)}\n")
        (folder / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(frames)))
        (root / "poses").mkdir(exist_ok=True)
        poses = [np.column_stack([turned(0.02 * i), [0.1 * i, 0.0, 1.0 * i]]).ravel() for i in range(frames)]
        (root / "poses" / f"{name}.txt").write_text("".join(" ".join(f"{v:e}" for v in p) + "\n" for p in poses))
    return root


COLMAP_LINES = {"SIMPLE_PINHOLE": "40 16 12", "PINHOLE": "40 41 16 12", "OPENCV": "40 41 16 12 0.1 -0.02 0.001 0.002"}
"""Parameters of cameras for images of `SIZE`."""


def write_colmap(folder: Path, models: tuple[str, ...] = ("SIMPLE_PINHOLE", "PINHOLE", "OPENCV")) -> Path:
    """A scene with a text model: image i has the camera of model i, sees the points i to i + 4, and looks along z."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    cameras, images = ["# Camera list"], ["# Image list", f"# Number of images: {len(models)}, mean observations"]
    for i, model in enumerate(models):
        cameras.append(f"{i + 7} {model} {SIZE[1]} {SIZE[0]} {COLMAP_LINES[model]}")
        half = 0.05 * i
        pose = [np.cos(half), 0.0, np.sin(half), 0.0, 0.5 * i, 0.1 * i, 0.2]
        name = f"night walk/{i:02d}.png" if i == 1 else f"{i:02d}.png"
        images.append(f"{20 - i} {' '.join(str(float(v)) for v in pose)} {i + 7} {name}")
        images.append(" ".join(f"{3.5 + p} 4.5 {p if p < i + 5 else -1}" for p in range(i, i + 6)))
        write_image(folder / "images" / name, i)
    (sparse / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (sparse / "images.txt").write_text("\n".join(images) + "\n")
    return folder


def to_binary(sparse: Path) -> None:
    """Replace a text model by the binary one that COLMAP writes of it; its own reader ends names at spaces."""
    (sparse / "points3D.txt").write_text("".join(f"{p} 0 0 0 0 0 0 0\n" for p in range(20)))
    pycolmap.Reconstruction(str(sparse)).write_binary(str(sparse))
    images = sparse / "images.bin"
    images.write_bytes(images.read_bytes().replace(b"night\0", b"night walk/01.png\0"))
    for name in ("cameras", "images"):
        (sparse / f"{name}.txt").unlink()


def write_tum(root: Path, name: str = "rgbd_dataset_freiburg1_test", frames: int = 12, depth: bool = False) -> Path:
    """A sequence at 10 frames a second with poses at 100: along x at 1 m/s, turning about y at 1 rad/s."""
    folder = root / name
    start = 1305031236.0
    rgb, poses, depths = ["# timestamp filename"], ["# timestamp tx ty tz qx qy qz qw"], ["# depth"]
    for i in range(frames):
        stamp = f"{start + 0.1 * i + 0.003:.6f}"
        write_image(folder / f"rgb/{stamp}.png", i, (480, 640))
        rgb.append(f"{stamp} rgb/{stamp}.png")
        if depth:
            later = f"{start + 0.1 * i + 0.013:.6f}"
            depths.append(f"{later} depth/{later}.png")
            (folder / "depth").mkdir(exist_ok=True)
            plane = np.tile(np.arange(640, dtype=np.uint16) * 50, (480, 1))  # x / 100 metres
            plane[100:200, 300:400] = 0
            assert cv2.imwrite(str(folder / f"depth/{later}.png"), plane)
    for i in range(frames * 10 + 2):
        t = 0.01 * i
        poses.append(f"{start + t:.4f} {t:.4f} 0.5 1 0 {np.sin(t / 2):.7f} 0 {np.cos(t / 2):.7f}")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "groundtruth.txt").write_text("\n".join(poses) + "\n")
    if depth:
        (folder / "depth.txt").write_text("\n".join(depths) + "\n")
    return folder


def write_bundler(folder: Path, cameras: int = 5) -> tuple[Path, list[dict[str, np.ndarray]]]:
    """A scene of 1DSfM with points on a sphere, written from Bundler's manual; camera 3 was not registered.
    Returns the folder, and of every camera f, k, R and t as the file has them, and the points."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12, 3))
    lines, truth = ["# Bundle file v0.3", f"{cameras} {len(points)}"], []
    for i in range(cameras):
        camera = {"f": np.array(40.0 + i), "k": np.array([0.02 * i, -0.01]), "R": turned(0.2 * i)}
        camera["t"] = rng.normal(size=3)
        camera["t"] = camera["t"] - [0, 0, 9.0]
        if i == 3:
            camera = {name: 0 * value for name, value in camera.items()}
        truth.append(camera)
        lines.append(f"{float(camera['f'])!r} {float(camera['k'][0])!r} {float(camera['k'][1])!r}")
        lines += [" ".join(repr(float(v)) for v in row) for row in [*camera["R"], camera["t"]]]
        write_image(folder / f"images/{i}.png", i, (SIZE[0] + 2 * i, SIZE[1]))
    for p, X in enumerate(points):
        seen = [i for i in range(cameras) if i <= p // 3]  # camera 0 sees all points, camera 2 the last six
        lines += [" ".join(repr(float(v)) for v in X), "10 20 30"]
        lines.append(" ".join([str(len(seen)), *(f"{i} {p} 1.5 -2.5" for i in seen)]))
    (folder / "gt_bundle.out").write_text("\n".join(lines) + "\n")
    listed = [f"images/{i}.png" + (" 0 40.5" if i % 2 else "") for i in range(cameras)]
    (folder / "list.txt").write_text("\n".join(listed) + "\n")
    return folder, [{**camera, "points": points} for camera in truth]


VIEW = (320, 480)  # (h, w) of image 1


def view(seed: int, strength: float = 0.15) -> np.ndarray:
    """A homography that moves each corner by up to a share of the sides."""
    rng = np.random.default_rng(seed)
    h, w = VIEW
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
    moved = corners + rng.uniform(-strength, strength, (4, 2)).astype(np.float32) * [w, h]
    return cv2.getPerspectiveTransform(corners, moved.astype(np.float32))


def write_sequence(folder: Path, photograph: str, light: bool, count: int = 6, suffix: str = ".ppm") -> Path:
    """A sequence: image 1, and images 2 to 6 of other light or another viewpoint."""
    folder.mkdir(parents=True)
    picture = cv2.imread(str(shared_path(f"data/photos/{photograph}")))
    image = cv2.resize(picture, VIEW[::-1], interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(folder / f"1{suffix}"), image)
    for k in range(2, count + 1):
        H = np.eye(3) if light else view(k)
        seen = np.clip(image * (1.1 - 0.1 * k) + 5 * k, 0, 255).astype(np.uint8) if light else image
        cv2.imwrite(str(folder / f"{k}{suffix}"), cv2.warpPerspective(seen, H, VIEW[::-1]))
        rows = (" ".join(f"{value:.10g}" for value in row) for row in H)
        (folder / f"H_1_{k}").write_text("\n".join(rows) + "\n")
    return folder


def write_hpatches(root: Path, photographs: Sequence[str] = ("0000.jpg", "0003.jpg")) -> Path:
    write_sequence(root / "i_light", photographs[0], light=True)
    write_sequence(root / "v_view", photographs[1], light=False)
    return root
