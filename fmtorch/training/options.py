"""What `fmtorch train` takes beside groups of presets: each option with its type, default and help, declared once.

Nothing here imports a library, for which ``--help`` would wait."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from fmtorch.core import Within, expect_options
from fmtorch.core.options import CACHE, CACHE_LIMIT, DEBUG, Cache, Count, Debug, Gigabytes, Seed, option

Real = float | int
Range = Sequence[Real]  # the least and the most
Weight = Annotated[float, Within(0)]
Probability = Annotated[Real, Within(0, 1)]


@dataclasses.dataclass(frozen=True)
class PlaneViews:
    """How views of photographs, as planes, are drawn; ranges are uniform, of ratios in their logarithm."""

    views: Annotated[int, Within(2)] = option(5, "of each photograph, drawn on first use; every two of them are a pair")
    tilt: Annotated[Real, Within(0, 80)] = option(60.0, "degrees of the optical axis to the plane's normal, at most")
    roll: Annotated[Real, Within(0)] = option(15.0, "degrees, standard deviation of the turn about the axis")
    part: tuple[Real, Real] = option((0.5, 1.0), "of the photograph's width that a view spans")
    scale: tuple[Real, Real] = option((0.7, 1.0), "sides of a view, of the photograph's")
    focal: tuple[Real, Real] = option((0.7, 1.8), "in widths of the view")

    def __post_init__(self) -> None:
        expect_options(type(self), vars(self), "planes")
        for name in ("part", "scale", "focal"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"planes.{name}={[low, high]}; it must be two positive numbers, the smaller first")


@dataclasses.dataclass(frozen=True)
class Planes(PlaneViews):
    """Photographs to train on as planes: their matches train the classification alone."""

    photographs: Path | None = option(None, "folder of photographs; null: none")
    seed: Seed = option(0, "of the views")

    @property
    def limits(self) -> PlaneViews:
        return PlaneViews(**{field.name: getattr(self, field.name) for field in dataclasses.fields(PlaneViews)})


@dataclasses.dataclass(frozen=True)
class Optimisation:
    """Adam (Kingma & Ba, ICLR 2015) at a constant rate that falls linearly to zero over the last part of the steps."""

    learning_rate: Annotated[float, Within(0, exclusive=True)] = option(
        1e-3, "Adam, as in Yi et al. 2018's code; the 1e-4 that one paper states is known to be a mistake"
    )
    weight_decay: Weight = option(0.0, "L2 penalty of the parameters")
    steps: Count = option(2500, "in all")
    decay: Probability = option(0.5, "share of the steps, at the end, over which the learning rate falls to zero")

    def __post_init__(self) -> None:
        expect_options(type(self), vars(self), "optimisation")

    def factor(self, step: int) -> float:
        """What the learning rate is multiplied by at a step."""
        return min(1.0, max((self.steps - step) / max(self.decay * self.steps, 1), 0.0))


@dataclasses.dataclass(frozen=True)
class ObjectiveWeights:
    """The terms of the loss and their weights."""

    classification: Weight = option(
        1.0, "weight of the cross-entropy of P(inlier) (Yi et al., CVPR 2018, eq. 7, without class balance)"
    )
    geometric: Weight = option(
        0.5,
        "weight of the symmetric epipolar distance of virtual points of the true geometry to the weighted 8-point fit "
        "(Ranftl & Koltun, ECCV 2018; clamped as by Zhang et al., ICCV 2019)",
    )
    nsgd: Weight = option(0.0, "weight of NSGD between that fit and the truth, in image diagonals")
    nsgd_limit: float | None = option(0.2, "of a pair's NSGD, beyond which it has no gradient")
    coordinates: Literal["size", "K"] = option(
        "size", "unit of the geometric term: size (half the longest side, clamped at 0.03) or K (focal lengths, at 0.1)"
    )
    classification_steps: Annotated[int, Within(0)] = option(
        500, "steps of classification alone, before the other two terms come in"
    )
    points: Count = option(100, "virtual points of a pair")

    def __post_init__(self) -> None:
        expect_options(type(self), vars(self), "objective")
        if not max(self.classification, self.geometric, self.nsgd) > 0:
            raise ValueError("objective: at least one of classification, geometric and nsgd must have a weight")


@dataclasses.dataclass(frozen=True)
class AugmentationOptions:
    """Random changes of a pair's labelled matches, after which the truth is still true; None turns a change off."""

    swap: Probability = option(0.5, "probability that the images change places")
    quarter_turn: Probability = option(0.1, "probability, for each image, of a turn by 90, 180 or 270 degrees")
    turn: Probability = option(0.2, "or else by any angle,")
    angle: Real = option(45.0, "degrees, either way, at most")
    crop: Probability = option(0.3, "probability, for each image, of a crop, which moves the principal point")
    crop_side: Range = option((0.6, 1.0), "sides of a crop, of the image's")
    ratio: Range | None = option((0.8, 1.0), "threshold of the ratio test")
    thin: Probability = option(0.5, "probability that inliers or outliers are thinned")
    inlier_share: Range = option((0.05, 0.95), "to a share of inliers in this range")
    noise: Range | None = option((0.0, 0.5), "px, standard deviation of the error added to both points")
    matches: Sequence[int] | None = option(
        (50, 1000), "a batch's pairs are cut to a number in this range, uniform in its logarithm; up to 4,000"
    )

    def __post_init__(self) -> None:
        expect_options(type(self), vars(self), "augmentation")
        if self.quarter_turn + self.turn > 1:
            raise ValueError("quarter_turn and turn exclude each other: together they are at most 1")
        for name, low, high in (
            ("crop_side", 0.0, 1.0), ("ratio", 0.0, 1.0), ("inlier_share", 0.0, 1.0), ("noise", 0.0, math.inf),
            ("matches", 1, math.inf),
        ):  # fmt: skip
            range_ = getattr(self, name)
            if range_ is not None and not low <= range_[0] <= range_[1] <= high:
                raise ValueError(f"{name} is {tuple(range_)}; it must be a range (least, most) within {low} and {high}")


@dataclasses.dataclass(frozen=True)
class ValidationOptions:
    """How a training is validated."""

    every: Count = option(250, "steps")
    scenes: Count | None = option(
        None, "the last training scenes of each family, not trained on; null: 4, a quarter where it has fewer than 16"
    )
    roots: list[str] = option([], "further sets: folders in the layout of fmbench, files of OANet's or folders of some")
    pairs: Count = option(25, "of each family at most")
    ratio: float = option(0.8, "threshold of the ratio test")
    uses: Mapping[str, Any] = option(
        {
            "hard": {"estimator": "ransac_eight_point", "threshold": 0.5},
            "prior": {"estimator": "fmtorch", "threshold": None},
        },
        "how P(inlier) is used: a threshold on it before an estimator, or as the estimator's prior",
    )
    monitor: str = option(
        "log_loss", "the figure that chooses the best weights; AUC@0.05 of a hundred pairs moves by chance"
    )
    patience: Count | None = option(None, "validations without a better figure that end the training; null: never")


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """What `fmtorch train` takes."""

    planes: Planes = option(Planes(), "photographs to train on too, as planes")
    before: list[str] = option(
        ["one_to_one"], "pruners before the trained one, by name; the ratio test is part of the augmentation"
    )
    labels: Literal["pixels", "geodesic"] = option(
        "pixels", "pixels: by depth or the epipolar lines; geodesic: OANet's distance below 1e-4, of known cameras"
    )
    limit: Count | None = option(None, "train on so many pairs of each family")
    seed: Seed = option(0, "of the first weights, of batches and augmentation")
    output: Path | None = option(None, "null: runs/train/<pruner>-<first digits of what defines the training>")
    cache: Cache = option(None, CACHE)
    cache_limit: Gigabytes | None = option(20, CACHE_LIMIT)
    workers: Count | None = option(None, "short for executor.workers, which compute matches; null: one for each core")
    loaders: Annotated[int, Within(0)] = option(0, "processes that load batches; 0: the training's own")
    threads: Count | None = option(None, "of torch; null: one for each core. The weights' last bits depend on it")
    batch: Count = option(32, "pairs a step (Yi et al., CVPR 2018)")
    optimisation: Optimisation = option(Optimisation(), "Adam, whose rate falls at the end")
    objective: ObjectiveWeights = option(ObjectiveWeights(), "what is minimised")
    augmentation: AugmentationOptions = option(AugmentationOptions(), "of matches; null turns a change off")
    validation: ValidationOptions = option(ValidationOptions(), "through estimators")
    checkpoint_every: Count = option(100, "steps")
    debug: Debug = option(False, DEBUG)
