"""Matches that other programs stored for the pairs of a data set: hloc's, glue-factory's and vismatch's files."""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fmtorch.core.types import Correspondences
from fmtorch.data import DataError, GivenMatches, ImagePair, ImageSource, PairDataset, stored_size
from fmtorch.data.files import Indices, Mask, Matrix
from fmtorch.data.pairs import Camera, fundamental
from fmtorch.io import h5

Size = tuple[int, int]  # (h, w)
Images = tuple[ImageSource, ImageSource]
MAX_OFF_CENTRE = 0.1  # of a principal point, in units of the side: those of reduced images are farther off


def given(
    x0: Matrix, x1: Matrix, sizes: tuple[Size, Size], features: tuple[int, int], *, ratio: Matrix | None = None,
    score: Matrix | None = None, mutual: Mask | None = None,
) -> GivenMatches:  # fmt: skip
    """Matches of one pair, (n, 2) in pixels each; those that are not finite do not count.
    ratio, score, mutual: (n,), as of `Correspondences`. features: how many keypoints each image has."""
    mask = torch.from_numpy(np.isfinite(x0).all(-1) & np.isfinite(x1).all(-1))[None]
    points = (torch.from_numpy(np.ascontiguousarray(x, np.float32))[None] for x in (x0, x1))
    p0, p1 = (torch.where(mask[..., None], x, 0.0) for x in points)
    size0, size1 = (torch.tensor([size]) for size in sizes)
    known = {"ratio": _figure(ratio), "score": _figure(score), "size0": size0, "size1": size1}
    both = None if mutual is None else torch.from_numpy(mutual)[None] & mask
    return GivenMatches(Correspondences(p0, p1, mask, mutual=both, **known), features)


def _figure(values: Matrix | None) -> torch.Tensor | None:
    return None if values is None else torch.from_numpy(values.astype(np.float32))[None]


def with_cameras(pair: ImagePair, K0: Matrix, K1: Matrix, R: Matrix, t: Matrix) -> ImagePair:
    """The pair with its cameras, ``X1 = R X0 + t``, and their F; with a problem where they leave none."""
    pair = dataclasses.replace(pair, K0=K0, K1=K1, R=R, t=t)
    if np.linalg.det(K0) == 0 or np.linalg.det(K1) == 0:
        return dataclasses.replace(pair, problem="a calibration matrix is singular")
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2:
        return dataclasses.replace(pair, problem="R is no rotation")
    if not t.any():
        return dataclasses.replace(pair, problem="the cameras did not move apart (t is zero), which leaves no F")
    return dataclasses.replace(pair, F=fundamental(Camera(K0, np.eye(3), np.zeros(3)), Camera(K1, R, t)))


def image(family: str, scene: str, name: str, folder: Path | None) -> ImageSource:
    """An image of which only the name is known, in a folder, or its sub-folder of the scene, where one is given."""
    path = Path(name)
    if folder is not None:
        path = folder / scene / name if (folder / scene).is_dir() else folder / name
    return ImageSource(f"{family}/{scene}/{name}", path)


def size_by_file(source: ImageSource, K: Matrix) -> Size | None:
    """(h, w) of an image by its file, None where there is none.
    Raises DataError where it contradicts the image's camera: a copy that was reduced or cropped."""
    if (size := stored_size(source.path)) is None:
        return None
    h, w = size
    if max(abs(K[0, 2] / w - 0.5), abs(K[1, 2] / h - 0.5)) > MAX_OFF_CENTRE:
        centre = f"its camera's principal point is ({K[0, 2]:g}, {K[1, 2]:g})"
        wanted = "the image as it was when its camera was determined"
        raise DataError(f"{source.path}: {w} x {h} px, but {centre}; it must be {wanted}")
    return size


def size_by_points(K: Matrix, x: Matrix) -> Size:
    """(h, w) of an image of unknown size: its principal point is the centre, and it holds all of the points (n, 2)."""
    bound = x[np.isfinite(x).all(-1)].max(0, initial=0.0)
    width, height = (max(2 * float(c) + 1, np.ceil(b) + 1) for c, b in zip(K[:2, 2], bound, strict=True))
    return round(height), round(width)


def size_by_centre(K: Matrix) -> Size:
    """(h, w) of an image whose principal point is its centre: the best guess where nothing else tells it."""
    width, height = 2 * K[0, 2] + 1, 2 * K[1, 2] + 1
    if not (np.isfinite(width) and np.isfinite(height) and width >= 2 and height >= 2):
        raise DataError("the image sizes are unknown, and the principal point is no centre of an image; give images")
    return round(height), round(width)


# Which stored image or pair is which of a data set: others name images by their path, or by its end

DEPTH = 4  # parts of a path that a name may hold


def names_of(image: ImageSource) -> list[str]:
    """Under what names others may know an image, the most telling first.
    Its identity, then ever shorter ends of its path; each with the suffix and without."""
    suffix = image.path.suffix
    ends = ["/".join(image.path.parts[-n:]) for n in range(min(DEPTH, len(image.path.parts)), 0, -1)]
    names = [name for end in ends for name in (end, end.removesuffix(suffix))]
    return list(dict.fromkeys([image.identity + suffix, image.identity, *names]))


def pair_keys(pair: ImagePair) -> Iterator[tuple[str, bool]]:
    """Under what keys others may have stored a pair, and whether its images are then in the other order.
    ``a/b``, as hloc and glue-factory write it with hyphens for slashes within names, and ``a_b``."""
    names0, names1 = names_of(pair.image0), names_of(pair.image1)
    for swapped, names in ((False, (names0, names1)), (True, (names1, names0))):
        for a, b in zip(*names, strict=False):
            yield from ((key, swapped) for key in hloc_keys(a, b))


def hloc_keys(name0: str, name1: str) -> Iterator[str]:
    """hloc's key of a pair of images of these names, in this order, and that of older versions."""
    a, b = name0.replace("/", "-"), name1.replace("/", "-")
    yield f"{a}/{b}"
    yield f"{a}_{b}"


NO_MATCH = -1


def hloc_matches(
    features: Path, matches: Path, origin: float, images: Images, names: tuple[str, str], key: str, swapped: bool
) -> GivenMatches:
    """hloc's matches of one pair: ``matches0`` and ``matching_scores0`` (n0,) for the keypoints of the first image.
    origin: where it puts the first pixel's centre. images: for sizes where the features file does not hold them. names:
    of the images in the features file. key: of the pair in the matches file; swapped: its first image is our second."""
    with h5.opened(features) as file:
        points = [_keypoints(file, name) - origin for name in names]
        size0, size1 = (_size(file, f"{n}/image_size", image) for n, image in zip(names, images, strict=True))
    with h5.opened(matches) as file:
        counts = [len(p) for p in (reversed(points) if swapped else points)]
        i, j, score = read_matches(file[key], counts)
    x0, x1 = (p[k] for p, k in zip(points, (j, i) if swapped else (i, j), strict=True))
    return given(x0, x1, (size0, size1), (len(points[0]), len(points[1])), score=score)


def predicted_matches(path: Path, origin: float, images: Images, key: str, swapped: bool) -> GivenMatches:
    """glue-factory's or vismatch's prediction for one pair, a group that holds all of it.
    Either ``keypoints0``, ``keypoints1``, ``matches0`` and perhaps ``matching_scores0``, or ``matched_kpts0``,
    ``matched_kpts1`` and perhaps ``matched_confidences``, ``all_kpts0``, ``all_kpts1``."""
    with h5.opened(path) as file:
        group = file[key]
        x, counts, score = (_indexed if h5.holds(group, "matches0") else _matched)(group)
        suffixes = ("1", "0") if swapped else ("0", "1")
        sizes = [_size(group, f"image_size{s}", image) for s, image in zip(suffixes, images, strict=True)]
    order = (1, 0) if swapped else (0, 1)
    x0, x1 = (x[k] - origin for k in order)
    return given(x0, x1, (sizes[0], sizes[1]), (counts[order[0]], counts[order[1]]), score=score)


def _indexed(group: Any) -> tuple[list[Matrix], list[int], Matrix | None]:
    points = [h5.numbers(group, f"keypoints{k}", None, 2) for k in (0, 1)]
    counts = [len(p) for p in points]
    i, j, score = read_matches(group, counts)
    return [points[0][i], points[1][j]], counts, score


def _matched(group: Any) -> tuple[list[Matrix], list[int], Matrix | None]:
    x = [h5.numbers(group, f"matched_kpts{k}", None, 2) for k in (0, 1)]
    counts = [len(p) for p in x]
    if counts[0] != counts[1]:
        lengths = f"{counts[0]} points in matched_kpts0 and {counts[1]} in matched_kpts1"
        raise DataError(f"{h5.where(group)} has {lengths}")
    score = h5.numbers(group, "matched_confidences", counts[0]) if h5.holds(group, "matched_confidences") else None
    for k in (0, 1):
        if h5.holds(group, f"all_kpts{k}"):
            counts[k] = len(h5.array(group, f"all_kpts{k}", None, 2))
    return x, counts, score


def hloc_pairs(truth: PairDataset, features: Path, matches: Path, origin: float) -> Iterator[ImagePair]:
    """The pairs of a data set with hloc's matches of them; a pair without has a problem."""
    with h5.opened(features) as f, h5.opened(matches) as m:
        names: dict[str, str | None] = {}
        for pair in truth:
            images = pair.image0, pair.image1
            for image in images:
                if image.identity not in names:
                    names[image.identity] = next((n for n in names_of(image) if h5.holds(f, f"{n}/keypoints")), None)
            known = [names[image.identity] for image in images]
            missing = [image for image, name in zip(images, known, strict=True) if name is None]
            if missing:
                yield _without(pair, f"{features}: no keypoints of image {missing[0].identity}")
                continue
            name0, name1 = (str(name) for name in known)
            orders = (name0, name1, False), (name1, name0, True)
            keys = ((key, swapped) for a, b, swapped in orders for key in hloc_keys(a, b))
            key_and_swap = next(((key, swapped) for key, swapped in keys if h5.holds(m, f"{key}/matches0")), None)
            if key_and_swap is None:
                yield _without(pair, f"{matches}: no matches0 of the pair {name0}, {name1}")
                continue
            given_by = features, matches, origin, images, (name0, name1), *key_and_swap
            yield dataclasses.replace(pair, matches=functools.partial(hloc_matches, *given_by))
    _expect_distinct(names, features)


def predicted_pairs(truth: PairDataset, path: Path, origin: float) -> Iterator[ImagePair]:
    """The pairs of a data set with predictions for them; a pair without has a problem."""
    with h5.opened(path) as file:
        stored = set(h5.groups_with(file, "matches0", "matched_kpts0"))
        if not stored:
            raise DataError(f"{path}: holds no group with matches0 or matched_kpts0")
    for pair in truth:
        images = pair.image0, pair.image1
        for key, swapped in (*pair_keys(pair), (pair.identity, False)):
            if key in stored:
                matches = functools.partial(predicted_matches, path, origin, images, key, swapped)
                yield dataclasses.replace(pair, matches=matches)
                break
        else:
            yield _without(pair, f"{path}: no prediction for the pair {pair.identity}")


def _without(pair: ImagePair, problem: str) -> ImagePair:
    return pair if pair.problem else dataclasses.replace(pair, problem=problem)


def _expect_distinct(names: dict[str, str | None], path: Path) -> None:
    seen: dict[str, str] = {}
    for identity, name in names.items():
        if name is not None and seen.setdefault(name, identity) != identity:
            both = f"{path}: {name!r} could be image {seen[name]} or {identity}"
            raise DataError(f"{both}; names must tell images apart, such as by their folder")


def read_matches(group: Any, counts: Sequence[int]) -> tuple[Indices, Indices, Matrix | None]:
    """The keypoints of both images that the ``matches0`` of a group matches, and their ``matching_scores0``, if any.
    counts: of keypoints. Raises DataError for what cannot be of so many."""
    where, stored = h5.where(group, "matches0"), h5.array(group, "matches0", None)
    if stored.dtype.kind not in "iu":
        raise DataError(f"{where} is of {stored.dtype}; it must hold whole numbers")
    scored, chosen = h5.holds(group, "matching_scores0"), stored.astype(np.int64)
    scores = h5.numbers(group, "matching_scores0", len(chosen)) if scored else None
    if len(chosen) != counts[0]:
        raise DataError(f"{where} has {len(chosen)} entries, but the first image has {counts[0]} keypoints")
    if len(chosen) and chosen.min() < NO_MATCH:
        raise DataError(f"{where} holds {chosen.min()}: indices beyond 32767 overflow as 16-bit integers; write int32")
    if len(chosen) and chosen.max() >= counts[1]:
        raise DataError(f"{where} names keypoint {chosen.max()}, but the second image has {counts[1]}")
    i = np.flatnonzero(chosen != NO_MATCH)
    return i, chosen[i], None if scores is None else scores[i]


def _keypoints(file: Any, name: str) -> Matrix:
    points = h5.numbers(file, f"{name}/keypoints", None, None)
    if points.shape[1] < 2:
        where = h5.where(file, f"{name}/keypoints")
        raise DataError(f"{where} has shape {points.shape}; it must be (n, 2) or wider")
    return points[:, :2]


def size_under(file: Any, key: str) -> Size:
    """(h, w) of a width and height under a key. Raises DataError where they are those of no image."""
    width, height = h5.reshaped(file, key, 2)
    if min(width, height) < 1:
        raise DataError(
            f"{h5.where(file, key)} is {width:g} x {height:g}; it must be the width and height of the image"
        )
    return int(height), int(width)


def _size(file: Any, key: str, image: ImageSource) -> Size:
    if h5.holds(file, key):
        return size_under(file, key)
    size = stored_size(image.path)
    if size is None:
        raise DataError(f"{file.file.filename}: {key!r} is missing, and image {image.path} cannot be read either")
    return size
