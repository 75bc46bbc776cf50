"""Options, arguments and settings, compared with what takes them."""

from __future__ import annotations

import dataclasses
import enum
import json
import pickle
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, TypedDict, TypeVar

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float, Int, Real
from omegaconf import OmegaConf
from torch import Tensor

from fmtorch import geometry, matching, metrics, presets, pruning
from fmtorch.core import Within, checked, claim, create, expect_options, fits
from tests.helpers import in_threads, write_file

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


def takes(needed: int, /, part: Part | None = None, *, threshold: Undefined = 1.0, kind: Unknown = 3) -> None:  # type: ignore[name-defined]
    """Two annotations that only a type checker sees."""


def any_more(a: int = 0, **rest: Any) -> None: ...


class Wide:
    def __init__(self, threshold: float, first: Part = Part(), levels: int = 3) -> None: ...  # noqa: B008


@pytest.mark.parametrize(
    ("target", "values", "message"),
    [
        (Wide, {"threshold": "x"}, "here.threshold=x; it must be a number"),
        (Wide, {}, "here: threshold is missing"),
        (lambda x: x, {}, "here: x is missing. A function is called once, with the options, and returns the part"),
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


def test_a_wrong_option_is_refused_before_anything_within_is_built() -> None:
    network = {"_target_": "torch.nn.Linear", "in_features": "x"}
    config = {"_target_": "fmtorch.pruning.LearnedPruner", "network": network}
    with pytest.raises(ValueError, match=r"pruner\.mine\.network: out_features is missing"):
        presets.instantiate(config, "pruner.mine")
    config["network"] = {**network, "out_features": 2}
    with pytest.raises(ValueError, match=r"pruner\.mine\.network\.in_features=x; it must be a whole number"):
        presets.instantiate(OmegaConf.create(config), "pruner.mine")
    with pytest.raises(ValueError, match="estimator=fmtorch: hypotheses=many; it must be a whole number"):
        presets.build("estimator", "fmtorch", hypotheses="many")


def test_fields_of_a_base_in_another_module_are_checked() -> None:
    """Their annotations are names of the module where the base is."""
    from fmtorch.commands import MatchOptions

    class Fields(MatchOptions):
        pass

    expect_options(Fields, {"camera": "shared", "longest_side": 800}, "")
    with pytest.raises(ValueError, match="camera=mine; it must be one of: per_image, shared"):
        expect_options(Fields, {"camera": "mine"}, "")
    with pytest.raises(ValueError, match="longest_side=0; it must be a whole number of at least 1"):
        expect_options(Fields, {"longest_side": 0}, "")


X = torch.rand(5, 2)
F = torch.rand(3, 3)


def distance(
    F: Float[Tensor, "*#batch 3 3"], x: Float[Tensor, "*#batch n 2"], mask: Bool[Tensor, "*#batch n"] | None = None,
    key: Int[Tensor, "*#batch"] | None = None, *, size: Real[Tensor, "*#batch 2"] | None = None,
    scale: float | Tensor = 1.0, steps: int = 3, taus: Sequence[float] = (1.0,), counts: Sequence[int] = (1,),
    border: Literal["a", "b"] = "a", name: str = "", cap: bool = True, weigh: Callable[[Tensor], Tensor] | None = None,
) -> Any:  # fmt: skip
    return dict(locals())


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"x": X[:, :1]}, ValueError, r"x has shape \(5, 1\); it must be \(\.\.\., N, 2\)"),
        ({"x": X[0]}, ValueError, r"x has shape \(2,\); it must be \(\.\.\., N, 2\)"),
        ({"mask": torch.ones(4) > 0}, ValueError, r"mask has shape \(4,\); it must be \(.*, N\) with n = 5, as of x"),
        ({"F": F.expand(2, 3, 3), "x": X.expand(3, 5, 2)}, ValueError, r"x .* broadcast with \(2,\), as of F"),
        ({"mask": torch.ones(5)}, ValueError, "mask is of torch.float32; it must hold booleans"),
        ({"key": torch.tensor(0.5)}, ValueError, "key is of torch.float32; it must hold whole numbers"),
        ({"x": X > 0}, ValueError, "x is of torch.bool; it must hold floating-point numbers"),
        ({"x": X.to(torch.complex64)}, ValueError, "x is of torch.complex64"),
        ({"size": torch.ones(2) > 0}, ValueError, "size is of torch.bool; it must hold real numbers"),
        ({"x": X.to("meta")}, ValueError, "x is on meta and another argument on cpu; all must be on one device"),
        ({"x": "points"}, TypeError, "x is a str"),
        ({"x": None}, TypeError, "x is a NoneType"),
        ({"scale": "1"}, TypeError, "scale is '1'; it must be a number"),
        ({"scale": float("nan")}, ValueError, "scale is nan; it must be a number"),
        ({"steps": 2.5}, TypeError, "steps is 2.5; it must be a whole number"),
        ({"steps": True}, TypeError, "steps is True; it must be a whole number"),
        ({"steps": None}, TypeError, "steps is a NoneType; it must be a whole number"),
        ({"taus": 3}, TypeError, "taus is a int; it must be a sequence of numbers"),
        ({"taus": (1.0, "b")}, TypeError, r"taus\[1\] is 'b'; it must be a number"),
        ({"counts": (1, 2.5)}, TypeError, r"counts\[1\] is 2.5; it must be a whole number"),
        ({"border": "c"}, ValueError, "border is 'c'; it must be one of 'a', 'b'"),
        ({"name": 3}, TypeError, "name is a int; it must be a string"),
        ({"cap": 1}, TypeError, "cap is a int; it must be True or False"),
        ({"weigh": 3}, TypeError, "weigh is a int; it must be a function"),
    ],
)
def test_what_does_not_fit_is_named(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        checked(distance)(**{"F": F, "x": X, **arguments})


def test_what_fits_is_handed_on_as_it_is() -> None:
    mask, key = torch.ones(5, dtype=torch.bool), torch.tensor(3)
    given = checked(distance)(F, X, mask, key=key, scale=X[0, 0], steps=4)
    for name, value in {"F": F, "x": X, "mask": mask, "key": key}.items():
        assert given[name] is value
    assert given["scale"] is not None
    assert given["steps"] == 4


def test_what_can_be_converted_is() -> None:
    given = checked(distance)(
        F.numpy(), X.round().int().tolist(), np.array([1, 0, 1, 1, 0], np.uint8), size=(480, 640), steps=np.int64(2),
        scale=np.float32(0.5), taus=np.array([0.5, 0.7]),
    )  # fmt: skip
    assert torch.equal(given["F"], F)
    assert given["x"].dtype == torch.float64
    assert given["mask"].tolist() == [True, False, True, True, False]
    assert given["size"].tolist() == [480, 640]
    assert (given["steps"], given["scale"], given["taus"]) == (2, 0.5, (0.5, 0.7))
    assert checked(distance)(F, X.half())["x"].dtype == torch.float32
    assert checked(distance)(F.double(), X)["x"].dtype == torch.float64


def test_models_are_one_a_set_of_matches_or_several() -> None:
    x0, x1 = torch.rand(2, 4, 20, 2) * 100
    single, several = torch.rand(4, 3, 3), torch.rand(4, 6, 3, 3)
    assert geometry.refine(single, x0, x1, iterations=1).shape == single.shape
    assert geometry.refine(several, x0, x1, iterations=1).shape == several.shape
    for wrong in (torch.rand(3, 3), torch.rand(3, 3, 3), torch.rand(4, 2, 2, 3, 3)):
        with pytest.raises(ValueError, match=r"leading dimensions .*; they must be \(4,\), as of x0, or \(4,\)"):
            geometry.refine(wrong, x0, x1)


def test_exported_functions_can_be_pickled_and_say_what_they_take() -> None:
    for module in (geometry, metrics, pruning, matching):
        for name in module.__all__:
            function = getattr(module, name)
            assert pickle.loads(pickle.dumps(function)) is not None
            if name.islower():
                assert function.__name__ == name
                assert function.__doc__


def claimed(folder: Path, settings: dict[str, object], alone: bool = True) -> None:
    claim(folder / "settings.json", settings, "sketches", "choose another output", alone)


def test_a_folder_is_created_and_opened_again(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    write_file(folder / "settings.json.0123.tmp", "{")  # what a killed writer left is nothing
    for _ in range(2):
        claimed(folder, {"seed": 0, "network": {"blocks": 2}})
    (folder / "sketch").write_text("done")
    claimed(folder, {"network": {"blocks": 2}, "seed": 0})
    assert json.loads((folder / "settings.json").read_text()) == {"seed": 0, "network": {"blocks": 2}}


def test_anything_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"no settings\.json, so it holds no sketches \(it holds notes\.txt\); choose"):
        claimed(tmp_path, {})
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    claimed(tmp_path, {}, alone=False)
    (tmp_path / "settings.json").write_text("{")
    with pytest.raises(ValueError, match=r"settings\.json is not valid JSON"):
        claimed(tmp_path, {})
    with pytest.raises(ValueError, match=r"notes\.txt is a file; choose another output"):
        claimed(tmp_path / "notes.txt", {})


def test_of_several_writers_the_first_wins(tmp_path: Path) -> None:
    in_threads(8, lambda i: create(tmp_path / "file", str(i) * 10_000))
    (file,) = tmp_path.iterdir()
    assert len(set(file.read_text())) == 1
