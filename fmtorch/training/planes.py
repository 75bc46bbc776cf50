"""`PlanePairs`: photographs as planes that known cameras see, so that every match of two views can be judged.

Rendered scenes show few textures under exact light. A photograph seen as a plane has the texture of the world, and the
depth of every point of its views is known; but the matches of one plane determine no fundamental matrix (Hartley and
Zisserman, section 11.9), so that these pairs train the classification of matches alone.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from fmtorch.core.files import cache_dir, replacing
from fmtorch.data.cameras import relative_pose
from fmtorch.data.images import read_image
from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.scenes.camera import Camera, calibration
from fmtorch.training.photographs import Photograph
from fmtorch.training.warps import Matrix, change_camera, change_light, grey_of, warp

VERSION = 1  # of the views: raised by every change that changes one
_QUALITY = 92  # of the JPEG files; `change_camera` may have compressed the view before


@dataclasses.dataclass(frozen=True)
class PlaneViews:
    """How views are drawn; ranges are uniform, of ratios in their logarithm.

    views: of each photograph; every two of them are a pair. tilt: largest angle in degrees between the optical axis and
    the plane's normal. roll: standard deviation in degrees of the rotation about the axis. part: of the photograph's
    width that a view spans. scale: sides of a view, of the photograph's. focal: in widths of the view.
    """

    views: int = 5
    tilt: float | int = 60.0
    roll: float | int = 15.0
    part: tuple[float | int, float | int] = (0.5, 1.0)
    scale: tuple[float | int, float | int] = (0.7, 1.0)
    focal: tuple[float | int, float | int] = (0.7, 1.8)

    def __post_init__(self) -> None:
        if self.views < 2:
            raise ValueError(f"planes.views={self.views}; a pair needs 2")
        if not 0 <= self.tilt < 80 or self.roll < 0:
            raise ValueError(f"planes.tilt={self.tilt}, roll={self.roll}: 0 <= tilt < 80 degrees, roll not negative")
        for name in ("part", "scale", "focal"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"planes.{name}={[low, high]}; it must be two positive numbers, the smaller first")


class PlanePairs(Dataset[ImagePair]):
    """Pairs of views of photographs, each photograph a plane; a `DepthDataset`. F is zero: none is determined.

    The plane goes on past the photograph's edges as its mirror image. Light, focus, noise and compression of each view
    are changed as by another camera on another day. Views are drawn on first use and kept; a view depends on its
    photograph's bytes, `views`, `seed` and its number alone.

    Args:
        photographs: files that OpenCV reads. views: how to look at them. seed: of the views.
        root: folder that keeps the views, by default ``planes`` in the cache folder.
        workers: threads that draw. progress: called with (photographs done, photographs in all).

    Raises ImageError for a file that is no image, ValueError where there is none.
    """

    name = "planes"

    def __init__(
        self,
        photographs: Sequence[Photograph],
        views: PlaneViews | None = None,
        seed: int = 0,
        root: str | Path | None = None,
        *,
        workers: int = 1,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        if not photographs:
            raise ValueError("no photographs to look at")
        self.views = views or PlaneViews()
        files = [photograph.path for photograph in photographs]
        defined = [VERSION, ".".join(cv2.__version__.split(".")[:2]), dataclasses.asdict(self.views), seed]
        digests = [hashlib.sha256(json.dumps(defined).encode() + file.read_bytes()).hexdigest() for file in files]
        self.digest = hashlib.sha256(" ".join(digests).encode()).hexdigest()
        home = Path(root) if root is not None else cache_dir() / "planes"
        self._scenes = [digest[:16] for digest in digests]
        self._cameras: dict[str, Camera] = {}
        self._paths: dict[str, Path] = {}
        report = progress or (lambda done, total: None)
        report(0, len(files))
        with ThreadPoolExecutor(workers) as executor:
            folders = [home / scene for scene in self._scenes]
            drawn = executor.map(self._photograph, files, folders, digests)
            for done, (scene, folder, cameras) in enumerate(zip(self._scenes, folders, drawn, strict=True), 1):
                for i, camera in enumerate(cameras):
                    self._cameras[f"{scene}/{i}"], self._paths[f"{scene}/{i}"] = camera, folder / f"{i:02d}.jpg"
                report(done, len(files))
        self._pairs = [
            (scene, i, j)
            for scene in dict.fromkeys(self._scenes)
            for i, j in itertools.combinations(range(self.views.views), 2)
        ]

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> ImagePair:
        scene, i, j = self._pairs[index]
        camera0, camera1 = (self._cameras[f"{scene}/{k}"] for k in (i, j))
        R, t = relative_pose(camera0, camera1)
        images = [ImageSource(f"{scene}/{k}", self._paths[f"{scene}/{k}"]) for k in (i, j)]
        return ImagePair(
            identity=f"{self.name}/{scene}/{i}-{j}", family=self.name, scene=scene, image0=images[0], image1=images[1],
            F=np.zeros((3, 3)), K0=camera0.K, K1=camera1.K, R=R, t=t,
        )  # fmt: skip

    def __iter__(self) -> Iterator[ImagePair]:
        return (self[index] for index in range(len(self)))

    def depth(self, image: ImageSource, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth (n,), in longest sides of the photograph, at points (n, 2) of a view; NaN outside of it."""
        return plane_depth(self._cameras[image.identity], points)

    def homography(self, pair: ImagePair) -> Matrix:
        """From pixels of a pair's first view to those of its second; positive where the plane is seen."""
        there, back = (plane_homography(self._cameras[image.identity], (1, 1)) for image in (pair.image1, pair.image0))
        H: Matrix = there @ np.linalg.inv(back)
        return H / np.linalg.norm(H)

    def _photograph(self, file: Path, folder: Path, digest: str) -> list[Camera]:
        """The cameras of a photograph's views, which are drawn unless they are there."""
        picture = read_image(file, orient=True)
        h, w = picture.shape[:2]
        cameras = []
        for i, stream in enumerate(np.random.SeedSequence(int(digest[:32], 16)).spawn(self.views.views)):
            rng = np.random.default_rng(stream)
            cameras.append(random_camera(rng, (h, w), self.views))
            path = folder / f"{i:02d}.jpg"
            if path.exists():
                continue
            folder.mkdir(parents=True, exist_ok=True)
            view = warp(grey_of(rng, picture), plane_homography(cameras[-1], (h, w)), cameras[-1].size)
            view = change_camera(rng, change_light(rng, view))
            coded = cv2.imencode(".jpg", view, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
            with replacing(path) as temporary:
                temporary.write_bytes(coded.tobytes())
        return cameras


def random_camera(rng: np.random.Generator, size: tuple[int, int], limits: PlaneViews) -> Camera:
    """A camera that looks at the plane z = 0 from z < 0; the photograph of size (h, w) lies on it about the origin.

    Its longest side is 1, x goes right and y down, as in the photograph. The horizon is never in view.
    """
    h, w = size
    scale, part, focal = (_log_uniform(rng, range_) for range_ in (limits.scale, limits.part, limits.focal))
    out = max(32, round(h * scale)), max(32, round(w * scale))
    K = calibration(focal * out[1], out)
    corner = math.degrees(math.atan(math.hypot(*out) / 2 / K[0, 0]))
    tilt = math.radians(rng.uniform(0, max(0.0, min(limits.tilt, 80 - corner))))
    azimuth = rng.uniform(0, 2 * math.pi)
    roll = math.radians(rng.normal(0, limits.roll))
    sides = np.array([w, h]) / max(w, h)
    target = np.append(rng.uniform(-0.5, 0.5, 2) * (1 - part) * sides, 0.0)
    distance = part * sides[0] * focal
    R = _rotation((0.0, 0.0, roll)) @ _rotation((tilt * math.cos(azimuth), tilt * math.sin(azimuth), 0.0))
    return Camera(K, R, np.array([0, 0, distance]) - R @ target, out)


def plane_homography(camera: Camera, size: tuple[int, int]) -> Matrix:
    """From pixels of the photograph of size (h, w) to those of the view: K [r1 r2 t] (Hartley & Zisserman, eq. 8.1)."""
    h, w = size
    to_plane = np.array([[1, 0, -(w - 1) / 2], [0, 1, -(h - 1) / 2], [0, 0, max(h, w)]]) / max(h, w)
    H: Matrix = camera.K @ np.column_stack([camera.R[:, :2], camera.t]) @ to_plane
    return H / H[2, 2]  # type: ignore[no-any-return]


def plane_depth(camera: Camera, points: Matrix) -> Matrix:
    """Depth (n,) of the plane z = 0 along the axis at points (n, 2) in pixels; NaN outside the image."""
    h, w = camera.size
    rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(camera.K).T
    depth = -camera.centre[2] / (rays @ camera.R)[:, 2]
    inside = (points >= -0.5).all(1) & (points < np.array([w, h]) - 0.5).all(1)
    return np.where(inside & (depth > 0), depth, np.nan)


def _log_uniform(rng: np.random.Generator, limits: tuple[float | int, float | int]) -> float:
    return math.exp(rng.uniform(math.log(limits[0]), math.log(limits[1])))


def _rotation(vector: tuple[float, float, float]) -> Matrix:
    return np.asarray(cv2.Rodrigues(np.array(vector))[0], np.float64)
