"""What several tests share: pictures, pairs and data sets on disk, a small pipeline, commands in this process."""

import dataclasses
import errno
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra

import fmtorch.__main__
import fmtorch.commands.config  # the commands' configs, by their names
from fmtorch import presets
from fmtorch.data import ImagePair, ImageSource
from fmtorch.pipeline import Pipeline
from fmtorch.presets.composition import compose as compose

ROWS = np.array([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # F of a sideways camera: epipolar lines are rows


def draw(path: Path, seed: int, shift: int = 0) -> ImageSource:
    """A blurred random picture that SIFT finds plenty in, shifted to the left by some pixels."""
    noise = np.random.default_rng(seed).uniform(0, 255, (60, 100))
    picture = cv2.resize(noise, (800, 480), interpolation=cv2.INTER_CUBIC)[:240, shift : shift + 320]
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.clip(picture, 0, 255).astype(np.uint8))
    return ImageSource(path.name, path)


def pair(name: str, image0: ImageSource, image1: ImageSource, problem: str | None = None) -> ImagePair:
    return ImagePair(name, "family", "scene", image0, image1, ROWS / np.sqrt(2), problem=problem)


def draw_set(
    root: Path, scenes: Iterable[str] = ("scene",), images: int = 3, pairs: Sequence[tuple[int, int]] | None = None
) -> Path:
    """A set in FM-Bench's layout whose scenes have images moved along x; pairs: by default each with the next."""
    lines, places = [], []
    for seed, scene in enumerate(scenes):
        for i in range(images):
            draw(root / scene / "Images" / f"{i:08d}.png", seed, shift=9 * i)
        chosen = [(i, i + 1) for i in range(images - 1)] if pairs is None else pairs
        lines += [f"{i} {j} 0 0 0 0 0 -1 0 1 0\n" for i, j in chosen]
        places += [f"{scene}/\n"] * len(chosen)
    (root / "pairs_with_gt.txt").write_text("".join(lines))
    (root / "pairs_which_dataset.txt").write_text("".join(places))
    return root


def small_pipeline(**parts: object) -> Pipeline:
    """SIFT, ratio test, one to one, LMedS; or other stages."""
    stages = {
        "features": presets.build("features", "sift", max_features=500),
        "matcher": presets.build("matcher", "nearest"),
        "pruners": {name: presets.build("pruner", name) for name in ("ratio", "one_to_one")},
        "estimator": presets.build("estimator", "lmeds", hypotheses=200),
    }
    return Pipeline(**{**stages, **parts})  # type: ignore[arg-type]


def unused(*_: object) -> Any:
    raise AssertionError("this stage has nothing to do")


def write_file(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def full_disk(*_: object, **__: object) -> Any:
    """Stands for a function that writes."""
    raise OSError(errno.ENOSPC, "No space left on device")


def apart(F: np.ndarray, G: np.ndarray) -> float:
    return float(min(np.abs(F - G).max(), np.abs(F + G).max()))


def same(a: Any, b: Any) -> bool:
    """Whether two records, or what is in them, are of one kind and equal to the bit."""
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    return bool(a == b)


def edit_lines(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


def in_threads(count: int, work: Callable[[int], object]) -> None:
    """Call `work` with 0, 1, ... at once; raises what one of them raised."""
    errors: list[BaseException] = []

    def run(number: int) -> None:
        try:
            work(number)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def call_command(monkeypatch: pytest.MonkeyPatch, folder: Path, *words: str) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["fmtorch", *words])
    monkeypatch.setattr(sys, "path", [str(folder), *sys.path])
    try:
        fmtorch.__main__.main()
    finally:
        GlobalHydra.instance().clear()
