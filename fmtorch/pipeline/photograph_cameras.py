"""What is known of the cameras of photographs, by ``cameras=exif|shared|unknown|FILE`` or ``K=fx,fy,cx,cy``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fmtorch.data.image_cameras import ImageCameras, exif_focal
from fmtorch.data.lenses import Lens
from fmtorch.data.pairs import ImageSource
from fmtorch.runs.fingerprint import file_digest
from fmtorch.two_view.arguments import camera_fields

WORDS = ("unknown", "shared", "exif")


class PhotographCamera(NamedTuple):
    """What is known of the camera of one photograph.

    lens: its calibration, with distortion. focal: px, and its relative deviation, where that alone is known. note: what
    is said of it.
    """

    lens: Lens | None = None
    focal: tuple[float, float] | None = None
    note: str = ""


class PhotographCameras:
    """The cameras of photographs.

    Args:
        cameras: one of `WORDS`, a file of cameras (`ImageCameras`), or None where nothing is asked of them.
        K: fx, fy, cx, cy of all, px, as numbers or as a text, or None.

    Raises:
        ValueError: where both are given, or for what no camera is.
        DataError: for a file that is damaged or holds something else.
    """

    def __init__(self, cameras: Path | None = None, K: str | Sequence[float | int] | None = None) -> None:
        if K is not None and cameras is not None:
            raise ValueError("cameras and K are given; give one of them")
        self.word = str(cameras) if cameras is not None and str(cameras) in WORDS else None
        self._of_all = None if K is None else _pinhole(K)
        self._file: Path | None = None
        self._stored: ImageCameras | None = None
        self._known: dict[tuple[Path, tuple[int, int]], PhotographCamera] = {}
        if cameras is not None and self.word is None:
            if not cameras.exists():
                known_words = f"it must be {', '.join(WORDS)}, a COLMAP model or a JSON file"
                raise ValueError(f"cameras={cameras}: no such file; {known_words}. One calibration is K=fx,fy,cx,cy")
            self._file, self._stored = cameras, ImageCameras(cameras)

    @property
    def identity(self) -> dict[str, Any]:
        """What results depend on, as plain values; empty where nothing is asked of cameras."""
        if self._file is not None:
            files = sorted(self._file.iterdir()) if self._file.is_dir() else [self._file]
            digests = [file_digest(path) for path in files if path.is_file()]
            return {"cameras": {"files": digests}}
        if self._of_all is not None:
            lens = self._of_all
            return {"cameras": {"K": [lens.fx, lens.fy, lens.cx, lens.cy]}}
        return {} if self.word is None else {"cameras": self.word}

    def source(self, path: Path) -> ImageSource:
        """A photograph for `read_image`, which raises ImageError for one that is not of its camera's size."""
        return ImageSource(path.name, path, None if self._stored is None else self._stored.of(path).size)

    def of(self, path: Path, size: tuple[int, int]) -> PhotographCamera:
        """The camera of a photograph of that size (h, w)."""
        if (path, size) not in self._known:
            self._known[path, size] = self._of(path, size)
        return self._known[path, size]

    def _of(self, path: Path, size: tuple[int, int]) -> PhotographCamera:
        if self._of_all is not None:
            return PhotographCamera(self._of_all)
        if self._stored is not None:
            lens = self._stored.of(path).lens
            if lens is None or not lens.bends:
                return PhotographCamera(lens)
            what = f"{path.name}: F and the pose are of the image without the distortion of its {lens.model} lens"
            return PhotographCamera(lens, note=f"{what}; points are where they are in the photograph")
        if self.word == "exif":
            exif = exif_focal(path, size)
            if exif.known:
                return PhotographCamera(focal=(exif.focal, exif.deviation))
            return PhotographCamera(note=f"{path.name}: focal length not known: {exif.source}")
        return PhotographCamera()

    def knowledge(self, camera0: PhotographCamera, camera1: PhotographCamera) -> dict[str, Any]:
        """K0, K1, focal, lens0 and lens1 of a pair, as `fmtorch.match` takes them."""
        if self.word in ("unknown", "shared"):
            return {"focal": self.word}
        if self.word == "exif":
            measured = [camera0.focal, camera1.focal]
            return {"focal": "unknown" if measured == [None, None] else measured}
        if self._of_all is None and self._stored is None:
            return {}
        knowledge: dict[str, Any] = {}
        for i, camera in enumerate((camera0, camera1)):
            knowledge[f"K{i}"] = None if camera.lens is None else camera.lens.K
            if camera.lens is not None and camera.lens.bends:
                knowledge[f"lens{i}"] = camera.lens
        if camera0.lens is None and camera1.lens is None:
            knowledge["focal"] = "unknown"
        return knowledge

    def given(self, paths: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> dict[str, Any]:
        """What `relate` takes of a pair's cameras."""
        known = self.knowledge(*(self.of(path, size) for path, size in zip(paths, sizes, strict=True)))
        lenses = known.get("lens0"), known.get("lens1")
        fields = camera_fields(known.get("K0"), known.get("K1"), known.get("focal"), sizes_known=True)
        return {"cameras": fields, "lenses": lenses}


def _pinhole(K: str | Sequence[float | int]) -> Lens:
    """Of fx, fy, cx, cy. Raises ValueError for anything else."""
    words = K.replace(",", " ").replace("[", " ").replace("]", " ").split() if isinstance(K, str) else K
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or not all(map(math.isfinite, numbers)) or min(numbers[:2]) <= 0:
        raise ValueError(f"K={K}; it must be fx,fy,cx,cy in pixels, with positive focal lengths")
    fx, fy, cx, cy = numbers
    return Lens(fx, fy, cx, cy)
