"""The photographs inside the scikit-image package, shared out between the splits; read from disk, never downloaded."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
from PIL import Image

from fmtorch.data.rendered.mipmap import Pixels

# No photograph serves two splits; the motorcycle stays with `StereoPair`.
PICTURES = {
    "test": ("astronaut.png", "coffee.png", "hubble_deep_field.jpg", "coins.png", "page.png", "camera.png"),
    "train": ("chelsea.png", "rocket.jpg", "ihc.png", "retina.jpg", "text.png", "clock_motion.png", "moon.png"),
}
MATERIALS = {"test": {"stone": "brick.png", "ground": "grass.png"}, "train": {"stone": "gravel.png", "ground": ""}}


def skimage_file(name: str) -> Path:
    """The path of a file in scikit-image's data folder; FileNotFoundError names it where it is absent."""
    spec = importlib.util.find_spec("skimage")
    if spec is None or not spec.submodule_search_locations:
        raise FileNotFoundError(f"{name} belongs to the scikit-image package, which is not installed")
    path = Path(spec.submodule_search_locations[0]) / "data" / name
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is absent: this installation of scikit-image does not hold it (release 0.26 does); "
            "nothing is downloaded"
        )
    return path


def photograph(name: str) -> Pixels:
    """A photograph as RGB (h, w, 3)."""
    with Image.open(skimage_file(name)) as picture:
        return np.array(picture.convert("RGB"), dtype=np.uint8)


def pictures(split: str, rng: np.random.Generator, count: int) -> list[Pixels]:
    """Some of a split's photographs in random order, cropped and mirrored at random."""
    names = PICTURES[split]
    out = []
    for i in rng.permutation(max(count, len(names)))[:count]:
        picture = photograph(names[int(i) % len(names)])
        h, w = picture.shape[:2]
        part = rng.uniform(0.7, 1.0)
        ch, cw = int(h * part), int(w * part)
        y, x = int(rng.integers(h - ch + 1)), int(rng.integers(w - cw + 1))
        picture = picture[y : y + ch, x : x + cw]
        out.append(np.ascontiguousarray(picture[:, ::-1] if rng.random() < 0.5 else picture))
    return out


def material(split: str, kind: str) -> Pixels | None:
    """A photograph of `stone` or `ground`, made to repeat by mirroring; None where the split has none."""
    name = MATERIALS[split][kind]
    if not name:
        return None
    picture = photograph(name)
    picture = np.concatenate([picture, picture[:, ::-1]], axis=1)
    return np.ascontiguousarray(np.concatenate([picture, picture[::-1]], axis=0))
