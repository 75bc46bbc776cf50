"""Random views of a photograph: homographies that are nearly affine, and strong changes of light and of the camera."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Matrix = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class ViewRange:
    """How far views may go; each is drawn uniformly, ratios uniformly in their logarithm.

    tilt: largest ratio of the two scales (ASIFT's absolute tilt). scale: smallest and largest. rotation: degrees either
    way; any_rotation: share of views turned by any angle. perspective: largest change of scale across the image.
    """

    tilt: float = 3.0
    scale: tuple[float, float] = (0.5, 1.3)
    rotation: float = 30.0
    any_rotation: float = 0.25
    perspective: float = 0.3
    longest_side: int = 1024


def random_homography(
    rng: np.random.Generator, size: tuple[int, int], limits: ViewRange
) -> tuple[Matrix, tuple[int, int]]:
    """A homography from an image of this size (h, w) to a view of it, and the view's size."""
    h, w = size
    tilt = math.exp(rng.uniform(0, math.log(limits.tilt)))
    scale = math.exp(rng.uniform(math.log(limits.scale[0]), math.log(limits.scale[1])))
    turn = math.radians(rng.uniform(-180, 180) if rng.random() < limits.any_rotation else
                        rng.uniform(-limits.rotation, limits.rotation))  # fmt: skip
    axis = rng.uniform(0, math.pi)
    # The tilt shrinks one direction by its full amount, as a turned plane is foreshortened.
    A = _rotation(turn) @ _rotation(axis) @ np.diag([scale, scale / tilt]) @ _rotation(-axis)
    bend = rng.uniform(-limits.perspective, limits.perspective, 2) / np.array([w, h])
    H = np.eye(3)
    H[:2, :2] = A
    H[2, :2] = bend
    H = H @ _translation(-(w - 1) / 2, -(h - 1) / 2)
    corners = apply(H, np.array([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]], np.float64))
    low, high = corners.min(0), corners.max(0)
    shrink = min(1.0, limits.longest_side / (high - low).max())
    H = np.diag([shrink, shrink, 1.0]) @ _translation(-low[0], -low[1]) @ H
    out_w, out_h = np.maximum(np.round((high - low) * shrink), 32).astype(int)
    return H, (int(out_h), int(out_w))


def warp(image: Grey, H: Matrix, size: tuple[int, int]) -> Grey:
    """The view of an image under a homography, drawn finer and then reduced by areas where it shrinks the image."""
    h, w = size
    centre = np.array([[(image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2]])
    smallest = float(np.linalg.svd(local_affine(H, centre)[0], compute_uv=False)[-1])
    fine = int(np.clip(math.ceil(1 / smallest - 0.25), 1, 4))
    up = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1.0]])
    view = cv2.warpPerspective(
        image, up @ H, (w * fine, h * fine), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    )
    return view if fine == 1 else cv2.resize(view, (w, h), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def apply(H: Matrix, points: Matrix) -> Matrix:
    """Points (n, 2) under a homography."""
    mapped = np.c_[points, np.ones(len(points))] @ H.T
    return mapped[:, :2] / mapped[:, 2:]  # type: ignore[no-any-return]


def local_affine(H: Matrix, points: Matrix) -> Matrix:
    """The derivative (n, 2, 2) of a homography at points (n, 2)."""
    mapped = np.c_[points, np.ones(len(points))] @ H.T
    out = mapped[:, :2] / mapped[:, 2:]
    return (H[None, :2, :2] - out[:, :, None] * H[None, None, 2, :2]) / mapped[:, 2, None, None]  # type: ignore[no-any-return]


def grey_of(rng: np.random.Generator, image: NDArray[np.uint8]) -> Grey:
    """A grey image of an RGB one with random weights of the channels, as under light of another colour."""
    if image.ndim == 2:
        return image
    weights = rng.dirichlet([3.0, 5.0, 2.0])
    return np.clip(image @ weights, 0, 255).astype(np.uint8)


def change_light(rng: np.random.Generator, image: Grey) -> Grey:
    """Gamma, contrast, brightness and soft shadows, at random."""
    x = image.astype(np.float32) / 255
    x = x ** np.float32(math.exp(rng.uniform(-0.5, 0.5)))
    if rng.random() < 0.6:
        coarse = rng.normal(0, rng.uniform(0.1, 0.4), (int(rng.integers(2, 6)), int(rng.integers(2, 6))))
        field = cv2.resize(coarse.astype(np.float32), image.shape[::-1], interpolation=cv2.INTER_CUBIC)
        x = x * np.exp(field)
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
        noise = rng.normal(0, rng.uniform(1, 9), image.shape)
        image = np.clip(image + noise, 0, 255).round().astype(np.uint8)
    if rng.random() < 0.6:
        _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 95))])
        image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)
    return image


def _rotation(angle: float) -> Matrix:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def _translation(x: float, y: float) -> Matrix:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])
