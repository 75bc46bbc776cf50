"""Files that OANet and its successors train and test on (Zhang et al., ICCV 2019): HDF5, an entry for each pair.

Of pair ``0``, ``1``, ...: ``xs`` (1, n, 4) calibrated coordinates of matches, ``ys`` (n, k), their geodesic distance in
the first column, ``Rs`` (3, 3), ``ts`` (3, 1), ``ratios`` and ``mutuals`` (n,), ``cx1s``, ``cy1s``, ``f1s`` and
those of the other image. OANet ignores what else there is; ``sizes`` (h0, w0, h1, w1) is this project's."""

import contextlib
import dataclasses
import os
import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fmtorch.core.files import replacing
from fmtorch.data import DataError, GivenMatches, Lens
from fmtorch.data.files import Array, Matrix
from fmtorch.geometry.epipolar import symmetric_squared
from fmtorch.geometry.pose import calibrated
from fmtorch.io import h5, predictions

GEODESIC = 1e-4  # of an inlier, squared focal lengths: obj_geod_th of OANet's code


def geodesic(R: Matrix, t: Matrix, K0: Matrix, K1: Matrix, x0: Matrix, x1: Matrix) -> Matrix:
    """OANet's geodesic distance (n,): the two squared distances to the epipolar lines added, in calibrated coordinates.
    R, t: X1 = R X0 + t; the length of t does not count. x0, x1: matches (n, 2) in pixels."""
    E = np.cross(np.eye(3), t / (np.linalg.norm(t) or 1.0)).T @ R
    given = E, calibrated(x0, K0), calibrated(x1, K1)
    values: Matrix = symmetric_squared(*(torch.from_numpy(value) for value in given)).numpy()
    return values


@dataclasses.dataclass(frozen=True)
class Cameras:
    """What a file says of a pair beside its matches. K: of both images. R, t: X1 = R X0 + t. sizes: (h, w)."""

    K: tuple[Matrix, Matrix]
    R: Matrix
    t: Matrix
    sizes: tuple[predictions.Size, predictions.Size]


def keys(file: Any) -> list[str]:
    """The names of the pairs. Raises DataError where the file is of another layout."""
    if not h5.holds(file, "xs"):
        raise DataError(f"{file.filename}: 'xs' is missing; it is no file of OANet's layout")
    return sorted(h5.keys(file["xs"]), key=lambda key: (len(key), key))


_SHAPES: dict[str, tuple[int, ...]] = {f"{k}{i}s": (n,) for i in (1, 2) for k, n in (("cx", 1), ("cy", 1), ("f", 2))}
_SHAPES |= {"Rs": (3, 3), "ts": (3,), "sizes": (4,)}


def cameras(file: Any, key: str) -> Cameras:
    """The cameras of a pair; images of unknown size have their principal point in the middle."""
    names = [name for name in _SHAPES if name != "sizes" or h5.holds(file, name)]
    cx0, cy0, f0, cx1, cy1, f1, R, t, *sized = (h5.reshaped(file, f"{n}/{key}", *_SHAPES[n]) for n in names)
    for i, f in ((1, f0), (2, f1)):
        if not f.all():
            raise DataError(f"{file.filename}: 'f{i}s/{key}' holds a focal length of zero")
    K0, K1 = Lens(*f0, *cx0, *cy0).K, Lens(*f1, *cx1, *cy1).K
    if sized:
        h0, w0, h1, w1 = sized[0].astype(int).tolist()
        return Cameras((K0, K1), R, t, ((h0, w0), (h1, w1)))
    return Cameras((K0, K1), R, t, (predictions.size_by_centre(K0), predictions.size_by_centre(K1)))


def figures(file: Any, name: str, key: str, count: int) -> Matrix | None:
    """One number of each of `count` matches, the first column; None where the file has none of that name."""
    if not h5.holds(file, name):
        return None
    values = h5.numbers(file, f"{name}/{key}")
    values = values.reshape(len(values), -1)[:, 0] if values.ndim else values.reshape(-1)
    if len(values) != count:
        lengths = f"{len(values)} entries, but {f'xs/{key}'!r} has {count} matches"
        raise DataError(f"{file.filename}: {f'{name}/{key}'!r} has {lengths}")
    return values


def matches(path: Path, key: str, known: Cameras) -> GivenMatches:
    """The matches of a pair in pixels."""
    with h5.opened(path) as file:
        x0, x1, ratios, mutuals = arrays(file, key, known)
    mutual = None if mutuals is None else mutuals.astype(bool)
    return predictions.given(x0, x1, known.sizes, (len(x0), len(x0)), ratio=ratios, mutual=mutual)


def arrays(file: Any, key: str, known: Cameras) -> tuple[Matrix, Matrix, Matrix | None, Matrix | None]:
    """The points of the matches (n, 2) in pixels, their ratios and whether they are mutual (n,)."""
    rays = h5.numbers(file, f"xs/{key}", 1, None, 4)[0]
    ratios, mutuals = (figures(file, name, key, len(rays)) for name in ("ratios", "mutuals"))
    x0, x1 = (x * K.diagonal()[:2] + K[:2, 2] for x, K in zip((rays[:, :2], rays[:, 2:]), known.K, strict=True))
    return x0, x1, ratios, mutuals


class RandomAccess:
    """A file from which pairs are read in any order, by each process for itself; it is closed before a fork."""

    def __init__(self, path: Path) -> None:
        self.path, self._file, self._files = path, None, contextlib.ExitStack()
        _ACCESSED.add(self)

    @property
    def file(self) -> Any:
        """The open file. Raises DataError where it is missing or damaged."""
        if self._file is None:
            self._file = self._files.enter_context(h5.opened(self.path))
        return self._file

    def close(self) -> None:
        self._files.close()
        self._file = None

    def __getstate__(self) -> Path:
        return self.path

    def __setstate__(self, path: Path) -> None:
        self.__init__(path)  # type: ignore[misc]


_ACCESSED: weakref.WeakSet[RandomAccess] = weakref.WeakSet()


def _close_all() -> None:
    for access in _ACCESSED:
        access.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_close_all)


def entry(
    cameras: Cameras, x0: Matrix, x1: Matrix, ratios: Array | None, mutuals: Array | None
) -> Mapping[str, Array | None]:
    """What a file holds of a pair, by the names of its groups.
    x0, x1: matches (n, 2) in pixels. ratios, mutuals: (n,), None where they are not known."""
    (K0, K1), t = cameras.K, cameras.t / np.linalg.norm(cameras.t)
    known = {f"{name}{i}s": K[[row], [2]] for i, K in ((1, K0), (2, K1)) for row, name in enumerate(("cx", "cy"))}
    return {
        "xs": np.hstack([calibrated(x0, K0), calibrated(x1, K1)])[None],
        "ys": geodesic(cameras.R, t, K0, K1, x0, x1)[:, None],
        "Rs": cameras.R, "ts": t[:, None], "ratios": ratios, "mutuals": mutuals, **known,
        "f1s": K0.diagonal()[None, :2], "f2s": K1.diagonal()[None, :2],
        "sizes": np.array(cameras.sizes, np.float64).ravel(),
    }  # fmt: skip


def write(path: Path, entries: Iterable[Mapping[str, Array | None]]) -> None:
    """Write pairs, each of `entry`, as a file of float32, whole or not at all."""
    with replacing(path) as temporary, h5.imported().File(temporary, "w") as file:
        for number, arrays in enumerate(entries):
            for name, values in arrays.items():
                if values is not None:
                    file.create_dataset(f"{name}/{number}", data=np.asarray(values, np.float32))
