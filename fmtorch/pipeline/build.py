"""A pipeline by what makes it: workers in other processes get that instead, and make the pipeline once."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Callable

from fmtorch.pipeline.pipeline import Pipeline

Build = Callable[[], Pipeline]

_built: dict[bytes, Pipeline] = {}  # of this process
_lock = threading.Lock()


def pipeline_of(source: Pipeline | Build) -> Pipeline:
    """The pipeline itself, or what a picklable function makes, once in this process for equal functions."""
    if isinstance(source, Pipeline):
        return source
    key = pickle.dumps(source)
    with _lock:
        if key not in _built:
            _built[key] = source()
        return _built[key]
