"""`RenderedPairs`: the embedded data set, drawn on first use from known cameras."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from fmtorch.core.resources import cache_dir
from fmtorch.data.candidates import AllPairs
from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.data.rendered.depth import depth_at
from fmtorch.data.rendered.generate import FAMILIES, PLANS, Plan, Progress, Task, digest, generate_all, read
from fmtorch.data.rendered.pinhole import Camera, fundamental, relative_pose
from fmtorch.data.scenes import Scene, ScenePairs, View


class RenderedPairs(Dataset[ImagePair]):
    """Image pairs of textured 3-D scenes with exact ground truth, in four families after the paper's four sets.

    split: "test" or "train"; they share no scene and no texture. size: "small" (about 20 pairs a family) or "full".
    families: some of "indoor", "driving", "orbit", "collection"; all four by default. seed: another seed, other scenes.
    root: the folder that keeps what was drawn, by default ``rendered`` in the cache folder.
    progress: called with (scenes done, scenes in all). workers: processes that draw, by default one a core.
    plan: replaces the amounts of `size`, for tests.

    A pair is kept if more than 20 SIFT matches (ratio 0.8) lie within 1 px of the true epipolar lines in both images,
    which is the paper's rule. Raises ValueError for an unknown split, size or family.
    """

    name = "rendered"

    def __init__(
        self,
        split: str = "test",
        size: str = "small",
        families: Sequence[str] | None = None,
        seed: int = 0,
        root: str | Path | None = None,
        *,
        progress: Progress | None = None,
        workers: int | None = None,
        plan: Plan | None = None,
    ) -> None:
        if (size, split) not in PLANS:
            raise ValueError(f"no split {split!r} in size {size!r}; there are test and train, in small and full")
        chosen = list(FAMILIES) if families is None else list(families)
        unknown = [family for family in chosen if family not in FAMILIES]
        if unknown or not chosen:
            raise ValueError(f"unknown families {unknown}; there are {', '.join(FAMILIES)}")
        plan = plan or PLANS[size, split]
        home = Path(root) if root is not None else cache_dir() / "rendered"
        digests = {family: digest(family, split, seed, plan) for family in chosen}
        self.digest = hashlib.sha256(" ".join(digests.values()).encode()).hexdigest()
        folders = {family: home / f"{family}-{split}-{size}-{digests[family][:16]}" for family in chosen}
        # Scenes of all families in turn, so that the first pictures of each are there early; the last of `FAMILIES`,
        # which takes longest, comes first, so that no worker is long alone at the end.
        tasks = [Task(family, split, n, seed, plan) for n in range(plan.scenes) for family in reversed(chosen)]
        for folder in folders.values():
            folder.mkdir(parents=True, exist_ok=True)
        generate_all([(task, folders[task.family]) for task in tasks], workers, progress)
        self._pairs: list[tuple[Task, int, int]] = []
        self._views: dict[str, list[tuple[Path, Camera]]] = {}
        self._tasks = {task.name: task for task in tasks}
        for task in sorted(tasks, key=lambda task: chosen.index(task.family)):
            self._views[task.name], pairs = read(folders[task.family] / task.name)
            self._pairs += [(task, i, j) for i, j in pairs]

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> ImagePair:
        task, i, j = self._pairs[index]
        (path0, camera0), (path1, camera1) = self._views[task.name][i], self._views[task.name][j]
        R, t = relative_pose(camera0, camera1)
        return ImagePair(
            identity=f"{self.name}/{task.name}/{i}-{j}",
            family=task.family,
            scene=task.name,
            image0=ImageSource(f"{task.name}/{i}", path0),
            image1=ImageSource(f"{task.name}/{j}", path1),
            F=fundamental(camera0, camera1),
            K0=camera0.K,
            K1=camera1.K,
            R=R,
            t=t,
        )

    def depth(self, image: ImageSource, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth (n,) in metres along the optical axis at points (n, 2) of an image; NaN for the sky and outside.

        The scene is built anew and its rays are cast, as when it was drawn; the last few images are remembered.
        Raises KeyError for an image of another data set.
        """
        scene, _, number = image.identity.rpartition("/")
        return depth_at(self._tasks[scene], int(number), points)

    def scene_pairs(self) -> RenderedScenePairs:
        """All pairs of the photographs of each scene, as candidates to select from."""
        scenes = []
        for name, views in self._views.items():
            drawn = [
                View(ImageSource(f"{name}/{i}", path, camera.size), camera.K, camera.R, camera.t, f"{name}/{path.name}")
                for i, (path, camera) in enumerate(views)
            ]
            scenes.append(Scene(name, self._tasks[name].family, drawn, AllPairs(len(drawn))))
        return RenderedScenePairs(self, scenes)

    def __iter__(self) -> Iterator[ImagePair]:
        return (self[index] for index in range(len(self)))


class RenderedScenePairs(ScenePairs):
    """All pairs of the photographs of rendered scenes; drawn: these scenes as a data set, which knows the depth."""

    def __init__(self, drawn: RenderedPairs, scenes: Sequence[Scene]) -> None:
        super().__init__("rendered", scenes, (), (drawn.digest,))
        self.drawn = drawn

    def depth(self, image: ImageSource, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """As `RenderedPairs.depth`."""
        return self.drawn.depth(image, points)
