"""The item of every data set: an image pair with its ground truth, what two cameras say of it, and its images.

These are read without the distortion of their lenses, resized and turned."""

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
import torch

from fmtorch.core.lenses import Lens
from fmtorch.core.types import Correspondences, pair_key
from fmtorch.data.files import DataError, Matrix, Pixels, Singles

Size = tuple[int, int]  # (h, w), px


@dataclasses.dataclass(frozen=True)
class Resampling:
    """What happens to an image of a file after it is decoded: first it is resized, then turned.
    size: (h, w) to which it is resized, by areas where both sides shrink, bilinearly otherwise; None: its own.
    quarter_turns: by which it is turned counterclockwise, 0 to 3, as `np.rot90` does and SuperGlue's lists count."""

    size: Size | None = None
    quarter_turns: int = 0

    def __call__(self, image: Pixels) -> Pixels:
        if self.size is not None and image.shape[:2] != self.size:
            shrinks = self.size[0] <= image.shape[0] and self.size[1] <= image.shape[1]
            kind = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            image = np.asarray(cv2.resize(image, self.size[::-1], interpolation=kind), np.uint8)
        return np.ascontiguousarray(np.rot90(image, self.quarter_turns)) if self.quarter_turns else image

    def matrix(self, size: Size) -> Matrix:
        """The affine map (3, 3) from pixels of an image of `size` (h, w) to pixels of what is read.
        (0, 0) is the centre of the first pixel of either: resizing by s moves x to ``(x + 0.5) s - 0.5``."""
        h, w = self.size or size
        sy, sx = h / size[0], w / size[1]
        resized = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1.0]])
        for turn in range(self.quarter_turns):
            width = w if turn % 2 == 0 else h
            resized = np.array([[0, 1.0, 0], [-1.0, 0, width - 1], [0, 0, 1.0]]) @ resized
        return resized

    @property
    def rotation(self) -> Matrix:
        """The rotation (3, 3) of the camera's axes that goes with the turn: x right and y down of the turned image."""
        quarter = np.array([[0, 1.0, 0], [-1.0, 0, 0], [0, 0, 1.0]])
        return np.asarray(np.linalg.matrix_power(quarter, self.quarter_turns))

    def calibration(self, K: Matrix, size: Size) -> Matrix:
        """The calibration (3, 3) of what is read, K being that of an image of `size`: ``matrix K rotation^T``."""
        return np.asarray(self.matrix(size) @ K @ self.rotation.T)


def scaled_size(size: Size, scale: float) -> Size:
    """The size (h, w) times a factor, in whole pixels, at least one."""
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


@dataclasses.dataclass(frozen=True)
class ImageSource:
    """One image on disk.
    identity: names it within its data set.
    size: (h, w) that the file must have, where the data set says so: cameras hold for one size alone.
    lens: whose distortion `read_image` takes out, unless it is wanted as_photographed; None for an image without.
    resampling: how `read_image` then resizes and turns it. data: the file's bytes, where a worker cannot read it."""

    identity: str
    path: Path
    size: Size | None = None
    lens: Lens | None = None
    data: bytes | None = dataclasses.field(default=None, repr=False, compare=False)
    resampling: Resampling | None = None
    as_photographed: bool = False

    @property
    def bending(self) -> Lens | None:
        """The lens that bends the pixels which `read_image` gives, None where none does."""
        return self.lens if self.as_photographed else None

    @property
    def pixels(self) -> tuple[Path, Lens | None, Resampling | None]:
        """What decides the pixels that `read_image` gives."""
        return self.path, None if self.as_photographed else self.lens, self.resampling


class GivenMatches(NamedTuple):
    """Matches of one pair that somebody else computed, and how many keypoints each image has."""

    correspondences: Correspondences
    features: tuple[int, int]


@dataclasses.dataclass(frozen=True, eq=False)
class ImagePair:
    """Two images of one scene and how they are related.
    identity: unique within the data set, e.g. ``Strecha/fountain-P11/3-7``.
    family: what results are grouped by (a data set, say). scene: the cluster for the bootstrap, ``fountain-P11``.
    F: (3, 3) float64 with ``x1^T F x0 = 0`` in pixels.
    K0, K1: (3, 3), R: (3, 3), t: (3,) with ``X1 = R X0 + t``, where known.
    problem: why this pair cannot be used (a bad line of a pairs file, say); None for a sound pair.
    matches: reads the matches that come with the pair, in place of features and matcher; can be sent between processes.
    H: (3, 3) float64 with ``x1 ~ H x0`` in pixels, of a data set of homographies, whose F is zero; None for any other.
    given: what estimators are given of cameras and lenses, fields of `Correspondences` for one pair; None: nothing."""

    identity: str
    family: str
    scene: str
    image0: ImageSource
    image1: ImageSource
    F: Matrix
    K0: Matrix | None = None
    K1: Matrix | None = None
    R: Matrix | None = None
    t: Matrix | None = None
    problem: str | None = None
    matches: Callable[[], GivenMatches] | None = None
    H: Matrix | None = None
    given: Mapping[str, torch.Tensor | None] | None = None

    @property
    def key(self) -> int:
        return pair_key(self.identity)


@runtime_checkable
class PairDataset(Protocol):
    """A sequence of image pairs.
    name: e.g. ``fmbench``. digest: hex digest of what defines the pairs (contents of pairs files, or the generator's
    version and parameters; never an absolute path), part of a run's identity. One whose pairs have homographies in
    place of F says so by an attribute `model`, "homography"."""

    name: str
    digest: str

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> ImagePair: ...

    def __iter__(self) -> Iterator[ImagePair]:
        return (self[index] for index in range(len(self)))


class HeldPairs(PairDataset):
    """Pairs that a data set holds in memory."""

    _pairs: list[ImagePair]

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> ImagePair:
        return self._pairs[index]


@runtime_checkable
class DepthDataset(PairDataset, Protocol):
    """A data set that knows how far away the points of its images are, in the unit of the pairs' t."""

    def depth(self, image: ImageSource, points: Matrix) -> Matrix: ...


class PairSubset(PairDataset):
    """The pairs of these indices, in this order, with what the data set knows of depth.
    Of all of them the digest still differs from that of the data set, as it names the pairs."""

    def __init__(self, dataset: PairDataset, indices: Sequence[int]) -> None:
        self.dataset, self.indices = dataset, list(indices)
        self.name = dataset.name
        if isinstance(dataset, DepthDataset):
            self.depth = dataset.depth
        self.digest = hashlib.sha256(f"{dataset.digest} {self.indices}".encode()).hexdigest()

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> ImagePair:
        return self.dataset[self.indices[index]]


# Pinhole cameras, and what two of them say about an image pair

SAME_CENTRE = 1e-9  # baseline below which there is no F, relative to the cameras' distance from the origin (float64)
NEARLY_ROTATION = 0.05  # change of an entry up to which a matrix is taken for a rotation that was rounded


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole: its calibration K (3, 3), and R (3, 3), t (3,) that map the world to the camera."""

    K: Matrix
    R: Matrix
    t: Matrix


def relative_pose(camera0: Camera, camera1: Camera) -> tuple[Matrix, Matrix]:
    """R and t of ``X1 = R X0 + t``, with X0 and X1 in the two cameras' coordinates."""
    R = camera1.R @ camera0.R.T
    return R, camera1.t - R @ camera0.t


def fundamental(camera0: Camera, camera1: Camera) -> Matrix:
    """F with ``x1^T F x0 = 0`` and unit Frobenius norm: ``K1^-T [t]x R K0^-1`` (Hartley and Zisserman, eq. 9.12).
    Equal, up to scale, to ``[P1 C0]x P1 P0^+`` of the projection matrices. NaN where the baseline is exactly zero."""
    R, t = relative_pose(camera0, camera1)
    cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    F: Matrix = np.linalg.inv(camera1.K).T @ cross @ R @ np.linalg.inv(camera0.K)
    return F / np.linalg.norm(F)


def share_centre(camera0: Camera, camera1: Camera) -> bool:
    """Whether two cameras are at one place, as far as float64 tells: a pure rotation has no F."""
    centres = [-camera.R.T @ camera.t for camera in (camera0, camera1)]
    return bool(np.linalg.norm(centres[0] - centres[1]) <= SAME_CENTRE * max(map(np.linalg.norm, centres)))


def line_distance(F: Matrix, x0: Matrix, x1: Matrix) -> Matrix:
    """The larger distance (n,), px, of two matched points (n, 2) to their epipolar lines; infinite on an epipole."""
    h0, h1 = (np.column_stack([x, np.ones(len(x))]) for x in (x0, x1))
    line1, line0 = h0 @ F.T, h1 @ F
    shorter = np.minimum(np.hypot(line0[:, 0], line0[:, 1]), np.hypot(line1[:, 0], line1[:, 1]))
    residual = np.abs((h1 * line1).sum(1))
    return np.where(shorter > 0, residual / np.where(shorter > 0, shorter, 1.0), np.inf)


def nearest_rotation(matrix: Matrix, place: str) -> Matrix:
    """The rotation nearest to a matrix (3, 3) that was one before it was rounded to a text file.
    Raises DataError, which begins with `place`, for a matrix that is no rotation."""
    u, _, v = np.linalg.svd(matrix)
    rotation: Matrix = u @ v
    if np.linalg.det(rotation) < 0 or np.abs(rotation - matrix).max() > NEARLY_ROTATION:
        raise DataError(f"{place}: the matrix is no rotation; it must be orthonormal with determinant 1")
    return rotation


def rotation_of_quaternion(quaternion: Matrix, place: str) -> Matrix:
    """The rotation of a quaternion (w, x, y, z) of any length. Raises DataError, after `place`, where that is zero."""
    norm = np.linalg.norm(quaternion)
    if not np.isfinite(norm) or norm == 0:
        raise DataError(f"{place}: quaternion {quaternion.tolist()}; it must be finite and not zero")
    w, x, y, z = quaternion / norm
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


# Photographs without the distortion of their lenses

_KEPT = 2  # maps of which lenses are remembered: frames of one video follow one another; 8 bytes a pixel


def undistorted(image: Pixels, lens: Lens) -> Pixels:
    """The image (H, W) or (H, W, 3) without the distortion of its lens: same size, and `lens.K` is its calibration.
    Interpolated bilinearly. Black where the photograph shows nothing, and where a polynomial model folds back."""
    if not lens.bends:
        return image
    x, y = _maps(lens, *image.shape[:2])
    return cv2.remap(image, x, y, cv2.INTER_LINEAR)  # type: ignore[return-value]


@functools.lru_cache(maxsize=_KEPT)
def _maps(lens: Lens, h: int, w: int) -> tuple[Singles, Singles]:
    """For every pixel (h, w) of the undistorted image where in the photograph it is; -2, which is outside, if nowhere.
    Where a step outwards no longer leads outwards, a polynomial has left its range: nothing is taken from there on."""
    grid = np.stack(np.meshgrid(np.arange(w, dtype=np.float64), np.arange(h, dtype=np.float64)), -1)
    there = lens.distort(grid)
    dx, dy = grid[..., 0] - lens.cx, grid[..., 1] - lens.cy
    if min(h, w) > 1:
        (x_y, x_x), (y_y, y_x) = np.gradient(there[..., 0]), np.gradient(there[..., 1])
        outwards = (x_x * dx + x_y * dy) * dx + (y_x * dx + y_y * dy) * dy
        radius = np.hypot(dx / lens.fx, dy / lens.fy)
        folded = ~(outwards > 0) & (radius > 0)
        there[radius >= np.min(radius[folded], initial=np.inf)] = -2
    x, y = np.ascontiguousarray(np.moveaxis(np.nan_to_num(there, nan=-2.0), -1, 0).astype(np.float32))
    return x, y
