"""What workers need for their calls, made once in each process and found there by its digest.

A worker of a cluster, or of anybody's executor, has no start of its own in which to make it. A call therefore names it
by its digest, and where that says nothing to the worker, it is called again with how to make it.
"""

from __future__ import annotations

import functools
import hashlib
import pickle
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import cv2
import torch

from fmtorch.core.version import __version__

T = TypeVar("T")
KEPT = 4  # things made in a process that stay there
SENT_ALONG = 50_000  # bytes of a recipe that go with each call


class Here(Generic[T]):
    """Something that workers of this process share."""

    shared = True

    def __init__(self, value: T) -> None:
        self.value = value

    def call(self, function: Callable[[T, Any], Any], with_recipe: bool) -> Callable[[Any], Any]:
        """The function with this as its first argument."""
        return functools.partial(function, self.value)


class Recipe(Generic[T]):
    """How other processes make something: `make`, which is pickled."""

    shared = False

    def __init__(self, make: Callable[[], T]) -> None:
        self.pickled = pickle.dumps((__version__, make))
        self.digest = hashlib.blake2b(self.pickled, digest_size=16).hexdigest()

    def call(self, function: Callable[[T, Any], Any], with_recipe: bool) -> Callable[[Any], Any]:
        """The function with what is made as its first argument. with_recipe: the recipe is sent along, however long."""
        sent = self.pickled if with_recipe or len(self.pickled) <= SENT_ALONG else None
        return functools.partial(_called, self.digest, sent, function)


Source = Here[T] | Recipe[T]


class NotMade:
    """The answer of a worker that has not the recipe."""


class VersionError(ValueError):
    """Workers of another version of fmtorch, whose results would differ."""


_values: OrderedDict[str, Any] = OrderedDict()
_lock = threading.Lock()


def _called(digest: str, recipe: bytes | None, function: Callable[[Any, Any], Any], argument: Any) -> Any:
    with _lock:
        if digest not in _values:
            if recipe is None:
                return NotMade()
            _values[digest] = _make(recipe)
        _values.move_to_end(digest)
        while len(_values) > KEPT:
            _values.popitem(last=False)
        value = _values[digest]
    return function(value, argument)


def _make(recipe: bytes) -> Any:
    """What a recipe makes, in a process whose workers compute with a thread each: contended ones collapse."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    version, make = pickle.loads(recipe)
    if version != __version__:
        raise VersionError(f"a worker has fmtorch {__version__}, the command {version}; install the same on both")
    return make()
