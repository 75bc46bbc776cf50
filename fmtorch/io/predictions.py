"""Which stored image or pair is which of a data set: others name images by their path, or by its end."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.images import stored_size
from fmtorch.data.pairs import GivenMatches, ImagePair, ImageSource, PairDataset
from fmtorch.data.text_files import DataError
from fmtorch.io import h5
from fmtorch.io.given import Array, Size, given

DEPTH = 4  # parts of a path that a name may hold


def names_of(image: ImageSource) -> list[str]:
    """Under what names others may know an image, the most telling first.

    Its identity, then ever shorter ends of its path; each with the suffix and without.
    """
    suffix = image.path.suffix
    ends = ["/".join(image.path.parts[-n:]) for n in range(min(DEPTH, len(image.path.parts)), 0, -1)]
    names = [name for end in ends for name in (end, end.removesuffix(suffix))]
    return list(dict.fromkeys([image.identity + suffix, image.identity, *names]))


def pair_keys(pair: ImagePair) -> Iterator[tuple[str, bool]]:
    """Under what keys others may have stored a pair, and whether its images are then in the other order.

    ``a/b``, as hloc and glue-factory write it with hyphens for slashes within names, and ``a_b``.
    """
    for swapped in (False, True):
        image, other = (pair.image1, pair.image0) if swapped else (pair.image0, pair.image1)
        for a, b in zip(names_of(image), names_of(other), strict=False):
            for key in _keys(a, b):
                yield key, swapped


def hloc_keys(name0: str, name1: str) -> Iterator[tuple[str, bool]]:
    """The keys of hloc's matches of two images of these names, and whether the images are in the other order."""
    for swapped, (a, b) in ((False, (name0, name1)), (True, (name1, name0))):
        for key in _keys(a, b):
            yield key, swapped


def pair_key_of(name0: str, name1: str) -> str:
    """hloc's key of a pair."""
    return next(_keys(name0, name1))


def _keys(name0: str, name1: str) -> Iterator[str]:
    a, b = name0.replace("/", "-"), name1.replace("/", "-")
    yield f"{a}/{b}"
    yield f"{a}_{b}"


# Predictions for the pairs of a data set: hloc's features and matches, glue-factory's and vismatch's predictions


NO_MATCH = -1


@dataclasses.dataclass(frozen=True)
class HLocMatches:
    """hloc's matches of one pair: ``matches0`` and ``matching_scores0`` (n0,) for the keypoints of the first image.

    names: of the images in the features file. key: of the pair in the matches file; swapped: whether its first image
    is our second. sizes: where the features file does not hold them. origin: where it puts the first pixel's centre.
    """

    features: Path
    matches: Path
    names: tuple[str, str]
    key: str
    swapped: bool
    images: tuple[ImageSource, ImageSource]
    origin: float

    def __call__(self) -> GivenMatches:
        """Read them. Raises DataError naming file and key."""
        with h5.opened(self.features) as file:
            points = [_keypoints(file, self.features, name) - self.origin for name in self.names]
            sizes = tuple(
                _size(file, f"{name}/image_size", image) for name, image in zip(self.names, self.images, strict=True)
            )
        with h5.opened(self.matches) as file:
            chosen, scores = _read_indices(file, self.matches, self.key)
        order = (1, 0) if self.swapped else (0, 1)
        i, j = _indices(chosen, [len(points[k]) for k in order], f"{self.matches}: {self.key + '/matches0'!r}")
        index = (j, i) if self.swapped else (i, j)
        score = None if scores is None else scores[i]
        return given(
            points[0][index[0]],
            points[1][index[1]],
            (sizes[0], sizes[1]),
            (len(points[0]), len(points[1])),
            score=score,
        )


@dataclasses.dataclass(frozen=True)
class PairPrediction:
    """glue-factory's or vismatch's prediction for one pair, a group that holds all of it.

    Either ``keypoints0``, ``keypoints1``, ``matches0`` and perhaps ``matching_scores0``, or ``matched_kpts0``,
    ``matched_kpts1`` and perhaps ``matched_confidences``, ``all_kpts0``, ``all_kpts1``.
    """

    path: Path
    key: str
    swapped: bool
    images: tuple[ImageSource, ImageSource]
    origin: float

    def __call__(self) -> GivenMatches:
        """Read them. Raises DataError naming file and key."""
        with h5.opened(self.path) as file:
            group = file[self.key]
            if h5.holds(group, "matches0"):
                x, counts, score = self._indexed(group)
            else:
                x, counts, score = self._matched(group)
            suffixes = ("1", "0") if self.swapped else ("0", "1")
            sizes = [_size(group, f"image_size{s}", image) for s, image in zip(suffixes, self.images, strict=True)]
        order = (1, 0) if self.swapped else (0, 1)
        x0, x1 = (x[k] - self.origin for k in order)
        return given(x0, x1, (sizes[0], sizes[1]), (counts[order[0]], counts[order[1]]), score=score)

    def _indexed(self, group: Any) -> tuple[list[Array], list[int], Array | None]:
        points = [h5.numbers(group, f"keypoints{k}", None, 2) for k in (0, 1)]
        chosen, scores = _read_indices(group, self.path, "")
        counts = [len(p) for p in points]
        i, j = _indices(chosen, counts, f"{self.path}: {self.key + '/matches0'!r}")
        return [points[0][i], points[1][j]], counts, None if scores is None else scores[i]

    def _matched(self, group: Any) -> tuple[list[Array], list[int], Array | None]:
        x = [h5.numbers(group, f"matched_kpts{k}", None, 2) for k in (0, 1)]
        if len(x[0]) != len(x[1]):
            raise DataError(
                f"{self.path}: {self.key!r} has {len(x[0])} points in matched_kpts0 and {len(x[1])} in matched_kpts1"
            )
        score = None
        if h5.holds(group, "matched_confidences"):
            score = h5.numbers(group, "matched_confidences", len(x[0]))
        counts = [len(p) for p in x]
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
            key_and_swap = next(((k, s) for k, s in hloc_keys(name0, name1) if h5.holds(m, f"{k}/matches0")), None)
            if key_and_swap is None:
                yield _without(pair, f"{matches}: no matches0 of the pair {name0}, {name1}")
                continue
            stored = HLocMatches(features, matches, (name0, name1), *key_and_swap, images, origin)
            yield dataclasses.replace(pair, matches=stored)
    _expect_distinct(names, features)


def predicted_pairs(truth: PairDataset, path: Path, origin: float) -> Iterator[ImagePair]:
    """The pairs of a data set with predictions for them; a pair without has a problem."""
    with h5.opened(path) as file:
        stored = set(_groups(file))
    for pair in truth:
        images = pair.image0, pair.image1
        for key, swapped in (*pair_keys(pair), (pair.identity, False)):
            if key in stored:
                yield dataclasses.replace(pair, matches=PairPrediction(path, key, swapped, images, origin))
                break
        else:
            yield _without(pair, f"{path}: no prediction for the pair {pair.identity}")


def _without(pair: ImagePair, problem: str) -> ImagePair:
    return pair if pair.problem else dataclasses.replace(pair, problem=problem)


def _expect_distinct(names: dict[str, str | None], path: Path) -> None:
    """Raises DataError where one stored image would stand for two of the data set."""
    seen: dict[str, str] = {}
    for identity, name in names.items():
        if name is not None and seen.setdefault(name, identity) != identity:
            raise DataError(
                f"{path}: {name!r} could be image {seen[name]} or {identity}; names must tell images apart, "
                "such as by their folder"
            )


def _groups(file: Any) -> list[str]:
    """The paths of the groups that hold a prediction."""
    groups: list[str] = []

    def visit(name: str) -> None:
        head, _, last = name.rpartition("/")
        if last in ("matches0", "matched_kpts0") and head:
            groups.append(head)

    try:
        file.visit(visit)
    except (OSError, RuntimeError) as error:
        raise DataError(f"{file.filename}: its keys cannot be read ({str(error).splitlines()[0]})") from error
    if not groups:
        raise DataError(f"{file.filename}: holds no group with matches0 or matched_kpts0")
    return groups


def _read_indices(file: Any, path: Path, key: str) -> tuple[NDArray[np.int64], Array | None]:
    """``matches0`` and, where there are any, ``matching_scores0`` of a group."""
    prefix = f"{key}/" if key else ""
    chosen = h5.array(file, f"{prefix}matches0", None)
    if chosen.dtype.kind not in "iu":
        raise DataError(f"{path}: {prefix + 'matches0'!r} is of {chosen.dtype}; it must hold whole numbers")
    scores = None
    if h5.holds(file, f"{prefix}matching_scores0"):
        scores = h5.numbers(file, f"{prefix}matching_scores0", len(chosen))
    return chosen.astype(np.int64), scores


def _indices(chosen: NDArray[np.int64], counts: list[int], where: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The matched keypoints of both images. Raises DataError where the indices cannot be those of the keypoints."""
    if len(chosen) != counts[0]:
        raise DataError(f"{where} has {len(chosen)} entries, but the first image has {counts[0]} keypoints")
    if len(chosen) and chosen.min() < NO_MATCH:
        raise DataError(f"{where} holds {chosen.min()}: indices beyond 32767 overflow as 16-bit integers; write int32")
    if len(chosen) and chosen.max() >= counts[1]:
        raise DataError(f"{where} names keypoint {chosen.max()}, but the second image has {counts[1]}")
    i = np.flatnonzero(chosen != NO_MATCH)
    return i, chosen[i]


def _keypoints(file: Any, path: Path, name: str) -> Array:
    """x and y of an image's keypoints, which may come with scales. Raises DataError for fewer columns."""
    points = h5.numbers(file, f"{name}/keypoints", None, None)
    if points.shape[1] < 2:
        raise DataError(f"{path}: {name + '/keypoints'!r} has shape {points.shape}; it must be (n, 2) or wider")
    return points[:, :2]


def _size(file: Any, key: str, image: ImageSource) -> Size:
    """(h, w) as stored, (w, h), or of the image itself."""
    if h5.holds(file, key):
        width, height = h5.reshaped(file, key, 2)
        return int(height), int(width)
    size = stored_size(image.path)
    if size is None:
        raise DataError(f"{file.file.filename}: {key!r} is missing, and image {image.path} cannot be read either")
    return size
