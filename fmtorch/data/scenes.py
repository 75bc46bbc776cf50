"""Scenes of images with known cameras, and the data set of pairs of them; what every native reader gives."""

from __future__ import annotations

import bisect
import dataclasses
import hashlib
import itertools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.cameras import Matrix, fundamental, relative_pose, share_centre
from fmtorch.data.candidates import Candidates, drawn
from fmtorch.data.depth_images import DepthImages
from fmtorch.data.pairs import ImagePair, ImageSource, PairDataset
from fmtorch.data.text_files import DataError


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """One image with its camera: K (3, 3), R (3, 3) and t (3,) map the world to pixels of the undistorted image.

    place: the file and line, or the record, that names the image; messages begin with it.
    """

    image: ImageSource
    K: Matrix
    R: Matrix
    t: Matrix
    place: str

    @property
    def problem(self) -> str:
        """Why it cannot be used; empty where the image is there."""
        return "" if self.image.path.is_file() else f"{self.place}: no image {self.image.path}"


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """The views of one sequence or collection, in a fixed order, and which pairs of them may be looked at."""

    name: str
    family: str
    views: Sequence[View]
    candidates: Candidates


class ScenePairs(PairDataset):
    """Pairs of the views of scenes: some of all candidates, drawn by a seed.

    name: of the data set. scenes: read from disk. sources: what defines the cameras, by a name that holds no path.
    options: what else defines them, such as the window of a video.
    pairs: how many, drawn at random from the candidates of all scenes; None: all. seed: of that draw.

    points: of each scene a function that reads which points of its reconstruction each view sees, by their numbers;
    None where there is no reconstruction.

    A pair whose image is missing, or whose two cameras are at one place, has a `problem`. Which pairs can be matched
    at all is not asked here (`fmtorch pairs`).
    """

    points: Sequence[Callable[[], Sequence[NDArray[np.int64]]]] | None = None

    def __init__(
        self,
        name: str,
        scenes: Sequence[Scene],
        sources: Iterable[tuple[str, Path]],
        options: Sequence[object] = (),
        pairs: int | None = None,
        seed: int = 0,
    ) -> None:
        self.name, self.scenes = name, list(scenes)
        self._starts = [0, *itertools.accumulate(len(scene.candidates) for scene in self.scenes)]
        self._ranks = drawn(self._starts[-1], pairs, seed)
        self.cameras_digest = _digest([(s.family, s.name, len(s.candidates)) for s in self.scenes], options, sources)
        self.digest = hashlib.blake2b(f"{self.cameras_digest} {pairs} {seed}".encode(), digest_size=16).hexdigest()

    def __len__(self) -> int:
        return len(self._ranks)

    def __getitem__(self, index: int) -> ImagePair:
        scene, i, j = self.candidate(int(self._ranks[index]))
        return image_pair(self.scenes[scene], i, j)

    @property
    def candidates(self) -> int:
        """How many candidates the scenes have."""
        return self._starts[-1]

    def candidate(self, rank: int) -> tuple[int, int, int]:
        """The candidate at a place among those of all scenes: number of the scene, and of its two views."""
        scene = bisect.bisect_right(self._starts, rank) - 1
        ((i, j),) = self.scenes[scene].candidates.at(np.array([rank - self._starts[scene]]))
        return scene, int(i), int(j)


class DepthScenePairs(ScenePairs):
    """The same where the views have depth images."""

    depth_images: DepthImages

    def depth(self, image: ImageSource, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth (n,) along the optical axis at points (n, 2) of an image, in the unit of t; NaN where unknown."""
        return self.depth_images.at(image, points)


def image_pair(scene: Scene, i: int, j: int) -> ImagePair:
    """Views i and j of a scene as a pair; F is zero, with a `problem`, where the two cameras are at one place."""
    a, b = scene.views[i], scene.views[j]
    problems = [problem for problem in (a.problem, b.problem) if problem]
    if share_centre(a, b):
        F = np.zeros((3, 3))
        problems.append(f"{a.place} and {b.place}: both cameras are at one place, hence there is no F")
    else:
        F = fundamental(a, b)
    R, t = relative_pose(a, b)
    return ImagePair(
        identity=f"{scene.family}/{scene.name}/{i}-{j}",
        family=scene.family,
        scene=scene.name,
        image0=a.image,
        image1=b.image,
        F=F,
        K0=a.K,
        K1=b.K,
        R=R,
        t=t,
        problem="; ".join(problems) or None,
    )


def folders(root: Path, wanted: Sequence[str], what: str) -> list[Path]:
    """The folders of these names below `root`. Raises DataError naming the first that is missing, and those there."""
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; it must hold {what}")
    for name in wanted:
        if not (root / name).is_dir():
            there = ", ".join(sorted(f.name for f in root.iterdir() if f.is_dir())) or "none"
            raise DataError(f"{root}: no sequence {name!r}; there are: {there}. dataset.sequences=[...] takes others")
    return [root / name for name in wanted]


def _digest(scenes: object, options: Sequence[object], sources: Iterable[tuple[str, Path]]) -> str:
    digest = hashlib.blake2b(repr((scenes, list(options))).encode(), digest_size=16)
    for name, path in sources:
        with path.open("rb") as file:
            digest.update(f"{name}:{path.stat().st_size}:".encode() + hashlib.file_digest(file, "blake2b").digest())
    return digest.hexdigest()
