"""Runs whose estimator is given what is known of each pair's cameras: ``cameras=known``, ``shared``, ``exif``."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from fmtorch.core.stages import Estimator
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data.image_cameras import exif_focal
from fmtorch.data.pairs import ImagePair
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.two_view.known_cameras import KnownCameras

Cameras = Literal["known", "shared", "exif", "unknown"]
UNKNOWN, EXACT = (1.0, math.inf), (1.0, 0.0)  # px, relative deviation; K stands for the pixels of an exact one


class PairCameras(NamedTuple):
    """What an estimator is given of a pair, fields of `Correspondences`: K0, K1 (3, 3), focal (2, 2), shared_focal."""

    K0: Tensor | None
    K1: Tensor | None
    focal: Tensor
    shared_focal: bool


def cameras_of(pairs: Sequence[ImagePair], cameras: Cameras) -> dict[int, PairCameras]:
    """What is known of the cameras of pairs, by their keys.

    known: their calibrations. exif: the focal lengths in the files of their images, unknown where there are none.
    shared: that both images of a pair are of one camera. unknown: nothing.
    Raises ValueError for `known` where a pair has no calibration.
    """
    if cameras == "known":
        return {pair.key: _calibrated(pair) for pair in pairs if pair.problem is None}
    if cameras == "exif":
        measured = functools.cache(_measured)
        ends = ((pair.key, [measured(image.path) for image in (pair.image0, pair.image1)]) for pair in pairs)
        return {key: PairCameras(None, None, _two(*focals), False) for key, focals in ends}
    nothing = PairCameras(None, None, _two(UNKNOWN, UNKNOWN), cameras == "shared")
    return {pair.key: nothing for pair in pairs}


def _calibrated(pair: ImagePair) -> PairCameras:
    if pair.K0 is None or pair.K1 is None:
        raise ValueError(f"cameras=known, but the data set has no calibration of pair {pair.identity}; give another")
    K0, K1 = (torch.from_numpy(K).to(torch.float64) for K in (pair.K0, pair.K1))
    return PairCameras(K0, K1, _two(EXACT, EXACT), False)


def _measured(path: Path) -> tuple[float, float]:
    exif = exif_focal(path)
    return (exif.focal, exif.deviation) if exif.known else UNKNOWN


def _two(first: tuple[float, float], second: tuple[float, float]) -> Tensor:
    return torch.tensor([first, second], dtype=torch.float64)


class WithPairCameras:
    """An estimator that is given the cameras of each pair, which it finds by the pairs' keys."""

    model = "fundamental"

    def __init__(self, estimator: Estimator, cameras: Mapping[int, PairCameras]) -> None:
        """cameras: of `cameras_of`, of all pairs that will come; or they are added before their pairs come."""
        self._estimator, self.cameras = KnownCameras(estimator), dict(cameras)

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate F, focal lengths and pose of each pair."""
        return self._estimator(self.given(c), seed)

    @property
    def kernels(self) -> Sequence[object]:
        """Those of the estimator worth compiling together."""
        return getattr(self._estimator.estimator, "kernels", ())

    def given(self, c: Correspondences) -> Correspondences:
        """The matches with what is known of their cameras."""
        own = [self.cameras[key] for key in c.keys.tolist()]
        K0, K1 = (_stacked(K, c.mask.device) for K in ([each.K0 for each in own], [each.K1 for each in own]))
        focal = torch.stack([each.focal for each in own]).to(c.mask.device)
        shared = torch.tensor([each.shared_focal for each in own], device=c.mask.device)
        return c.derived(K0=K0, K1=K1, focal=focal, shared_focal=shared)


def _stacked(K: Sequence[Tensor | None], device: torch.device) -> Tensor | None:
    """The calibrations (B, 3, 3) of a run, of whose pairs all have one, or none."""
    given = [each for each in K if each is not None]
    return torch.stack(given).to(device) if given else None


def built_with(build: Callable[[], Pipeline], cameras: Mapping[int, PairCameras]) -> Pipeline:
    """A pipeline whose estimator is given the cameras of each pair."""
    pipeline = build()
    pipeline.estimator = WithPairCameras(pipeline.estimator, cameras)
    return pipeline
