"""Lists of pairs in others' layouts, of a scene of shared photographs with known cameras."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.conftest import shared_path

SCENE = "data/PhotoTourism/sacre_coeur"
Camera = tuple[np.ndarray, np.ndarray, np.ndarray]  # K, R, t


def cameras() -> list[Camera]:
    """Of the images ``00000000.jpg`` and so on of `images`."""
    rows = np.loadtxt(shared_path(f"{SCENE}/Camera.txt"))
    return [(r[:9].reshape(3, 3), r[9:18].reshape(3, 3), r[18:]) for r in rows]


def images() -> Path:
    return shared_path(f"{SCENE}/Images")


def name(i: int) -> str:
    return f"{i:08d}.jpg"


def motion(a: Camera, b: Camera) -> np.ndarray:
    """The matrix (4, 4) that takes points of camera a to camera b."""
    world = [np.vstack([np.column_stack([R, t]), [0, 0, 0, 1]]) for _, R, t in (a, b)]
    return world[1] @ np.linalg.inv(world[0])


def words(values: np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in np.ravel(values))


def superglue(i: int, j: int, turns: tuple[int, int] = (0, 0)) -> str:
    a, b = cameras()[i], cameras()[j]
    return f"{name(i)} {name(j)} {turns[0]} {turns[1]} {words(a[0])} {words(b[0])} {words(motion(a, b))}"


def glue_factory(i: int, j: int, matrix: bool = False, corner: float = 0.5) -> str:
    """A line of glue-factory's lists, 32 or 36 columns, whose K has the first pixel's centre at `corner`."""
    a, b = cameras()[i], cameras()[j]
    K = [camera[0] + corner * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]]) for camera in (a, b)]
    T = motion(a, b)
    pose = words(T) if matrix else f"{words(T[:3, :3])} {words(T[:3, 3])}"
    return f"{name(i)} {name(j)} {words(K[0])} {words(K[1])} {pose}"


def write(path: Path, lines: Sequence[str]) -> Path:
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


def loftr(path: Path, pairs: Sequence[tuple[int, int]], prefix: str = "") -> Path:
    """LoFTR's file of a MegaDepth scene: arrays of objects, with None where an image was not registered."""
    count = len(cameras()) + 1
    columns = {key: np.full(count, None, object) for key in ("image_paths", "depth_paths", "intrinsics", "poses")}
    for i, (K, R, t) in enumerate(cameras(), start=1):
        columns["image_paths"][i] = prefix + name(i - 1)
        columns["intrinsics"][i] = K + 0.5 * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
        columns["poses"][i] = np.vstack([np.column_stack([R, t]), [0, 0, 0, 1]])
    infos = np.full(len(pairs), None, object)
    for row, (i, j) in enumerate(pairs):
        infos[row] = (np.array([i + 1, j + 1]), np.float64(0.2), np.ones((3, 4)))
    np.savez(path, pair_infos=infos, **columns)  # type: ignore[arg-type]
    return path
