"""Options of the engine's stages, as configs write them: a mapping for each stage, null to leave the stage out.

The annotations say what each may be; `fmtorch.core.options.expect_options` checks them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

from fmtorch.core.options import Within

Stage = TypeVar("Stage")

Count = Annotated[int, Within(1)]
NonNegative = Annotated[int, Within(0)]
Pixels = Annotated[float, Within(0, exclusive=True)]


@dataclasses.dataclass(frozen=True)
class Preselect:
    """A round's models compared on few matches first.

    matches: any, or for a score that weighs them by their prior such as are drawn by it, each counting as one.
    survivors: models that are scored on all matches.
    """

    matches: Count = 128
    survivors: Count = 256


@dataclasses.dataclass(frozen=True)
class Refine:
    """Levenberg-Marquardt of the robust Sampson error, from each model of the pool.

    loss: a name of `geometry.LOSSES`. scale: its scale, Sampson distance, px. iterations: steps. matches: at most so
    many are looked at, drawn by the pair's key from those within RADIUS scales of a model of the pool; None: all.
    """

    loss: Literal["huber", "cauchy", "geman_mcclure", "truncated", "magsac"]
    scale: Pixels = 1.0
    iterations: NonNegative = 5
    matches: Count | None = None

    RADIUS = 4.0  # scales: a match farther from all models of the pool is not looked at again


@dataclasses.dataclass(frozen=True)
class Select:
    """Which refined model is the estimate: that of the largest score.

    score: a name of the registry, or a score. scale: of it, Sampson distance, px. own_noise: the choice is made again
    with so many standard deviations of the noise of the matches near the first for a scale; None: it is made once.
    """

    score: Any = "saturated"
    scale: Pixels = 1.0
    own_noise: Pixels | None = None


@dataclasses.dataclass(frozen=True)
class Focal:
    """The prior on focal lengths, for whole photographs of known size.

    samples: of five matches, with focal lengths drawn from the prior; 0: none, the prior only selects. rounds,
    min_rounds: of so many samples, at most and at least; in between a pair goes on while its good candidates differ or
    the stopping rule asks for more. confirmations: rounds that find the best candidate of those before them again,
    after which it does not matter that others differ. pool: the best models of a round, which are refined with the
    prior. candidates: models of the other search that are, too. iterations: steps of that refinement. sqrt_prior:
    whether the root of P(inlier) stands for it in samples and scores, but not in fits.
    """

    samples: NonNegative = 250
    rounds: Count = 1
    min_rounds: Count = 1
    confirmations: Count = 1
    pool: Count = 12
    candidates: Count = 12
    iterations: NonNegative = 12
    sqrt_prior: bool = False

    def __post_init__(self) -> None:
        if self.min_rounds > self.rounds:
            raise ValueError(f"focal.min_rounds is {self.min_rounds}; it must be at most focal.rounds, {self.rounds}")


def stage(options: Stage | Mapping[str, Any] | None, kind: type[Stage]) -> Stage | None:
    """The options of a stage, from a mapping or as they are."""
    return kind(**options) if isinstance(options, Mapping) else options
