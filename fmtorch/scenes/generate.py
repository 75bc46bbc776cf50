"""Draws scenes to disk: photographs, exact cameras, and the pairs that can be matched at all.

Every scene is a function of (version, seed, split, family, number) alone and is written to a temporary folder that is
renamed when complete, so that an interrupted generation goes on where it stopped and two processes never clash.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fmtorch.data.construction import Keypoints, keypoints, matchable
from fmtorch.jit.together import compile_together
from fmtorch.jobs.execution import Execution, cores
from fmtorch.jobs.pool import MAX_PROCESSES, WorkerPool
from fmtorch.jobs.runner import Local, TaskRunner
from fmtorch.scenes import collection, driving, indoor, orbit
from fmtorch.scenes.camera import Camera, fundamental
from fmtorch.scenes.light import Stage, affine, expose, footprints, group_by_texture, shade
from fmtorch.scenes.raycast import Geometry, cast_pieces
from fmtorch.scenes.scene import Scene, Shot
from fmtorch.scenes.textures import Pixels

VERSION = 3  # of the generator: raised by every change that changes a picture or a pair
FAMILIES = {"indoor": indoor.scene, "driving": driving.scene, "orbit": orbit.scene, "collection": collection.scene}
SPLITS = ("test", "train")
RECORD = Path(__file__).with_name("pairs.json")
Progress = Callable[[int, int], None]

KERNELS = (cast_pieces, shade, footprints, affine, group_by_texture)  # that drawing calls, slowest first


@dataclasses.dataclass(frozen=True)
class Plan:
    """How much of a family is drawn: scenes, photographs a scene, pairs a scene, and the images' scale.

    spare: photographs that are drawn too, one at a time, as long as a scene has fewer matchable pairs than wanted.
    """

    scenes: int
    shots: int
    pairs: int
    scale: float = 1.0
    spare: int = 0


PLANS = {
    ("small", "test"): Plan(5, 4, 4, spare=6),
    ("small", "train"): Plan(5, 4, 4, spare=6),
    ("full", "test"): Plan(8, 14, 25, spare=6),
    ("full", "train"): Plan(32, 14, 25, spare=6),
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
        """The scene's name and its folder's."""
        return f"{self.family}-{self.split}-{self.number:03d}"


def digest(family: str, split: str, seed: int, plan: Plan) -> str:
    """What defines a family's pictures and pairs, as 64 hex digits.

    OpenCV's release is part of it, since it draws the letters on signs and finds the keypoints that choose the pairs.
    """
    release = ".".join(cv2.__version__.split(".")[:2])
    parts = [VERSION, release, family, split, seed, dataclasses.asdict(plan)]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


@functools.cache
def recorded_pairs() -> dict[str, dict[str, dict[str, Any]]]:
    """What the rule for pairs has decided: by digest and scene the number of photographs and the pairs.

    Drawn and judged once by ``scripts/record_rendered_pairs.py``; with other versions of the generator or of OpenCV,
    whose digests are not here, it is judged anew.
    """
    record: dict[str, dict[str, dict[str, Any]]] = json.loads(RECORD.read_text(encoding="utf-8"))
    return record


def seeds(task: Task) -> np.random.SeedSequence:
    """The random stream of one scene; no two scenes, families or splits share one."""
    place = [VERSION, task.seed, SPLITS.index(task.split), list(FAMILIES).index(task.family), task.number]
    return np.random.SeedSequence(place)


def build(task: Task) -> Scene:
    """A scene's surfaces, lights and shots, before anything is drawn."""
    rng = np.random.default_rng(seeds(task))
    return FAMILIES[task.family](rng, task.split, task.plan.shots + task.plan.spare, task.plan.scale)


def draw(scene: Scene, seed: np.random.SeedSequence) -> Iterator[Pixels]:
    """The photographs of a scene, RGB or grey, each drawn when it is asked for."""
    stages: dict[int, Stage] = {}
    for shot, noise in zip(scene.shots, seed.spawn(len(scene.shots)), strict=True):
        if shot.light not in stages:
            surfaces = scene.surfaces[shot.light]
            stages[shot.light] = Stage(Geometry(surfaces), scene.lights[shot.light], scene.sky)
        cameras = shot.moments or [shot.camera]
        yield expose(stages[shot.light], cameras, shot.lens, np.random.default_rng(noise))


def generate_all(
    scenes: Sequence[tuple[Task, Path]], workers: int | None = None, progress: Progress | None = None
) -> None:
    """Draws every scene (task, folder) that is missing; `progress` gets (done, total) as scenes are completed.

    workers: processes; by default one for each core that this process may use; 1 draws here. Interrupted, it completes
    the scenes that are being drawn. Raises WorkersLost where workers die.
    """
    missing = [scene for scene in scenes if not (scene[1] / scene[0].name).is_dir()]
    report = progress or (lambda done, total: None)
    done = len(scenes) - len(missing)
    report(done, len(scenes))
    count = min(workers or min(cores(), MAX_PROCESSES), len(missing))
    if count > 1:
        compile_together(KERNELS)  # once, rather than in each of them
    execution = Execution("processes" if count > 1 else "threads", max(count, 1))
    with WorkerPool(execution, ("fmtorch.scenes.generate",), needs_main=False) as pool:
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
        temporary = folder / f".{task.name}-{os.getpid()}-{uuid.uuid4().hex[:8]}.tmp"
        temporary.mkdir(parents=True)
        try:
            decided = recorded_pairs().get(digest(task.family, task.split, task.seed, task.plan), {}).get(task.name)
            photographs = draw(scene, seeds(task))
            if decided is None:
                _write(temporary, scene, photographs, task.plan)
            else:
                taken = list(itertools.islice(zip(scene.shots, photographs, strict=True), decided["photographs"]))
                cameras = [_saved(temporary, i, shot, image) for i, (shot, image) in enumerate(taken)]
                _record(temporary, cameras, decided["pairs"])
            os.replace(temporary, final)
        except OSError:
            if not final.is_dir():  # otherwise another process was faster, with the same bytes
                raise
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    finally:
        cv2.setNumThreads(threads)
    return final


def _write(folder: Path, scene: Scene, images: Iterable[Pixels], plan: Plan) -> None:
    """Photographs and pairs of a scene; takes from `images` no more than the plan's pairs need."""
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
        possible = [pair for pair in waiting if max(pair) <= i]
        waiting = [pair for pair in waiting if max(pair) > i]
        for a, b in possible:
            if len(kept) == plan.pairs:
                break
            if matchable(features[a], features[b], fundamental(scene.shots[a].camera, scene.shots[b].camera)):
                kept.append((a, b))
        if len(kept) == plan.pairs:
            break
    _record(folder, cameras, sorted(kept))


def _saved(folder: Path, number: int, shot: Shot, image: Pixels) -> dict[str, Any]:
    """Writes a photograph and returns what is recorded of it."""
    path = folder / f"{number:02d}.jpg"
    picture = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    if not cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, shot.jpeg]):
        raise OSError(f"{path} could not be written")
    camera = shot.camera
    return {
        "image": path.name, "size": list(camera.size),
        "K": camera.K.tolist(), "R": camera.R.tolist(), "t": camera.t.tolist(),
    }  # fmt: skip


def _record(folder: Path, cameras: list[dict[str, Any]], pairs: Sequence[Sequence[int]]) -> None:
    record = {"cameras": cameras, "pairs": pairs}
    (folder / "scene.json").write_text(json.dumps(record, indent=1), encoding="utf-8")


def read(folder: Path) -> tuple[list[tuple[Path, Camera]], list[tuple[int, int]]]:
    """Image paths with their cameras, and the pairs, of a scene drawn before."""
    record = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    views = []
    for c in record["cameras"]:
        K, R, t = (np.array(c[k], dtype=np.float64) for k in ("K", "R", "t"))
        views.append((folder / c["image"], Camera(K, R, t, (c["size"][0], c["size"][1]))))
    return views, [(i, j) for i, j in record["pairs"]]
