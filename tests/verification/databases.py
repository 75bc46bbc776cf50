"""COLMAP databases of cameras before random points, written by pycolmap."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from fmtorch.data import MODELS
from tests.data.test_lenses import COEFFICIENTS
from tests.processes import starter

SIZE = (480, 640)  # h, w
F = 600.0


def parameters(model: str) -> list[float]:
    if model == "PINHOLE":
        return [F, 1.02 * F, 310, 250]
    return [*[F] * MODELS[model].focals, 320, 240, *COEFFICIENTS.get(model, ())]


@dataclasses.dataclass
class Scene:
    """Cameras X_i = R_i X + t_i and points (n, 3); every fifth match of each pair is wrong."""

    R: list[np.ndarray]
    t: list[np.ndarray]
    X: np.ndarray

    def relative(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation and direction of translation from camera i to j."""
        R = self.R[j] @ self.R[i].T
        t = self.t[j] - R @ self.t[i]
        return R, t / max(float(np.linalg.norm(t)), 1e-12)


def scene(images: int, count: int = 150, seed: int = 0, kind: str = "general") -> Scene:
    """Images along an arc before a cloud of points, or before a plane, or of a camera that turns."""
    rng = np.random.default_rng(seed)
    X = rng.uniform([-2.5, -1.8, 5], [2.5, 1.8, 9], (count, 3))
    if kind == "planar":
        X[:, 2] = 7 + 0.3 * X[:, 0] - 0.2 * X[:, 1]
    angles = np.linspace(-0.12, 0.12, images)
    R = [Rotation.from_euler("yxz", [a, 0.3 * a, 0.2 * a]).as_matrix() for a in angles]
    step = 0.0 if kind == "rotation" else 1.0
    t = [step * np.array([9 * a, 0.1 * i, -1.5 * a]) for i, a in enumerate(angles)]
    return Scene(R, t, X)


def write(
    path: Path, scene: Scene, model: str = "PINHOLE", *, prior: bool = True, columns: int = 2, noise: float = 0.3,
    pairs: Sequence[tuple[int, int]] | None = None, params: Sequence[float] | None = None, shared: bool = True,
) -> list[int]:  # fmt: skip
    """A database of the scene with 0.3 px of noise and all its pairs; the images' numbers."""
    path.unlink(missing_ok=True)
    rng = np.random.default_rng(1)
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera(model=model, width=SIZE[1], height=SIZE[0], params=params or parameters(model))
        camera.has_prior_focal_length = prior
        camera.camera_id = database.write_camera(camera)
        rig = rig_of(database, camera)
        ids = []
        for i, (R, t) in enumerate(zip(scene.R, scene.t, strict=True)):
            if not shared and i:
                camera.camera_id = database.write_camera(camera)
                rig = rig_of(database, camera)
            image = pycolmap.Image(name=f"{i:03d}.jpg", camera_id=camera.camera_id)
            image.image_id = database.write_image(image)
            frame = pycolmap.Frame(rig_id=rig)
            frame.add_data_id(image.data_id)
            database.write_frame(frame)
            ids.append(image.image_id)
            points = camera.img_from_cam(np.ascontiguousarray(scene.X @ R.T + t))
            points = points + rng.normal(0, noise, points.shape)
            rest = np.random.default_rng(i).uniform(1, 4, (len(points), columns - 2))
            rest *= np.array([1, 0.1, -0.1, 1][: columns - 2])
            database.write_keypoints(image.image_id, np.concatenate([points, rest], 1).astype(np.float32))
        wanted = pairs or [(i, j) for i in range(len(ids)) for j in range(i + 1, len(ids))]
        for i, j in wanted:
            database.write_matches(ids[i], ids[j], matches(len(scene.X), rng))
    return ids


def rig_of(database: Any, camera: Any) -> int:
    rig = pycolmap.Rig(rig_id=camera.camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    return int(database.write_rig(rig, use_rig_id=True))


def matches(count: int, rng: np.random.Generator) -> np.ndarray:
    """Each point with itself, but for a fifth that are matched among one another."""
    second = np.arange(count)
    wrong = second[::5]
    second[::5] = np.roll(rng.permutation(wrong), 1)
    return np.stack([np.arange(count), second], 1).astype(np.uint32)


def read(path: Path) -> dict[tuple[int, int], Any]:
    with pycolmap.Database.open(path) as database:
        ids, _ = database.read_num_matches()
        pairs = [pycolmap.pair_id_to_image_pair(pair) for pair in ids]
        return {p: database.read_two_view_geometry(*p) for p in pairs if database.exists_two_view_geometry(*p)}


def plain(geometries: dict[tuple[int, int], Any]) -> dict[tuple[int, int], tuple[Any, ...]]:
    values = {}
    for pair, g in geometries.items():
        matrices = (g.E, g.F, g.H, None if g.cam2_from_cam1 is None else g.cam2_from_cam1.matrix())
        known = (None if matrix is None else matrix.tolist() for matrix in matrices)
        values[pair] = (int(g.config), g.inlier_matches.tolist(), *known)
    return values


def killed_and_continued(folder: Path, end: Path, *words: str) -> None:
    """Kill `fmtorch verify` after some batches, which leaves no `end`; the same command then goes on, to the end."""
    slowly = "import fmtorch.verification.verify as v\nv.BATCH = 2\n"
    there, parts = end.exists(), end.with_name(f"{end.name}.parts")
    command = starter().start(folder, "verify", *words, before=slowly)
    assert command.kill_when(lambda: len(list(parts.glob("*.npz"))) > 2), command.said()
    assert end.exists() == there
    command = starter().run(folder, "verify", *words, before=slowly)
    assert command.wait() == 0, command.said()
    assert re.search(r"had a geometry\W+\d+", command.said())
    assert not [path for path in folder.iterdir() if path.name.endswith((".partial", ".parts", "-wal", ".tmp"))]
