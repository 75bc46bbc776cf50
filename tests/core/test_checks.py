"""The doors of public functions: NumPy and lists are taken, what does not fit is named, gradients pass."""

import pickle
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch import geometry, matching, metrics, pruning
from fmtorch.core import Correspondences
from fmtorch.core.annotations import Expected, Rule, arrays_of, expectation
from fmtorch.core.checks import checked

X = torch.rand(5, 2)
F = torch.rand(3, 3)


def distance(
    F: Float[Tensor, "*#batch 3 3"],
    x: Float[Tensor, "*#batch n 2"],
    mask: Bool[Tensor, "*#batch n"] | None = None,
    key: Int[Tensor, "*#batch"] | None = None,
    *,
    size: Real[Tensor, "*#batch 2"] | None = None,
    scale: float | Tensor = 1.0,
    steps: int = 3,
    taus: Sequence[float] = (1.0,),
    counts: Sequence[int] = (1,),
    border: Literal["a", "b"] = "a",
    name: str = "",
    cap: bool = True,
    weigh: Callable[[Tensor], Tensor] | None = None,
) -> Any:
    """What it was given."""
    return dict(locals())


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"x": X[:, :1]}, ValueError, r"x has shape \(5, 1\); it must be \(\.\.\., N, 2\)"),
        ({"x": X[0]}, ValueError, r"x has shape \(2,\); it must be \(\.\.\., N, 2\)"),
        (
            {"mask": torch.ones(4) > 0},
            ValueError,
            r"mask has shape \(4,\); it must be \(\.\.\., N\) with n = 5, as of x",
        ),
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
    assert given["F"] is F
    assert given["x"] is X
    assert given["mask"] is mask
    assert given["key"] is key
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
    arguments = checked(distance, common_type=True)(F.double(), X)
    assert arguments["x"].dtype == torch.float64
    assert checked(distance)(F.double(), X)["x"].dtype == torch.float32


def test_models_are_one_a_set_of_matches_or_several() -> None:
    x0, x1 = torch.rand(2, 4, 20, 2) * 100
    single, several = torch.rand(4, 3, 3), torch.rand(4, 6, 3, 3)
    assert geometry.refine(single, x0, x1, iterations=1).shape == single.shape
    assert geometry.refine(several, x0, x1, iterations=1).shape == several.shape
    for wrong in (torch.rand(3, 3), torch.rand(3, 3, 3), torch.rand(4, 2, 2, 3, 3)):
        with pytest.raises(ValueError, match=r"leading dimensions .*; they must be \(4,\), as of x0, or \(4,\)"):
            geometry.refine(wrong, x0, x1)


def test_annotations_are_read() -> None:
    assert expectation(Float[Tensor, "*batch n 2"] | None) == Expected(
        "array", ("*batch", "n", "2"), "Float", optional=True
    )
    rule = Rule(lambda value: value > 0, "it is positive")
    assert expectation(Annotated[Float[Tensor, " n"], rule] | None).bounds is rule
    assert expectation(Literal["a", "b"]) == Expected("choice", choices=("a", "b"))
    assert expectation(float | Tensor) == Expected("number or array", dtype="Float")
    assert expectation(Any).kind == expectation(int | str).kind == ""
    assert {name for name, field in arrays_of(Correspondences).items() if field.bounds} == {
        "score", "prior", "noise", "size0", "size1", "focal", "lens",
    }  # fmt: skip


def test_exported_functions_can_be_pickled_and_say_what_they_take() -> None:
    for module in (geometry, metrics, pruning, matching):
        for name in module.__all__:
            function = getattr(module, name)
            assert pickle.loads(pickle.dumps(function)) is not None
            if name.islower():
                assert function.__name__ == name
                assert function.__doc__
