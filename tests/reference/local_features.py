"""Detection, description and matching of features, one image, descriptor or centre at a time."""

import itertools
import math

import numpy as np
from scipy import ndimage
from scipy.spatial.distance import cdist


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian of 3 sigma half length, borders continued."""
    return ndimage.gaussian_filter(image, sigma, mode="nearest", radius=math.ceil(3 * sigma))


def hessian_determinant(image: np.ndarray) -> np.ndarray:
    """Of differences of neighbours; 0 at the border."""
    yy, xx = (ndimage.correlate1d(image, [1, -2, 1], axis) for axis in (0, 1))
    xy = ndimage.correlate1d(ndimage.correlate1d(image, [-0.5, 0, 0.5], 0), [-0.5, 0, 0.5], 1)
    return np.pad((xx * yy - xy**2)[1:-1, 1:-1], 1)


def hessian_keypoints(image: np.ndarray, threshold: float, levels: int = 3, sigma: float = 1.6) -> np.ndarray:
    """Rows (x, y, sigma, response) of an image in [0, 1], in no order, without the border's rule."""
    keypoints = []
    level = blur(image, math.sqrt(sigma**2 - 0.25))
    spacing = 1
    while min(level.shape) >= 16:
        blurs = [sigma * 2 ** (s / levels) for s in range(levels + 2)]
        stack = [level]
        for before, after in itertools.pairwise(blurs):
            stack.append(blur(stack[-1], math.sqrt(after**2 - before**2)))
        volume = np.stack([b**4 * hessian_determinant(layer) for b, layer in zip(blurs, stack, strict=True)])
        ended = {}
        for at in itertools.product(*(range(1, n - 1) for n in volume.shape)):
            if volume[at] > threshold and _is_maximum(volume, at):
                refined = _refine(volume, at)
                if refined is not None and refined[2] > threshold:
                    ended[refined[0]] = refined[1:]
        for where, (offset, value) in ended.items():
            s, y, x = np.array(where) + offset
            keypoints.append((spacing * x, spacing * y, spacing * sigma * 2 ** (s / levels), value))
        level = stack[levels][::2, ::2]
        spacing *= 2
    return np.array(keypoints).reshape(-1, 4)


def _is_maximum(volume: np.ndarray, at: tuple[int, ...]) -> bool:
    before = True
    for step in itertools.product((-1, 0, 1), repeat=3):
        if step == (0, 0, 0):
            before = False
            continue
        other = volume[tuple(a + d for a, d in zip(at, step, strict=True))]
        if other > volume[at] or (before and other == volume[at]):
            return False
    return True


def _refine(volume: np.ndarray, at: tuple[int, ...]) -> tuple[tuple[int, ...], np.ndarray, float] | None:
    for moves_left in range(4, -1, -1):
        gradient, hessian = np.zeros(3), np.zeros((3, 3))
        unit = np.eye(3, dtype=int)

        def value(step: np.ndarray, at: tuple[int, ...] = at) -> float:
            return float(volume[tuple(np.array(at) + step)])

        for i in range(3):
            gradient[i] = (value(unit[i]) - value(-unit[i])) / 2
            hessian[i, i] = value(unit[i]) - 2 * value(0 * unit[i]) + value(-unit[i])
            for j in range(i):
                plus, minus = unit[i] + unit[j], unit[i] - unit[j]
                hessian[i, j] = hessian[j, i] = (value(plus) - value(minus) - value(-minus) + value(-plus)) / 4
        if not (np.linalg.eigvalsh(hessian) < 0).all():
            return None
        offset = -np.linalg.solve(hessian, gradient)
        if (np.abs(offset) <= 0.6).all():
            return at, offset, value(np.zeros(3, int)) + float(gradient @ offset) / 2
        moved = tuple(int(v) for v in np.array(at) + np.clip(np.round(offset), -1, 1))
        if moves_left == 0 or any(not 1 <= m <= n - 2 for m, n in zip(moved, volume.shape, strict=True)):
            return None
        at = moved
    return None


def patch(image: np.ndarray, laf: np.ndarray, size: int = 32, blur_pixels: float = 0.6, dense: int = 6) -> np.ndarray:
    """What a camera whose pixels tile the frame sees: each pixel a Gaussian mean of dense samples of the image. The
    Gaussian has sigma `blur_pixels` of the patch's pixels; the image is interpolated linearly, borders continued."""
    reach = 3 * blur_pixels
    steps = np.arange(-reach, reach + 1e-9, 1 / dense)
    weight = np.exp(-0.5 * (steps / blur_pixels) ** 2)
    weight /= weight.sum()
    out = np.zeros((size, size))
    for i, j in itertools.product(range(size), repeat=2):
        u, v = np.meshgrid((2 * (j + steps) + 1) / size - 1, (2 * (i + steps) + 1) / size - 1)
        points = np.stack([u, v], -1) @ laf[:, :2].T + laf[:, 2]
        out[i, j] = weight @ ndimage.map_coordinates(image, points[..., ::-1].T, order=1, mode="nearest").T @ weight
    return out


def dominant_gradient(pixels: np.ndarray, bins: int = 36) -> float:
    """Direction of the dominant gradient, counter-clockwise on the screen."""
    size = len(pixels)
    gx, gy = (ndimage.sobel(pixels, axis, mode="nearest") / 8 for axis in (1, 0))
    histogram = np.zeros(bins)
    for i, j in itertools.product(range(size), repeat=2):
        window = math.exp(-((i - (size - 1) / 2) ** 2 + (j - (size - 1) / 2) ** 2) / (2 * (size / 6) ** 2))
        place = (math.atan2(-gy[i, j], gx[i, j]) % (2 * math.pi)) * bins / (2 * math.pi)
        low, vote = math.floor(place), window * math.hypot(gx[i, j], gy[i, j])
        histogram[low % bins] += vote * (1 - place + low)
        histogram[(low + 1) % bins] += vote * (place - low)
    smooth = ndimage.gaussian_filter1d(histogram, 1.6, mode="wrap", radius=2)
    k = int(np.argmax(smooth))
    left, middle, right = smooth[k - 1], smooth[k], smooth[(k + 1) % bins]
    return (k + 0.5 * (left - right) / (left + right - 2 * middle)) * 2 * math.pi / bins


def sift(pixels: np.ndarray, extent: float = 1.25, patch_blur: float = 0.75) -> np.ndarray:
    """SIFT of a 32 x 32 patch that covers `extent` frames of half side 6 keypoint sigmas."""
    size = len(pixels)
    keypoint = size / (2 * extent * 6)
    sigma = math.sqrt(keypoint**2 - patch_blur**2)
    x = np.arange(size)
    kernel = np.exp(-0.5 * ((x[:, None] - x) / sigma) ** 2)
    smooth = (kernel / kernel.sum(1, keepdims=True)) @ pixels @ (kernel / kernel.sum(1, keepdims=True)).T
    histogram = np.zeros((4, 4, 8))
    for i, j in itertools.product(range(size), repeat=2):
        gx = (smooth[i, j + 1] - smooth[i, j - 1]) / 2 if 0 < j < size - 1 else 0.0
        gy = (smooth[i + 1, j] - smooth[i - 1, j]) / 2 if 0 < i < size - 1 else 0.0
        u, v = ((k - (size - 1) / 2) / (3 * keypoint) for k in (j, i))
        vote = math.hypot(gx, gy) * math.exp(-(u * u + v * v) / 8)
        place = (math.atan2(-gy, gx) % (2 * math.pi)) * 8 / (2 * math.pi)
        for cy, cx, step in itertools.product(range(4), range(4), (0, 1)):
            direction = math.floor(place) + step
            share = max(1 - abs(v - cy + 1.5), 0) * max(1 - abs(u - cx + 1.5), 0) * (1 - abs(place - direction))
            histogram[cy, cx, direction % 8] += vote * share
    d = histogram.ravel()
    d = np.minimum(d / np.linalg.norm(d), 0.2)
    return d / np.linalg.norm(d)


def vlad(descriptors: np.ndarray, mean: np.ndarray, basis: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Residual sums of the nearest centres, each of unit length; signed square roots; unit length."""
    sums = np.zeros_like(centers)
    for descriptor in descriptors:
        x = (descriptor - mean) @ basis
        k = min(range(len(centers)), key=lambda k: float(np.sum((x - centers[k]) ** 2)))
        sums[k] += x - centers[k]
    for k in range(len(sums)):
        if np.any(sums[k]):
            sums[k] /= np.linalg.norm(sums[k])
    entries = np.array([np.sign(v) * np.sqrt(abs(v)) for v in sums.ravel()])
    norm = np.linalg.norm(entries)
    return entries / norm if norm else entries


def two_nearest(descriptors0: np.ndarray, descriptors1: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every descriptor of image 0: index of the nearest (lowest on ties), distance to it and to the second."""
    distances = cdist(descriptors0.astype(np.float64), descriptors1.astype(np.float64))
    ordered = np.sort(np.pad(distances, ((0, 0), (0, 2)), constant_values=np.inf))
    index = distances.argmin(1) if len(descriptors1) else np.full(len(descriptors0), -1)
    return index, ordered[:, 0], ordered[:, 1]


def ratio_test(descriptors0: np.ndarray, descriptors1: np.ndarray, threshold: float) -> np.ndarray:
    """Which descriptors of image 0 are clearly nearer to their nearest one than to any other."""
    _, first, second = two_nearest(descriptors0, descriptors1)
    return first < threshold * second


def mutual(descriptors0: np.ndarray, descriptors1: np.ndarray) -> np.ndarray:
    """Which descriptors of image 0 are the nearest ones of their nearest ones."""
    forward, backward = two_nearest(descriptors0, descriptors1)[0], two_nearest(descriptors1, descriptors0)[0]
    return backward[forward] == np.arange(len(forward))


def one_to_one(x0: np.ndarray, x1: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """A match is kept unless another at its location in either image is better: lower ratio, then lower index."""
    kept = []
    for i in range(len(x0)):
        rivals = np.flatnonzero((x0 == x0[i]).all(1) | (x1 == x1[i]).all(1))
        kept.append(all((ratio[i], i) <= (ratio[j], j) for j in rivals))
    return np.array(kept, bool)
