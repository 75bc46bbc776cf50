"""Options are compared with the signature of what takes them, whatever it is."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, TypedDict, TypeVar

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from fmtorch import presets
from fmtorch.core.options import Within, expect_options, fits, nearest

Item = TypeVar("Item")


class Colour(enum.Enum):
    RED = "red"


class Stage(Protocol):
    def __call__(self, x: int) -> int: ...


class Table(TypedDict):
    rows: int


@dataclasses.dataclass
class Part:
    matches: int = 64
    scale: float | None = None


OBJECT = {"_target_": "any.Thing"}


@pytest.mark.parametrize(
    ("annotation", "right", "wrong"),
    [
        (int, [0, -3], [True, 1.0, "1", None, [1], {}]),
        (float, [1, 0.5, float("inf")], [True, "high", None, [0.5], float("nan")]),
        (bool, [True], [0, 1, "yes", None]),
        (str, ["", "1"], [1, None, True, ["a"]]),
        (int | None, [None, 3], ["none", 2.5]),
        (Path, ["a/b"], [3, None, ["a"]]),
        (Path | str | None, ["a", None], [3]),
        (Literal["x", 2], ["x", 2], ["y", 3, None]),
        (Annotated[int, Within(1, 5)], [1, 5], [0, 6, 2.0, "x"]),
        (Annotated[float, Within(0, 1, exclusive=True)], [0.5, np.float32(0.5)], [0, 1, -1, 2.0, np.float32(0)]),
        (Annotated[float, Within(maximum=1)] | None, [None, -2, 1], [1.5, "x"]),
        (list[int], [[], [1, 2]], [[1.5], 1, "12", {}]),
        (Sequence[str], [["a"], ("a",)], ["abc", [1], None]),
        (tuple[float, float], [[0, 1.5]], [[1], [1, 2, 3], ["a", "b"], 1]),
        (tuple[int, ...], [[], [1, 2, 3]], [["a"], 1]),
        (Mapping[str, Any], [{"a": 1}], [[1], "a", 1]),
        (dict[str, int], [{"a": 1}], [[1], "a"]),
        (Colour, ["red"], [1, None]),
        (Callable[[int], int], [OBJECT, abs], ["abs", 1, None]),
        (torch.nn.Module, [OBJECT, torch.nn.Identity()], ["Identity", 1, None, [1]]),
        (torch.device | str, ["cpu", torch.device("cpu")], [0, None]),
        (Any, [1, "a", None, [1], {}], []),
        (object, [1, "a", None, [1], {}], []),
        (Item, [1, "a", None, [1]], []),
        (Stage, [OBJECT, abs], []),
        (Table, [{"rows": 1}], []),
    ],
)
def test_what_fits_an_annotation(annotation: Any, right: list[Any], wrong: list[Any]) -> None:
    assert [value for value in right if not fits(value, annotation)] == []
    assert [value for value in wrong if fits(value, annotation)] == []


def takes(needed: int, /, part: Part | None = None, *, threshold: Real = 1.0, kind: Unknown = 3) -> None:  # type: ignore[name-defined]
    """Two annotations that only a type checker sees."""


def any_more(a: int = 0, **rest: Any) -> None: ...


class Wide:
    def __init__(self, threshold: float, first: Part = Part(), levels: int = 3) -> None: ...  # noqa: B008


@pytest.mark.parametrize(
    ("target", "values", "message"),
    [
        (Wide, {"threshold": "x"}, "here.threshold=x; it must be a number"),
        (Wide, {}, "here: threshold is missing"),
        (Wide, {"threshold": 1, "level": 2}, "here: no option level; there are: levels, "),
        (Wide, {"threshold": 1, "first": {"matches": "all"}}, "here.first.matches=all; it must be a whole number"),
        (Wide, {"threshold": 1, "first": {"match": 3}}, "here.first: no option match; there are: matches, scale"),
        (Wide, {"threshold": 1, "first": 3}, "here.first=3; it must be a mapping of: matches, scale"),
        (takes, {"needed": 1, "part": {"scale": [1]}}, r"here.part.scale=\[1\]; it must be a number or null"),
        (any_more, {"a": None, "b": 1}, "here.a=null; it must be a whole number"),
    ],
)
def test_what_is_wrong_is_named(target: Callable[..., Any], values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        expect_options(target, values, "here")


def test_what_cannot_be_known_is_taken_on_trust() -> None:
    expect_options(takes, {"needed": 1, "threshold": "x", "kind": "y", "part": None}, "here")
    expect_options(any_more, {"b": object()}, "here")
    expect_options(Wide, {"first": {"scale": 2}}, "here", given=("threshold",))
    expect_options(Wide, {"threshold": 1, "first": OBJECT}, "here")


def test_names_are_told_nearest_first_and_of_many_a_few() -> None:
    assert nearest("lmed", ["ransac", "lmeds", "msac"]).startswith("lmeds, ")
    assert nearest("x7", [f"x{i}" for i in range(30)]).startswith("x7, ")
    assert nearest("x7", [f"x{i}" for i in range(30)]).endswith(" and 18 more")


@pytest.mark.parametrize("group", ["features", "matcher", "pruner", "estimator"])
def test_every_preset_fits_what_it_builds(group: str) -> None:
    for name in presets.available(group):
        presets.expect_buildable(presets.load(group, name), f"{group}={name}")


def test_a_wrong_option_is_refused_before_anything_within_is_built() -> None:
    config = {
        "_target_": "fmtorch.pruning.LearnedPruner",
        "network": {"_target_": "torch.nn.Linear", "in_features": "x"},
    }
    with pytest.raises(ValueError, match=r"pruner\.mine\.network: out_features is missing"):
        presets.instantiate(config, "pruner.mine")
    config["network"] = {"_target_": "torch.nn.Linear", "in_features": "x", "out_features": 2}
    with pytest.raises(ValueError, match=r"pruner\.mine\.network\.in_features=x; it must be a whole number"):
        presets.instantiate(OmegaConf.create(config), "pruner.mine")
    with pytest.raises(ValueError, match="estimator=fmtorch: hypotheses=many; it must be a whole number"):
        presets.build("estimator", "fmtorch", hypotheses="many")


def test_fields_of_a_base_in_another_module_are_checked() -> None:
    """Their annotations are names of the module where the base is."""
    from fmtorch.commands.options import MatchOptions

    class Fields(MatchOptions):
        pass

    expect_options(Fields, {"camera": "shared", "longest_side": 800}, "")
    with pytest.raises(ValueError, match="camera=mine; it must be one of: per_image, shared"):
        expect_options(Fields, {"camera": "mine"}, "")
    with pytest.raises(ValueError, match="longest_side=0; it must be a whole number of at least 1"):
        expect_options(Fields, {"longest_side": 0}, "")
