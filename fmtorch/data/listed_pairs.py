"""Text lists of image pairs with cameras: SuperGlue's ``*_with_gt.txt`` and glue-factory's ``pairs_calibrated.txt``.

SuperGlue (Sarlin et al., CVPR 2020, match_pairs.py): the names of both images, by how many quarter turns each is turned
counterclockwise, K0, K1 row by row, and the pose, a matrix (4, 4) that takes points of camera 0 to camera 1. K and pose
are those of the images before they are turned. glue-factory: names, K0, K1, and either R and t or the matrix.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fmtorch.data.cameras import Matrix
from fmtorch.data.resampling import Size
from fmtorch.data.text_files import DataError, numbered, to_numbers, to_whole

SUPERGLUE, GLUE_FACTORY, GLUE_FACTORY_4X4 = 38, 32, 36  # columns of a line
LAYOUTS = {
    SUPERGLUE: "name0 name1 turns0 turns1 K0 (9) K1 (9) pose (4 x 4), as SuperGlue",
    GLUE_FACTORY: "name0 name1 K0 (9) K1 (9) R (9) t (3), as glue-factory",
    GLUE_FACTORY_4X4: "name0 name1 K0 (9) K1 (9) pose (4 x 4), as glue-factory",
}
CORNER = 0.5  # where glue-factory and COLMAP, whose cameras MegaDepth's are, put the centre of the first pixel
_QUARTERS = 4  # of a full turn


@dataclasses.dataclass(frozen=True, eq=False)
class ListedPair:
    """One pair of a list.

    place: file and line, or record, with which messages begin. names: of the images, relative to their folder.
    K0, K1: (3, 3), for images of `size` (h, w), None: of the files' own sizes. R, t: ``X1 = R X0 + t``.
    quarter_turns: of both images, counterclockwise; K, R and t are those before the turn.
    origin: coordinates of the first pixel's centre in the convention of K.
    """

    place: str
    names: tuple[str, str]
    K0: Matrix
    K1: Matrix
    R: Matrix
    t: Matrix
    quarter_turns: tuple[int, int] = (0, 0)
    size: Size | None = None
    origin: float = 0.0


def text_pairs(path: Path) -> Iterator[ListedPair]:
    """The pairs of a text file, a line each; empty lines and comments (``#``) are left out.

    Raises DataError, naming the line, for a number of columns that is not one of `LAYOUTS`, and for an entry that is no
    number. Numbers that are not finite pass: they are one pair's fault.
    """
    for number, line in numbered(path):
        words = line.split()
        if len(words) not in LAYOUTS:
            forms = "; ".join(f"{count}: {form}" for count, form in LAYOUTS.items())
            without = " without cameras" if len(words) <= SUPERGLUE - GLUE_FACTORY else ""
            raise DataError(f"{path}, line {number}: {len(words)} columns{without}; it must have {forms}")
        names, values, turns = (words[0], words[1]), words[2:], (0, 0)
        if len(words) == SUPERGLUE:
            turns = _turns(path, number, values[0]), _turns(path, number, values[1])
            values = values[2:]
        cameras = to_numbers(path, number, values, "K0, K1 and the pose", len(values))
        R, t = _pose(cameras[18:])
        place = f"{path}, line {number}"
        origin = 0.0 if len(words) == SUPERGLUE else CORNER
        K0, K1 = cameras[:9].reshape(3, 3), cameras[9:18].reshape(3, 3)
        yield ListedPair(place, names, K0, K1, R, t, turns, origin=origin)


def _turns(path: Path, number: int, word: str) -> int:
    turns = to_whole(path, number, word, "the number of quarter turns")
    if not 0 <= turns < _QUARTERS:
        raise DataError(f"{path}, line {number}: {turns} quarter turns; it must be 0, 1, 2 or 3")
    return turns


def _pose(values: Matrix) -> tuple[Matrix, Matrix]:
    """R and t of twelve numbers, R before t, or of sixteen, a matrix row by row."""
    if len(values) == 12:
        return values[:9].reshape(3, 3), values[9:]
    matrix = values.reshape(4, 4)
    return matrix[:3, :3], np.ascontiguousarray(matrix[:3, 3])
