"""The files that OANet trains and tests on (Zhang et al., ICCV 2019), of one entry for each pair ``0``, ``1``, ...:

``xs`` (1, n, 4), the matches in calibrated coordinates; ``Rs``, ``ts``, X2 = R X1 + t with t of length one; ``ratios``
and ``mutuals`` (n,), where they were dumped; ``cx1s, cy1s, f1s, cx2s, cy2s, f2s``, the cameras, which bring the matches
back to pixels. The files tell no image sizes: the principal point is taken for the centre.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.data.pairs import GivenMatches, ImagePair
from fmtorch.data.text_files import DataError
from fmtorch.storage.exchange import h5
from fmtorch.storage.exchange.given import Array, Size, broken, calibrated, given, image, size_by_centre


@dataclasses.dataclass(frozen=True, eq=False)
class OANetMatches:
    """The matches of one pair; K: its calibrations."""

    path: Path
    key: str
    K: tuple[Array, Array]
    sizes: tuple[Size, Size]

    def __call__(self) -> GivenMatches:
        """Read them, in pixels. Raises DataError naming file and key."""
        with h5.opened(self.path) as file:
            rays = h5.numbers(file, f"xs/{self.key}", 1, None, 4)[0]
            ratios, mutuals = (self._side(file, name, len(rays)) for name in ("ratios", "mutuals"))
        x0, x1 = (x * K.diagonal()[:2] + K[:2, 2] for x, K in zip((rays[:, :2], rays[:, 2:]), self.K, strict=True))
        return given(
            x0, x1, self.sizes, (len(rays), len(rays)), ratios, None if mutuals is None else mutuals.astype(bool)
        )

    def _side(self, file: Any, name: str, count: int) -> Array | None:
        if not h5.holds(file, name):
            return None
        values = h5.numbers(file, f"{name}/{self.key}").reshape(-1)
        if len(values) != count:
            raise DataError(
                f"{self.path}: {f'{name}/{self.key}'!r} has {len(values)} entries, "
                f"but {f'xs/{self.key}'!r} has {count} matches"
            )
        return values


def oanet_pairs(root: Path, images: Path | None) -> Iterator[ImagePair]:
    """The pairs of a file, or of all files of a folder."""
    for path in h5.files(root):
        with h5.opened(path) as file:
            if not h5.holds(file, "xs"):
                raise DataError(f"{path}: 'xs' is missing; it is no file of OANet's layout")
            for key in sorted(h5.keys(file["xs"]), key=lambda key: (len(key), key)):
                yield _pair(file, path, root.stem, key, images)


def _pair(file: Any, path: Path, family: str, key: str, images: Path | None) -> ImagePair:
    scene, identity = path.stem, f"{path.stem}/{key}"
    sources = image(family, scene, f"{key}/1", images), image(family, scene, f"{key}/2", images)
    try:
        K = _calibration(file, key, 1), _calibration(file, key, 2)
        R, t = h5.reshaped(file, f"Rs/{key}", 3, 3), h5.reshaped(file, f"ts/{key}", 3)
        sizes = size_by_centre(K[0]), size_by_centre(K[1])
    except DataError as error:
        return broken(identity, family, scene, sources, str(error))
    pair = calibrated(identity, family, scene, sources, K, R, t)
    return dataclasses.replace(pair, matches=OANetMatches(path, key, K, sizes))


def _calibration(file: Any, key: str, which: int) -> Array:
    cx, cy = (h5.reshaped(file, f"{name}{which}s/{key}", 1)[0] for name in ("cx", "cy"))
    fx, fy = h5.reshaped(file, f"f{which}s/{key}", 2)
    if fx == 0 or fy == 0:
        raise DataError(f"{file.filename}: 'f{which}s/{key}' holds a focal length of zero")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
