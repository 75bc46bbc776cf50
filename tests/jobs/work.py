"""What workers do; in a module of its own, which their processes import quickly."""

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

SLOW_SECONDS = 0.3  # of each batch of a slow pipeline, so that there is time to kill its workers


def make_needs(folder: Path, size: int = 0) -> tuple[Path, bytes]:
    """What workers need; each process that makes it leaves a file."""
    (folder / f"made-{os.getpid()}-{time.monotonic_ns()}").touch()
    return folder, bytes(size)


def squares(needed: tuple[Path, bytes], numbers: list[int]) -> list[int]:
    """The squares; a negative number ends the process, after it has left a file."""
    folder = needed[0]
    for number in numbers:
        if number < 0:
            (folder / f"died-{time.monotonic_ns()}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return [number * number for number in numbers]


def ends(folder: Path) -> Any:
    os._exit(3)


def fails(needed: object, job: int) -> int:
    raise ValueError(f"job {job} is wrong")


def slow(event: threading.Event, job: int) -> int:
    if job:
        event.wait(60)
    return job


def late(value: None, job: int) -> int:
    time.sleep(0.05 if job % 3 == 0 else 0)
    return -job


def given_pipeline() -> Any:
    from fmtorch.pipeline import load_pipeline

    return load_pipeline("given_fmtorch")


class Slow:
    model = "fundamental"

    def __init__(self, estimator: Any) -> None:
        self.estimator = estimator

    def __call__(self, c: Any, seed: int = 0) -> Any:
        time.sleep(SLOW_SECONDS)
        return self.estimator(c, seed)


def slow_pipeline() -> Any:
    pipeline = given_pipeline()
    pipeline.estimator = Slow(pipeline.estimator)
    return pipeline


def sift_pipeline() -> Any:
    from fmtorch.pipeline import load_pipeline

    options = ["features.max_features=300", "estimator=lmeds", "estimator.hypotheses=30"]
    return load_pipeline("sift_ratio", overrides=options)


class Fatal:
    """An extractor that ends its process at the darkest image."""

    def __init__(self, extractor: Any) -> None:
        self.extractor = extractor

    def __call__(self, image: Any) -> Any:
        if not image.any():
            os.kill(os.getpid(), signal.SIGKILL)
        return self.extractor(image)


def fatal_pipeline() -> Any:
    pipeline = sift_pipeline()
    pipeline.extractor = Fatal(pipeline.extractor)
    return pipeline
