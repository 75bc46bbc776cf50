"""Options of the engine's stages, as configs write them: a mapping for each stage, null to leave the stage out."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from fmtorch.geometry.levenberg_marquardt import LOSSES

Group = TypeVar("Group")


def _at_least(minimum: int, **values: int) -> None:
    for name, value in values.items():
        if not value >= minimum:
            raise ValueError(f"{name} is {value}; it must be at least {minimum}")


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name} is {value}; it must be positive")


@dataclasses.dataclass(frozen=True)
class Preselect:
    """A round's models compared on few matches first.

    matches: any, or for a score that weighs them by their prior such as are drawn by it, each counting as one.
    survivors: models that are scored on all matches.
    """

    matches: int = 128
    survivors: int = 256

    def __post_init__(self) -> None:
        _at_least(1, **{"preselect.matches": self.matches, "preselect.survivors": self.survivors})


@dataclasses.dataclass(frozen=True)
class Refine:
    """Levenberg-Marquardt of the robust Sampson error, from each model of the pool.

    kernel: a name of `geometry.KERNELS`. scale: its scale, Sampson distance, px. iterations: steps. matches: at most so
    many are looked at, drawn by the pair's key from those within RADIUS scales of a model of the pool; None: all.
    """

    kernel: str
    scale: float = 1.0
    iterations: int = 5
    matches: int | None = None

    RADIUS = 4.0  # scales: a match farther from all models of the pool is not looked at again

    def __post_init__(self) -> None:
        if self.kernel not in LOSSES:
            raise ValueError(f"kernel is {self.kernel!r}; it must be one of: {', '.join(LOSSES)}")
        _positive(**{"refine.scale": self.scale})
        _at_least(0, **{"refine.iterations": self.iterations})
        if self.matches is not None:
            _at_least(1, **{"refine.matches": self.matches})


@dataclasses.dataclass(frozen=True)
class Select:
    """Which refined model is the estimate: that of the largest score.

    score: a name of the registry, or a score. scale: of it, Sampson distance, px.
    """

    score: Any = "saturated"
    scale: float = 1.0

    def __post_init__(self) -> None:
        _positive(**{"select.scale": self.scale})


@dataclasses.dataclass(frozen=True)
class ExactFocals:
    """What is different where both focal lengths are exactly known: fewer models fit by accident.

    scale: of the selecting score, Sampson distance, px. sqrt_prior: whether the square root of P(inlier)
    stands for it throughout.
    """

    scale: float
    sqrt_prior: bool = False

    def __post_init__(self) -> None:
        _positive(**{"focal.exact.scale": self.scale})


@dataclasses.dataclass(frozen=True)
class Focal:
    """The prior on focal lengths, for whole photographs of known size.

    samples: of five matches, with focal lengths drawn from the prior; 0: none, the prior only selects. rounds,
    min_rounds: of so many samples, at most and at least; in between a pair goes on while its good candidates differ or
    the stopping rule asks for more. confirmations: rounds that find the best candidate of those before them again,
    after which it does not matter that others differ. pool: the best models of a round, which are refined with the
    prior. candidates: models of the other search that are, too. iterations: steps of that refinement. exact:
    `ExactFocals`; None: nothing is different.
    """

    samples: int = 250
    rounds: int = 1
    min_rounds: int = 1
    confirmations: int = 1
    pool: int = 12
    candidates: int = 12
    iterations: int = 12
    exact: ExactFocals | Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        group("focal.exact", self.exact, ExactFocals)
        if self.min_rounds > self.rounds:
            raise ValueError(f"focal.min_rounds is {self.min_rounds}; it must be at most focal.rounds, {self.rounds}")
        _at_least(0, **{"focal.samples": self.samples, "focal.iterations": self.iterations})
        _at_least(
            1,
            **{
                "focal.min_rounds": self.min_rounds,
                "focal.confirmations": self.confirmations,
                "focal.rounds": self.rounds,
                "focal.pool": self.pool,
                "focal.candidates": self.candidates,
            },
        )

    @property
    def exact_focals(self) -> ExactFocals | None:
        """The options of `exact`."""
        return group("focal.exact", self.exact, ExactFocals)


def at_least_one(**values: int) -> None:
    """Raise ValueError for a number below one."""
    _at_least(1, **values)


def group(name: str, value: object, kind: type[Group]) -> Group | None:
    """The options of a stage from a mapping, or as they are; ValueError for an unknown one, naming those there are."""
    if value is None or isinstance(value, kind):
        return value
    known = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} is {value!r}; it must be null or a mapping of: {', '.join(known)}")
    unknown = [key for key in value if key not in known]
    if unknown:
        raise ValueError(f"{name}: no option {', '.join(map(str, unknown))}; there are: {', '.join(known)}")
    missing = [key for key, f in known.items() if f.default is dataclasses.MISSING and key not in value]
    if missing:
        raise ValueError(f"{name}: {', '.join(missing)} is missing; the options are: {', '.join(known)}")
    return kind(**value)
