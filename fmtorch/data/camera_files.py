"""Photographs with a ``Camera.txt`` beside them: the cameras of the FM-Bench layout, before there are pairs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fmtorch.data.candidates import WINDOW, AllPairs, Candidates, following
from fmtorch.data.pairs import ImageSource
from fmtorch.data.scenes import Scene, ScenePairs, View, folders
from fmtorch.data.text_files import DataError, given_root, numbered, to_finite

CAMERAS, IMAGES, SUFFIXES = "Camera.txt", "Images", (".jpg", ".png")
COLUMNS = "K (9 numbers, row by row), R (9), t (3)"


class CameraFilePairs(ScenePairs):
    """Pairs of images ``<scene>/Images/%08d.jpg`` (or .png), whose cameras are the lines of ``<scene>/Camera.txt``.

    root: a folder of scenes, or one scene's folder. sequences: names of scenes to take; None: all.
    fps: frames a second of videos, of which frames at most `window` seconds apart make pairs; None: all pairs.
    pairs, seed: as in `ScenePairs`.
    """

    def __init__(
        self,
        root: str | Path | None = None,
        split: str = "test",
        sequences: Sequence[str] | None = None,
        fps: int | float | None = None,
        window: int | float = WINDOW,
        pairs: int | None = None,
        seed: int = 0,
    ) -> None:
        if split != "test":
            raise DataError(f"split {split!r}: cameras has only 'test'; choose scenes by root or sequences")
        if fps is not None and fps <= 0:
            raise DataError(f"fps={fps:g}; it must be positive, or null for images in no order")
        home = given_root(
            root, "cameras", "a folder of scenes with Camera.txt and Images/ each, or one such scene"
        ).absolute()
        if sequences is None and (home / CAMERAS).is_file():
            home, sequences = home.parent, [home.name]
        names = sequences or sorted(path.parent.name for path in home.glob(f"*/{CAMERAS}"))
        scene_folders = folders(home, names, f"a folder for each scene, with {CAMERAS} and {IMAGES}/")
        if not scene_folders:
            raise DataError(f"{home}: no folder with {CAMERAS}, one line an image: {COLUMNS}")
        scenes = [_scene(folder, fps, window) for folder in scene_folders]
        super().__init__("cameras", scenes, [(f.name, f / CAMERAS) for f in scene_folders], (fps, window), pairs, seed)


def _scene(folder: Path, fps: int | float | None, window: int | float) -> Scene:
    family = folder.parent.name
    images = folder / IMAGES
    if not images.is_dir():
        raise DataError(f"{images}: no such folder; it must hold the images of {folder / CAMERAS}")
    there = {file.stem: file for file in sorted(images.iterdir(), reverse=True) if file.suffix in SUFFIXES}
    views = list[View]()
    for number, line in numbered(folder / CAMERAS):
        stem, values = f"{len(views):08d}", to_finite(folder / CAMERAS, number, line.split(), COLUMNS, 21)
        source = ImageSource(f"{family}/{folder.name}/{stem}", there.get(stem, images / f"{stem}{SUFFIXES[0]}"))
        place = f"{folder / CAMERAS}, line {number}"
        views.append(View(source, values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:], place))
    pairs: Candidates = AllPairs(len(views))
    if fps is not None:
        pairs = following(np.arange(len(views)) / fps, window)
    return Scene(folder.name, family, views, pairs)
