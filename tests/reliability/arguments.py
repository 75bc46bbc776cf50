"""Arguments for generated calls: sound ones by what an annotation asks for, and what users hand over by mistake."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st

SCENES = ("sound", "random", "collinear", "planar", "coincident", "half coincident", "identity", "no motion in y")
COUNTS = (0, 1, 5, 7, 8, 9, 12, 16, 20, 60)
SCALES = (1.0, 1.0, 1.0, 1e-9, 1e-3, 1e6, 1e9, 1e150, 1e-150)
SIZE = (640, 960)
Draw = Callable[[Any], Any]
KINDS = ("torch.float32", "torch.float64", "numpy.float32", "numpy.float64")


def points(kind: str, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Matches (count, 2) of two photographs of 640 x 960 px: of a scene with outliers, or such as determine no F."""
    x0, x1 = rng.uniform([0, 0], [960, 640], (2, count, 2))
    if kind in ("sound", "planar"):
        X = np.c_[rng.uniform(-2, 2, (count, 2)), np.full(count, 6.0) if kind == "planar" else rng.uniform(4, 9, count)]
        angle = rng.uniform(-0.3, 0.3)
        R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        K = np.array([[800, 0, 480], [0, 800, 320], [0, 0, 1.0]])
        p0, p1 = X @ K.T, (X @ R.T + rng.uniform(-1, 1, 3)) @ K.T
        sound = rng.random(count)[:, None] < 0.7
        x0, x1 = p0[:, :2] / p0[:, 2:], np.where(sound, p1[:, :2] / p1[:, 2:], x1)
    if kind == "collinear":
        x0 = rng.integers(0, 600, count)[:, None] * [1, 0.5] + [0, 20]
        x1 = x0 + 5
    if kind == "coincident":
        x0, x1 = np.full_like(x0, 7), np.full_like(x1, 9)
    if kind == "half coincident" and count:
        x0[count // 2 :], x1[count // 2 :] = x0[0], x1[0]
    if kind == "identity":
        x1 = x0.copy()
    if kind == "no motion in y":
        x1[:, 1] = x0[:, 1]
    return x0, x1


class Scene:
    """What the arguments of one call are about: leading dimensions, matches and all that may be known of them."""

    def __init__(self, batch: tuple[int, ...], count: int, kind: str, scale: float, seed: int) -> None:
        self.batch, self.count, self.scale = batch, count, scale
        self.rng = np.random.default_rng(seed)
        pairs = [points(kind, count, self.rng) for _ in range(int(np.prod(batch)))]
        self.x0, self.x1 = (np.array([pair[i] for pair in pairs]).reshape(*batch, count, 2) * scale for i in (0, 1))

    def array(self, name: str, kind: str, shape: tuple[str, ...]) -> np.ndarray:
        """A sound value of an argument by its name, the kind of its numbers and its shape, as jaxtyping writes them."""
        sizes = {"n": self.count, "b": self.batch[0] if self.batch else 1, "pairs": 9, "t": 5, "d": 8}
        sizes |= {"n0": self.count, "n1": 11}
        full: list[int] = []
        for token in shape:
            known = [int(token)] if token.isdigit() else [sizes.get(token.lstrip("#"), 3)]
            full += list(self.batch) if token.startswith("*") else known
        if name in ("x0", "x1", "x"):
            points = self.x1 if name == "x1" else self.x0
            return points[..., :7, :] if "7" in shape else points
        if kind == "Bool":
            return self.rng.random(full) < 0.8
        if name.startswith("size") or name == "image_size":
            return np.broadcast_to(np.array(SIZE), full).copy()
        if name in ("index", "reverse"):
            return self.rng.integers(-1, 11 if name == "index" else max(1, self.count), full)
        if kind == "Int":
            return self.rng.integers(0, max(1, self.count), full)
        if name.startswith("K"):
            return np.broadcast_to(np.array([[800.0, 0, 480], [0, 800, 320], [0, 0, 1]]), full).copy()
        if name.startswith("R"):
            return np.broadcast_to(np.eye(3), full).copy()
        if name.startswith("lafs"):
            frames = self.rng.normal(size=full)
            frames[..., 2] = self.x1 if name == "lafs1" else self.x0
            return frames
        if name in ("weight", "ratio", "prior", "noise", "nsgd", "errors", "thresholds"):
            return self.rng.uniform(0.01, 1, full)
        return self.rng.normal(size=full)


def given(array: np.ndarray, kind: str) -> Any:
    """The array as a user has it: a tensor or an array, in single or double precision where it is no whole number."""
    library, _, dtype = kind.partition(".")
    if array.dtype.kind == "f":
        with np.errstate(over="ignore"):
            array = array.astype(dtype)
    return torch.from_numpy(array) if library == "torch" else array


def _with(value: Any, wrong: float) -> Any:
    array = np.array(value, dtype=np.float64)
    if array.size:
        array.reshape(-1)[array.size // 2] = wrong
    return torch.from_numpy(array) if isinstance(value, torch.Tensor) else array


def _same(value: Any, array: Any) -> Any:
    """An array as the value is one: a tensor or of NumPy."""
    return torch.from_numpy(np.ascontiguousarray(array)) if isinstance(value, torch.Tensor) else array


MISTAKES: Mapping[str, Callable[[Any], Any]] = {
    "one element is NaN": lambda v: _with(v, np.nan),
    "one element is infinite": lambda v: _with(v, np.inf),
    "one element is huge": lambda v: _with(v, 1e300),
    "one element is negative": lambda v: _with(v, -3.0),
    "zeros": lambda v: v * 0,
    "NaN": lambda v: _same(v, np.full(np.shape(v), np.nan)),
    "no last column": lambda v: v[..., :-1] if np.ndim(v) else v,
    "transposed": lambda v: _same(v, np.swapaxes(np.asarray(v), -1, -2)) if np.ndim(v) > 1 else v,
    "one dimension more": lambda v: v[None],
    "one dimension less": lambda v: v[0] if np.ndim(v) and len(v) else v,
    "one row less": lambda v: v[:-1] if np.ndim(v) else v,
    "twice": lambda v: _same(v, np.concatenate([np.asarray(v)] * 2)) if np.ndim(v) else v,
    "flat": lambda v: v.reshape(-1),
    "empty": lambda v: _same(v, np.zeros((0,))),
    "a number": lambda v: 1.5,
    "whole numbers": lambda v: _same(v, np.nan_to_num(np.asarray(v, np.float64)).clip(-9e9, 9e9).astype(np.int64)),
    "booleans": lambda v: _same(v, np.asarray(v) > 0),
    "complex": lambda v: _same(v, np.asarray(v).astype(np.complex128)),
    "half precision": lambda v: _same(v, np.asarray(v).clip(-6e4, 6e4).astype(np.float16)),
    "a list": lambda v: np.asarray(v).tolist(),
    "strings": lambda v: np.asarray(v).astype(str),
    "objects": lambda v: np.asarray(v).astype(object),
    "a string": lambda v: "points.txt",
    "None": lambda v: None,
    "a dictionary": lambda v: {"x": v},
    "on another device": lambda v: torch.as_tensor(np.asarray(v), device="meta"),
    "requires a gradient": lambda v: torch.as_tensor(np.asarray(v, np.float64)).requires_grad_(),
    "not contiguous": lambda v: _same(v, np.asarray(v))[..., ::1],
}  # fmt: skip
NAN = float("nan")
SEQUENCES = ((0.5,), (0.8, 0.5), (6, 6), (1, 2, 3), (), (0.0, -1.0), (NAN, 1.0), [6], "66", 5, None, np.ones(2))
NUMBERS = (0, -1, -0.5, NAN, float("inf"), 1e30, 1e-30, "3", None, [1], True, np.float32(0.5), torch.tensor(2))


def scenes(shapes: Sequence[tuple[int, ...]] = ((), (), (1,), (2,), (3, 2), (0,))) -> st.SearchStrategy[Scene]:
    """Scenes of few or no pairs and matches."""
    choices = map(st.sampled_from, (shapes, COUNTS, SCENES, SCALES))
    return st.builds(Scene, *choices, st.integers(0, 2**31))


def batches() -> st.SearchStrategy[Scene]:
    return scenes([(1,), (1,), (2,), (3,), (0,)])
