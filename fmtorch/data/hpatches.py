"""HPatches' image sequences (Balntas et al., CVPR 2017): photographs of planes with known homographies."""

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np

from fmtorch.core.options import Within
from fmtorch.data.files import DataError, Matrix, add_to_digest, given_root, read_numbers
from fmtorch.data.images import stored_size
from fmtorch.data.pairs import HeldPairs, ImagePair, ImageSource, Resampling, scaled_size

FAMILIES = {"i": "illumination", "v": "viewpoint"}  # by the first letter of a sequence's name
LARGE = (  # of large images, left out by the field since D2-Net (Dusmanu et al., CVPR 2019): 108 of 116 stay
    "i_contruction", "i_crownnight", "i_dc", "i_pencils", "i_whitebuilding", "v_artisans", "v_astronautis", "v_talent",
)  # fmt: skip
SUFFIXES = (".ppm", ".png", ".jpg")
OTHERS = range(2, 7)  # images of a sequence that image 1 is paired with


class HPatchesPairs(HeldPairs):
    """Image 1 of each sequence with images 2 to 6, and the homographies ``H_1_2`` to ``H_1_6``.

    Args:
        root: the folder of the sequences, ``i_*`` (light changes) and ``v_*`` (the viewpoint does).
        sequences: names of sequences to take; None: all, without `LARGE` unless `large`.
        large: take those of large images too.
        short_side: px, to which the shorter side of each image is resized when read, and H with it; None: not at all.

    A pair's family is illumination or viewpoint, its scene the sequence. A pair with a missing image or without a sound
    homography has a `problem`. Raises DataError where root holds no sequence, or not one that was named."""

    name = "hpatches"
    model = "homography"

    def __init__(
        self, root: str | Path | None = None, sequences: Sequence[str] | None = None, large: bool = False,
        short_side: Annotated[int, Within(1)] | None = 480,
    ) -> None:  # fmt: skip
        home = given_root(root, "hpatches", "the folder of the sequences, i_* and v_*")
        there = sorted(folder.name for kind in FAMILIES for folder in home.glob(f"{kind}_*") if folder.is_dir())
        if not there:
            wanted = "folders i_* and v_*, with 1.ppm to 6.ppm and H_1_2 ..."
            raise DataError(f"{home}: no sequences; it must hold {wanted}")
        for name in sequences or ():
            if name not in there:
                raise DataError(f"{home}: no sequence {name!r}; there are: {', '.join(there[:8])} ...")
        taken = sequences or [name for name in there if large or name not in LARGE]
        digest = hashlib.blake2b(repr(short_side).encode(), digest_size=16)
        self._pairs = list[ImagePair]()
        for sequence in taken:
            for other in OTHERS:
                file = f"{sequence}/H_1_{other}"
                add_to_digest(digest, file, home / file)
                self._pairs.append(_pair(home / sequence, other, short_side))
        self.digest = digest.hexdigest()


def _pair(folder: Path, other: int, short_side: int | None) -> ImagePair:
    images = [_image(folder, number, short_side) for number in (1, other)]
    identity, family = f"HPatches/{folder.name}/1-{other}", FAMILIES[folder.name[0]]
    pair = ImagePair(identity, family, folder.name, images[0], images[1], np.zeros((3, 3)), H=np.zeros((3, 3)))
    problems = [f"no image {image.path}" for image in images if not image.path.is_file()]
    try:
        H = _homography(folder / f"H_1_{other}")
        for k, image in enumerate(images):
            if image.resampling is not None and image.size is not None:
                matrix = image.resampling.matrix(image.size)
                H = matrix @ H if k else H @ np.linalg.inv(matrix)
        pair = dataclasses.replace(pair, H=H / np.linalg.norm(H))
    except DataError as error:
        problems.append(str(error))
    return dataclasses.replace(pair, problem="; ".join(problems) or None)


def _image(folder: Path, number: int, short_side: int | None) -> ImageSource:
    paths = [folder / f"{number}{suffix}" for suffix in SUFFIXES]
    path = next((path for path in paths if path.is_file()), paths[0])
    identity = f"HPatches/{folder.name}/{number}"
    size = None if short_side is None else stored_size(path)
    if size is None or short_side is None:
        return ImageSource(identity, path)
    return ImageSource(identity, path, size, resampling=Resampling(scaled_size(size, short_side / min(size))))


def _homography(path: Path) -> Matrix:
    rows = read_numbers(path, "three numbers of H", 3)
    H = np.stack(rows) if len(rows) == 3 else np.full((3, 3), np.nan)
    if not np.isfinite(H).all() or np.linalg.det(H) == 0:
        raise DataError(f"{path}: no homography; it must hold three lines of three numbers, finite and invertible")
    return H
