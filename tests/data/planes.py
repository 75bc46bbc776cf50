"""A small HPatches: shared photographs seen as planes, in the layout of the released sequences."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from tests.conftest import shared_path

SIZE = (320, 480)  # (h, w) of image 1


def view(seed: int, strength: float = 0.15) -> np.ndarray:
    """A homography that moves each corner by up to a share of the sides."""
    rng = np.random.default_rng(seed)
    h, w = SIZE
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
    moved = corners + rng.uniform(-strength, strength, (4, 2)).astype(np.float32) * [w, h]
    return cv2.getPerspectiveTransform(corners, moved.astype(np.float32))


def write_sequence(folder: Path, photograph: str, light: bool, count: int = 6, suffix: str = ".ppm") -> Path:
    """A sequence: image 1, and images 2 to 6 of other light or another viewpoint."""
    folder.mkdir(parents=True)
    picture = cv2.imread(str(shared_path(f"data/photos/{photograph}")))
    image = cv2.resize(picture, SIZE[::-1], interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(folder / f"1{suffix}"), image)
    for k in range(2, count + 1):
        H = np.eye(3) if light else view(k)
        seen = np.clip(image * (1.1 - 0.1 * k) + 5 * k, 0, 255).astype(np.uint8) if light else image
        cv2.imwrite(str(folder / f"{k}{suffix}"), cv2.warpPerspective(seen, H, SIZE[::-1]))
        rows = (" ".join(f"{value:.10g}" for value in row) for row in H)
        (folder / f"H_1_{k}").write_text("\n".join(rows) + "\n")
    return folder


def write_hpatches(root: Path, photographs: Sequence[str] = ("0000.jpg", "0003.jpg")) -> Path:
    write_sequence(root / "i_light", photographs[0], light=True)
    write_sequence(root / "v_view", photographs[1], light=False)
    return root
