"""What a family makes: geometry, lights and shots; the generator draws them and keeps the matchable pairs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from fmtorch.scenes.camera import Camera
from fmtorch.scenes.light import Lens, Light
from fmtorch.scenes.surfaces import Surfaces
from fmtorch.scenes.textures import Pixels


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """One photograph to take. `camera` is the ground truth; `moments` the cameras during a long exposure."""

    camera: Camera
    lens: Lens
    light: int = 0
    moments: Sequence[Camera] = ()
    jpeg: int = 95  # quality


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Surfaces (one list for each light: what moves is not in all of them), lights, a sky, shots, candidate pairs.

    pairs: the pairs to try, most wanted first.
    """

    surfaces: Sequence[Surfaces]
    lights: Sequence[Light]
    sky: Pixels
    shots: Sequence[Shot]
    pairs: Sequence[tuple[int, int]]
