"""`PlanePairs`: photographs as planes that known cameras see, so that every match of two views can be judged.

Rendered scenes show few textures under exact light. A photograph seen as a plane has the texture of the world, and the
depth of every point of its views is known; but the matches of one plane determine no fundamental matrix (Hartley and
Zisserman, section 11.9), so that these pairs train the classification of matches alone."""

import dataclasses
import hashlib
import itertools
import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.core.files import cache_dir, write_whole
from fmtorch.data import ImagePair, ImageSource, read_image
from fmtorch.data.pairs import HeldPairs, relative_pose
from fmtorch.scenes.raycast import Camera, calibration
from fmtorch.training.options import PlaneViews as PlaneViews

SUFFIXES = {".jpg", ".jpeg", ".png", ".ppm", ".tif", ".tiff"}
VERSION = 1  # of the views: raised by every change that changes one
_QUALITY = 92  # of the JPEG files; `change_camera` may have compressed the view before
Grey = NDArray[np.uint8]
Matrix = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Photograph:
    """A file and the source it comes from; photographs of one source never serve both training and validation."""

    path: Path
    source: str


def list_photographs(
    folder: Path | str, sources: Sequence[str] | None = None, excluded: Sequence[str] = ()
) -> list[Photograph]:
    """The photographs of a folder, in a fixed order.
    The source is the fourth column of ``sources.txt`` (file width height source path) where the folder has one, with
    the path appended after a colon for `excluded`; else the subfolder, or for files at the top the file itself.
    sources: only these; None: all. excluded: parts of "source:path". Raises FileNotFoundError, ValueError for none."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder of photographs")
    table = folder / "sources.txt"
    if table.is_file():
        rows = [line.split(maxsplit=4) for line in table.read_text().splitlines() if line and not line.startswith("#")]
        photographs = [(folder / row[0], row[3], f"{row[3]}:{row[4]}") for row in rows]
    else:
        files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
        names = [path.relative_to(folder) for path in files]
        own = [str(name.parent if len(name.parts) > 1 else name) for name in names]
        photographs = list(zip(files, own, map(str, names), strict=True))
    allowed = [each for each in photographs if sources is None or each[1] in sources]
    kept = [Photograph(path, own) for path, own, full in allowed if not any(part in full for part in excluded)]
    if not kept:
        left = f"none of its {len(photographs)} photographs is left by sources and excluded"
        raise ValueError(f"{folder}: {left}" if photographs else f"{folder} holds no photographs")
    return kept


class PlanePairs(HeldPairs):
    """Pairs of views of photographs, each photograph a plane; a `DepthDataset`. F is zero: none is determined.
    The plane goes on past the photograph's edges as its mirror image. Light, focus, noise and compression of each view
    are changed as by another camera on another day. Views are drawn on first use and kept; a view depends on its
    photograph's bytes, `views`, `seed` and its number alone. photographs: files that OpenCV reads. root: folder that
    keeps the views, by default ``planes`` in the cache folder. workers: threads that draw. progress: called with
    (photographs done, photographs in all). Raises ImageError for a file that is none."""

    name = "planes"

    def __init__(
        self, photographs: Sequence[Photograph], views: PlaneViews | None = None, seed: int = 0,
        root: str | Path | None = None, *, workers: int = 1, progress: Callable[[int, int], None] | None = None,
    ) -> None:  # fmt: skip
        if not photographs:
            raise ValueError("no photographs to look at")
        self.views = views or PlaneViews()
        files = [photograph.path for photograph in photographs]
        defined = [VERSION, ".".join(cv2.__version__.split(".")[:2]), dataclasses.asdict(self.views), seed]
        digests = [hashlib.sha256(json.dumps(defined).encode() + file.read_bytes()).hexdigest() for file in files]
        self.digest = hashlib.sha256(" ".join(digests).encode()).hexdigest()
        home = Path(root) if root is not None else cache_dir() / "planes"
        scenes = [digest[:16] for digest in digests]
        self._cameras: dict[str, Camera] = {}
        self._paths: dict[str, Path] = {}
        report = progress or (lambda done, total: None)
        report(0, len(files))
        with ThreadPoolExecutor(workers) as executor:
            folders = [home / scene for scene in scenes]
            drawn = executor.map(self._photograph, files, folders, digests)
            for done, (scene, folder, cameras) in enumerate(zip(scenes, folders, drawn, strict=True), 1):
                for i, camera in enumerate(cameras):
                    self._cameras[f"{scene}/{i}"], self._paths[f"{scene}/{i}"] = camera, folder / f"{i:02d}.jpg"
                report(done, len(files))
        ends = list(itertools.combinations(range(self.views.views), 2))
        self._pairs = [self._pair(scene, i, j) for scene in dict.fromkeys(scenes) for i, j in ends]

    def _pair(self, scene: str, i: int, j: int) -> ImagePair:
        camera0, camera1 = (self._cameras[f"{scene}/{k}"] for k in (i, j))
        images = [ImageSource(f"{scene}/{k}", self._paths[f"{scene}/{k}"]) for k in (i, j)]
        identity, truth = f"{self.name}/{scene}/{i}-{j}", (camera0.K, camera1.K, *relative_pose(camera0, camera1))
        return ImagePair(identity, self.name, scene, images[0], images[1], np.zeros((3, 3)), *truth)

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
            write_whole(path, cv2.imencode(".jpg", view, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())
        return cameras


def random_camera(rng: np.random.Generator, size: tuple[int, int], limits: PlaneViews) -> Camera:
    """A camera that looks at the plane z = 0 from z < 0; the photograph of size (h, w) lies on it about the origin.
    Its longest side is 1, x goes right and y down, as in the photograph. The horizon is never in view."""
    h, w = size
    ranges = limits.scale, limits.part, limits.focal  # of ratios
    scale, part, focal = (math.exp(rng.uniform(math.log(low), math.log(high))) for low, high in ranges)
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


def warp(image: Grey, H: Matrix, size: tuple[int, int]) -> Grey:
    """The view of an image under a homography, drawn finer and then reduced by areas where it shrinks the image."""
    h, w = size
    centre = np.array([[(image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2]])
    smallest = float(np.linalg.svd(local_affine(H, centre)[0], compute_uv=False)[-1])
    fine = int(np.clip(math.ceil(1 / smallest - 0.25), 1, 4))
    up = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1.0]])
    size = (w * fine, h * fine)
    view = cv2.warpPerspective(image, up @ H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return view if fine == 1 else cv2.resize(view, (w, h), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def local_affine(H: Matrix, points: Matrix) -> Matrix:
    """The derivative (n, 2, 2) of a homography at points (n, 2)."""
    mapped = np.c_[points, np.ones(len(points))] @ H.T
    out = mapped[:, :2] / mapped[:, 2:]
    return (H[None, :2, :2] - out[:, :, None] * H[None, None, 2, :2]) / mapped[:, 2, None, None]  # type: ignore[no-any-return]


def grey_of(rng: np.random.Generator, image: NDArray[np.uint8]) -> Grey:
    """A grey image of an RGB one with random weights of the channels, as under light of another colour."""
    if image.ndim == 2:
        return image
    return np.clip(image @ rng.dirichlet([3.0, 5.0, 2.0]), 0, 255).astype(np.uint8)


def change_light(rng: np.random.Generator, image: Grey) -> Grey:
    """Gamma, contrast, brightness and soft shadows, at random."""
    x = image.astype(np.float32) / 255
    x = x ** np.float32(math.exp(rng.uniform(-0.5, 0.5)))
    if rng.random() < 0.6:
        coarse = rng.normal(0, rng.uniform(0.1, 0.4), (int(rng.integers(2, 6)), int(rng.integers(2, 6))))
        x = x * np.exp(cv2.resize(coarse.astype(np.float32), image.shape[::-1], interpolation=cv2.INTER_CUBIC))
    low, high = float(x.min()), float(x.max())
    bottom, top = rng.uniform(-0.1, 0.2), rng.uniform(0.65, 1.15)
    x = bottom + (x - low) / max(high - low, 1e-6) * (top - bottom)
    return (np.clip(x, 0, 1) * 255).round().astype(np.uint8)


def change_camera(rng: np.random.Generator, image: Grey) -> Grey:
    """Blur of focus or of motion, noise and JPEG compression, at random."""
    choice = rng.random()
    if choice < 0.4:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.6)), np.uint8)
    elif choice < 0.55:
        length, angle = int(rng.integers(3, 9)), rng.uniform(0, 180)
        line = np.zeros((length, length), np.float32)
        line[length // 2] = 1
        turn = cv2.getRotationMatrix2D(((length - 1) / 2, (length - 1) / 2), angle, 1.0)
        kernel = np.asarray(cv2.warpAffine(line, turn, (length, length)), np.float32)
        image = np.asarray(cv2.filter2D(image, -1, kernel / max(float(kernel.sum()), 1e-6)), np.uint8)
    if rng.random() < 0.6:
        image = np.clip(image + rng.normal(0, rng.uniform(1, 9), image.shape), 0, 255).round().astype(np.uint8)
    if rng.random() < 0.6:
        _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 95))])
        image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)
    return image


def _rotation(vector: tuple[float, float, float]) -> Matrix:
    return np.asarray(cv2.Rodrigues(np.array(vector))[0], np.float64)
