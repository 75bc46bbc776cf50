"""The embedded data sets: `RenderedPairs`, drawn on first use from known cameras, and `StereoPair`, a real pair.

Every scene is a function of (version, seed, split, family, number) alone and is written to a temporary folder that is
renamed when complete, so that an interrupted generation goes on where it stopped and two processes never clash."""

import dataclasses
import functools
import hashlib
import itertools
import json
import os
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fmtorch.core.files import cache_dir, temporary_name
from fmtorch.data.construction import Keypoints, keypoints, matchable
from fmtorch.data.pairs import HeldPairs, ImagePair, ImageSource
from fmtorch.data.scenes import AllPairs, Scene, ScenePairs, View
from fmtorch.jit.kernel import compile_together
from fmtorch.jobs.execution import Execution, cores
from fmtorch.jobs.runner import MAX_PROCESSES, Local, TaskRunner, WorkerPool
from fmtorch.scenes import landmarks, videos
from fmtorch.scenes.light import DrawnScene, Shot, Stage, expose, footprints, group_by_texture, shade
from fmtorch.scenes.raycast import Camera, Geometry, Matrix, calibration, cast_pieces, fundamental, relative_pose
from fmtorch.scenes.surfaces import Pixels, skimage_file

VERSION = 3  # of the generator: raised by every change that changes a picture or a pair
FAMILIES = {
    "indoor": videos.indoor_scene,
    "driving": videos.driving_scene,
    "orbit": landmarks.orbit_scene,
    "collection": landmarks.collection_scene,
}
SPLITS = ("test", "train")
RECORD = Path(__file__).with_name("pairs.json")
Progress = Callable[[int, int], None]

KERNELS = (cast_pieces, shade, footprints, group_by_texture)  # that drawing calls, slowest first


@dataclasses.dataclass(frozen=True)
class Plan:
    """How much of a family is drawn: scenes, photographs a scene, pairs a scene, and the images' scale.
    spare: photographs that are drawn too, one at a time, as long as a scene has fewer matchable pairs than wanted."""

    scenes: int
    shots: int
    pairs: int
    scale: float = 1.0
    spare: int = 0


PLANS = {
    **{("small", split): Plan(5, 4, 4, spare=6) for split in SPLITS},
    **{("full", split): Plan(scenes, 14, 25, spare=6) for split, scenes in zip(SPLITS, (8, 32), strict=True)},
}


@dataclasses.dataclass(frozen=True)
class Task:
    """One scene to draw."""

    family: str
    split: str
    number: int
    seed: int
    plan: Plan

    @property
    def name(self) -> str:
        return f"{self.family}-{self.split}-{self.number:03d}"


def digest(family: str, split: str, seed: int, plan: Plan) -> str:
    """What defines a family's pictures and pairs, as 64 hex digits.
    OpenCV's release is part of it: it draws the letters on signs and finds the keypoints that choose the pairs."""
    parts = [VERSION, ".".join(cv2.__version__.split(".")[:2]), family, split, seed, dataclasses.asdict(plan)]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


@functools.cache
def recorded_pairs() -> dict[str, dict[str, dict[str, Any]]]:
    """What the rule for pairs has decided: by digest and scene the number of photographs and the pairs.
    Judged once by ``scripts/record_rendered_pairs.py``, and anew with another version of the generator or of OpenCV."""
    return json.loads(RECORD.read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def seeds(task: Task) -> np.random.SeedSequence:
    """The random stream of one scene; no two scenes, families or splits share one."""
    place = [VERSION, task.seed, SPLITS.index(task.split), list(FAMILIES).index(task.family), task.number]
    return np.random.SeedSequence(place)


def build(task: Task) -> DrawnScene:
    """A scene's surfaces, lights and shots, before anything is drawn."""
    rng = np.random.default_rng(seeds(task))
    return FAMILIES[task.family](rng, task.split, task.plan.shots + task.plan.spare, task.plan.scale)


def draw(scene: DrawnScene, seed: np.random.SeedSequence) -> Iterator[Pixels]:
    """The photographs of a scene, RGB or grey, each drawn when it is asked for."""
    stages: dict[int, Stage] = {}
    for shot, noise in zip(scene.shots, seed.spawn(len(scene.shots)), strict=True):
        if shot.light not in stages:
            surfaces = scene.surfaces[shot.light]
            stages[shot.light] = Stage(Geometry(surfaces), scene.lights[shot.light], scene.sky)
        yield expose(stages[shot.light], shot.moments or [shot.camera], shot.lens, np.random.default_rng(noise))


def generate_all(scenes: Sequence[tuple[Task, Path]], workers: int | None, progress: Progress | None) -> None:
    """Draws every scene (task, folder) that is missing; `progress` gets (done, total) as scenes are completed. workers:
    processes; None: one a core; 1 draws here. Interrupted, it ends begun scenes. WorkersLost where they die."""
    missing = [scene for scene in scenes if not (scene[1] / scene[0].name).is_dir()]
    report = progress or (lambda done, total: None)
    done = len(scenes) - len(missing)
    report(done, len(scenes))
    count = min(workers or min(cores(), MAX_PROCESSES), len(missing))
    if count > 1:
        compile_together(KERNELS)  # once, rather than in each of them
    execution = Execution("processes" if count > 1 else "threads", max(count, 1))
    with WorkerPool(execution, (__name__,), needs_main=False) as pool:
        for _ in TaskRunner(pool, Local(None), _generated, lambda scene, path: None).each(missing):
            done += 1
            report(done, len(scenes))


def _generated(_: None, scene: tuple[Task, Path]) -> Path:
    return generate(*scene)


def generate(task: Task, folder: Path) -> Path:
    """Draws one scene into ``folder/<name>`` unless it stands there complete, and returns that path."""
    final = folder / task.name
    if final.is_dir():
        return final
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        scene = build(task)
        temporary = temporary_name(final)
        temporary.mkdir(parents=True)
        try:
            decided = recorded_pairs().get(digest(task.family, task.split, task.seed, task.plan), {}).get(task.name)
            photographs = draw(scene, seeds(task))
            if decided is None:
                record = _judged(temporary, scene, photographs, task.plan)
            else:
                taken = itertools.islice(zip(scene.shots, photographs, strict=True), decided["photographs"])
                cameras = [_saved(temporary, i, shot, image) for i, (shot, image) in enumerate(taken)]
                record = {"cameras": cameras, "pairs": decided["pairs"]}
            (temporary / "scene.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
            os.replace(temporary, final)
        except OSError:
            if not final.is_dir():  # otherwise another process was faster, with the same bytes
                raise
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    finally:
        cv2.setNumThreads(threads)
    return final


def _judged(folder: Path, scene: DrawnScene, images: Iterable[Pixels], plan: Plan) -> dict[str, Any]:
    """The record of a scene whose pairs are judged while it is drawn."""
    features: list[Keypoints] = []
    cameras: list[dict[str, Any]] = []
    waiting, kept = list(scene.pairs), list[tuple[int, int]]()
    for i, (shot, image) in enumerate(zip(scene.shots, images, strict=True)):
        cameras.append(_saved(folder, i, shot, image))
        grey = cv2.imread(str(folder / cameras[-1]["image"]), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        features.append(keypoints(grey.astype(np.uint8, copy=False)))
        if len(features) < plan.shots:
            continue
        for a, b in [pair for pair in waiting if max(pair) <= i]:
            F = fundamental(scene.shots[a].camera, scene.shots[b].camera)
            if len(kept) < plan.pairs and matchable(features[a], features[b], F):
                kept.append((a, b))
        waiting = [pair for pair in waiting if max(pair) > i]
        if len(kept) == plan.pairs:
            break
    return {"cameras": cameras, "pairs": sorted(kept)}


def _saved(folder: Path, number: int, shot: Shot, image: Pixels) -> dict[str, Any]:
    path = folder / f"{number:02d}.jpg"
    picture = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    if not cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, shot.jpeg]):
        raise OSError(f"{path} could not be written")
    matrices = {name: getattr(shot.camera, name).tolist() for name in ("K", "R", "t")}
    return {"image": path.name, "size": list(shot.camera.size), **matrices}


def read(folder: Path) -> tuple[list[tuple[Path, Camera]], list[tuple[int, int]]]:
    """Image paths with their cameras, and the pairs, of a scene drawn before."""
    record = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    views = []
    for c in record["cameras"]:
        K, R, t = (np.array(c[k], dtype=np.float64) for k in ("K", "R", "t"))
        views.append((folder / c["image"], Camera(K, R, t, (c["size"][0], c["size"][1]))))
    return views, [(i, j) for i, j in record["pairs"]]


_SCENES = 2  # that each thread keeps, some 100 MB each: pairs of one scene follow one another
_PHOTOGRAPHS = 48  # whose visible pieces each thread keeps, some 2 MB each


def depth_at(task: Task, number: int, points: Matrix) -> Matrix:
    """Depth (n,) in metres along the axis of photograph `number` of a scene, at points (n, 2) in pixels.
    The depth of the plane that the nearest pixel's ray meets first, at the point itself. NaN where that ray meets
    nothing, and outside the photograph. What moves is where it was when this photograph was taken: each shot is cast
    against the surfaces of its own light. Of a long exposure it is the depth from the camera of the ground truth."""
    piece, inverse = _recent.visible(task, number)
    h, w = piece.shape
    column, row = np.round(np.nan_to_num(points, nan=-1.0)).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < w) & (row < h)
    met = np.where(inside, piece[np.where(inside, row, 0), np.where(inside, column, 0)], -1)
    form = inverse[met]
    inverse_depth = form[:, 0] * points[:, 0] + form[:, 1] * points[:, 1] + form[:, 2]
    known = (met >= 0) & (inverse_depth > 0)
    return np.where(known, 1 / np.where(known, inverse_depth, 1.0), np.nan)


class _Recent(threading.local):
    """The scenes and photographs that a thread has asked for last; they go with the thread."""

    def __init__(self) -> None:
        self.scene = functools.lru_cache(maxsize=_SCENES)(build)
        self.visible = functools.lru_cache(maxsize=_PHOTOGRAPHS)(self._visible)

    def _visible(self, task: Task, number: int) -> tuple[np.ndarray, Matrix]:
        """Per pixel (h, w) the piece that is met (-1: none), and of each piece (n, 3) the form of its 1 / depth."""
        scene = self.scene(task)
        shot = scene.shots[number]
        hits, inverse = Geometry(scene.surfaces[shot.light]).look(shot.camera)
        return hits.piece, inverse[:, 2].copy()


_recent = _Recent()


def _truth(camera0: Camera, camera1: Camera) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix]:
    return fundamental(camera0, camera1), camera0.K, camera1.K, *relative_pose(camera0, camera1)


class RenderedPairs(HeldPairs):
    """Image pairs of textured 3-D scenes with exact ground truth, in four families after the paper's four sets.

    split: "test" or "train"; they share no scene and no texture. size: "small" (about 20 pairs a family) or "full".
    families: some of "indoor", "driving", "orbit", "collection"; all four by default. seed: another seed, other scenes.
    root: the folder that keeps what was drawn, by default ``rendered`` in the cache folder.
    progress: called with (scenes done, scenes in all). workers: by default one a core. plan: amounts, for tests.

    A pair is kept if more than 20 SIFT matches (ratio 0.8) lie within 1 px of the true epipolar lines in both images,
    which is the paper's rule. Raises ValueError for an unknown split, size or family."""

    name = "rendered"

    def __init__(
        self, split: str = "test", size: str = "small", families: Sequence[str] | None = None, seed: int = 0,
        root: str | Path | None = None, *, progress: Progress | None = None, workers: int | None = None,
        plan: Plan | None = None,
    ) -> None:  # fmt: skip
        if (size, split) not in PLANS:
            raise ValueError(f"no split {split!r} in size {size!r}; there are test and train, in small and full")
        chosen = list(FAMILIES) if families is None else list(families)
        unknown = [family for family in chosen if family not in FAMILIES]
        if unknown or not chosen:
            raise ValueError(f"unknown families {unknown}; there are {', '.join(FAMILIES)}")
        held = [] if root is None or not Path(root).is_dir() else sorted(path.name for path in Path(root).iterdir())
        if others := [name for name in held if not name.startswith((*FAMILIES, "."))]:
            instead = "give an empty folder, or name the data set that is there, such as dataset=fmbench"
            raise ValueError(f"root={root} is where rendered scenes are kept, and it holds {others[0]}: {instead}")
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
        self._pairs = []
        self._views: dict[str, list[tuple[Path, Camera]]] = {}
        self._tasks = {task.name: task for task in tasks}
        for task in sorted(tasks, key=lambda task: chosen.index(task.family)):
            self._views[task.name], pairs = read(folders[task.family] / task.name)
            self._pairs += [self._pair(task, i, j) for i, j in pairs]

    def _pair(self, task: Task, i: int, j: int) -> ImagePair:
        (path0, camera0), (path1, camera1) = self._views[task.name][i], self._views[task.name][j]
        images = ImageSource(f"{task.name}/{i}", path0), ImageSource(f"{task.name}/{j}", path1)
        identity = f"{self.name}/{task.name}/{i}-{j}"
        return ImagePair(identity, task.family, task.name, *images, *_truth(camera0, camera1))

    def depth(self, image: ImageSource, points: Matrix) -> Matrix:
        """Depth (n,) in metres along the optical axis at points (n, 2) of an image; NaN for the sky and outside.
        The scene is built and cast anew; the last few images are kept. Raises KeyError for another data set's image."""
        scene, _, number = image.identity.rpartition("/")
        return depth_at(self._tasks[scene], int(number), points)

    def scene_pairs(self) -> ScenePairs:
        """All pairs of the photographs of each scene, as candidates to select from."""
        scenes = []
        for name, views in self._views.items():
            drawn = [
                View(camera.K, camera.R, camera.t, ImageSource(f"{name}/{i}", path, camera.size), f"{name}/{path.name}")
                for i, (path, camera) in enumerate(views)
            ]
            scenes.append(Scene(name, self._tasks[name].family, drawn, AllPairs(len(drawn))))
        return ScenePairs("rendered", scenes, (), (self.digest,), depth=self.depth)


_FILES = ("motorcycle_left.png", "motorcycle_right.png", "motorcycle_disp.npz")
# Calibration of the pictures as shipped (a quarter of the published resolution); see skimage.data.stereo_motorcycle.
_FOCAL, _CENTRE, _SHIFT, _BASELINE, _SIZE = 994.978, (311.193, 254.877), 31.086, 0.193001, (500, 741)


class StereoPair(HeldPairs):
    """One rectified pair with dense ground truth: a point (x, y) on the left is (x - disparity, y) on the right.
    The three files lie inside scikit-image's wheel, so that nothing is downloaded; FileNotFoundError names the one
    that is absent. root: another folder that holds them.
    Source: Scharstein et al., High-resolution stereo datasets with subpixel-accurate ground truth, GCPR 2014."""

    name = "stereo"

    def __init__(self, root: str | Path | None = None) -> None:
        self._paths = [skimage_file(name) if root is None else Path(root) / name for name in _FILES]
        for path in self._paths:
            if not path.is_file():
                raise FileNotFoundError(f"{path} is absent; the stereo pair needs {', '.join(_FILES)}")
        self.digest = hashlib.sha256(b"".join(path.read_bytes() for path in self._paths)).hexdigest()
        x, y = _CENTRE
        left = Camera(calibration(_FOCAL, _SIZE, (x, y)), np.eye(3), np.zeros(3), _SIZE)
        right = Camera(calibration(_FOCAL, _SIZE, (x + _SHIFT, y)), np.eye(3), np.array([-_BASELINE, 0.0, 0.0]), _SIZE)
        images = [ImageSource(f"motorcycle/{side}", self._paths[i]) for i, side in enumerate(("left", "right"))]
        identity, truth = f"{self.name}/motorcycle/left-right", _truth(left, right)
        self._pairs = [ImagePair(identity, self.name, "motorcycle", images[0], images[1], *truth)]
