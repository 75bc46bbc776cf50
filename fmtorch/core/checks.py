"""What arguments may be, checked where a user's come in: shapes, types of numbers, devices, values.

Annotations are the source: ``Float[Tensor, "*batch n 2"]`` is both what a reader sees and what is asked for."""

import functools
import inspect
import math
import operator
import sys
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.records import WHOLE, Expected, arguments_of, numbers_of
from fmtorch.core.types import SIZE

P = ParamSpec("P")
R = TypeVar("R")

WIDENED = (torch.float16, torch.bfloat16, torch.float8_e4m3fn, torch.float8_e5m2)  # too narrow to decompose matrices
MODELS, SETS = "models", "batch"  # leading dimensions of F and of the matches it is fitted to: one F a set, or several


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which takes NumPy arrays and lists for tensors and names what does not fit its annotations.
    Whole numbers become float64 where the annotation asks for floating-point ones, and half precision is widened to
    float32. Arrays go to the device of the first tensor. Where everything fits, the function gets what it was given.
    Floating-point tensors of several types are brought to the widest one. Raises (beside what the function itself
    raises) TypeError for what is no array or number, ValueError for a shape, a type of numbers or a device that
    does not fit; the message begins with the argument's name."""
    signature = inspect.signature(function)
    expected = functools.cache(functools.partial(arguments_of, function))

    @functools.wraps(function)
    def door(*args: P.args, **kwargs: P.kwargs) -> R:
        call = signature.bind(*args, **kwargs)
        values = call.arguments
        device = next((value.device for value in values.values() if isinstance(value, Tensor)), torch.device("cpu"))
        tensors = {}
        for name, want in expected().items():
            if name not in values or (values[name] is None and want.optional):
                continue
            values[name] = value = _checked_value(name, values[name], want, device)
            if want.kind == "array":
                tensors[name] = value
        _expect_shapes(tensors, expected())
        values.update(_common_type(tensors, expected()))
        return function(*call.args, **call.kwargs)

    return door


def as_tensor(value: Any, name: str) -> Tensor:
    """A tensor of real numbers, of an array or what DLPack shares without copying; points (N, 2) of OpenCV's keypoints.
    Raises TypeError, naming the argument, for anything else, and ValueError for a masked array that masks something."""
    if isinstance(value, Tensor):
        return _real(value, name)
    if isinstance(value, list | tuple) and value and all(isinstance(entry, Tensor) for entry in value):
        return _real(torch.stack(list(value)), name)
    if isinstance(value, list | tuple) and value and hasattr(value[0], "pt"):
        value = np.array([keypoint.pt for keypoint in value], np.float32)
    elif hasattr(value, "__dlpack__") and not isinstance(value, np.ndarray | np.generic):  # of CuPy, JAX, ...
        return _real(torch.utils.dlpack.from_dlpack(value), name)
    if "numpy.ma" in sys.modules and np.ma.is_masked(value):  # whoever has such an array has imported it
        raise ValueError(f"{name} is a masked array; give its data, and what counts in `mask` (True for a real match)")
    try:
        array = np.asarray(value)
    except ValueError as error:
        kind = type(value).__name__
        raise TypeError(f"{name} is a {kind} of uneven rows; it must be an array or a tensor") from error
    if array.dtype.name == "bfloat16":  # of ml_dtypes, as JAX has it
        array = array.astype(np.float32)
    if array.dtype.kind not in "biuf":
        kind = type(value).__name__
        raise TypeError(f"{name} is a {kind} of {array.dtype}; it must be an array or tensor of numbers")
    if array.dtype.kind == "f" and array.dtype.itemsize > 8:
        array = array.astype(np.float64)
    if array.dtype.kind == "u" and array.dtype.itemsize > 1:
        array = array.astype(np.int64)
    array = np.ascontiguousarray(array, array.dtype.newbyteorder("="))
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def _real(tensor: Tensor, name: str) -> Tensor:
    if tensor.is_complex() or tensor.is_quantized:
        raise TypeError(f"{name} is a tensor of {tensor.dtype}; it must hold real numbers")
    return tensor


def widened(tensor: Tensor) -> Tensor:
    """In a type that estimators compute in: whole numbers as float64, less than 32 bits as float32."""
    if not tensor.is_floating_point():
        return tensor.to(torch.float64)
    return tensor.to(torch.float32) if tensor.dtype in WIDENED else tensor


def number(name: str, value: Any, integer: bool) -> Any:
    """A number, not NaN; what has one element may be one. Raises TypeError or ValueError naming the argument."""
    if isinstance(value, bool | np.bool_ | str | bytes | complex | np.complexfloating):
        raise TypeError(f"{name} is {value!r}; it must be a {'whole ' if integer else ''}number")
    if not isinstance(value, int | float):
        try:
            value = operator.index(value) if integer else float(value)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            said = "whole number" if integer else "number"
            raise TypeError(f"{name} is a {type(value).__name__}; it must be a {said}") from None
    if integer and not isinstance(value, int):
        raise TypeError(f"{name} is {value!r}; it must be a whole number")
    if math.isnan(value):
        raise ValueError(f"{name} is nan; it must be a number")
    return value


def _checked_value(name: str, value: Any, want: Expected, device: torch.device) -> Any:
    """The value as the function takes it. Raises TypeError or ValueError naming the argument."""
    if want.kind in ("int", "float") or (want.kind == "number or array" and not isinstance(value, Tensor | np.ndarray)):
        return number(name, value, want.kind == "int")
    if want.kind in ("numbers", "whole numbers"):
        if isinstance(value, str | bytes | Mapping) or not hasattr(value, "__len__") or getattr(value, "ndim", 1) != 1:
            raise TypeError(f"{name} is a {type(value).__name__}; it must be a sequence of numbers")
        return tuple(number(f"{name}[{i}]", each, want.kind == "whole numbers") for i, each in enumerate(value))
    if want.kind in ("bool", "str"):
        kind = {"bool": (bool, np.bool_), "str": (str,)}[want.kind]
        if not isinstance(value, kind):
            said = "True or False" if want.kind == "bool" else "a string"
            raise TypeError(f"{name} is a {type(value).__name__}; it must be {said}")
        return value
    if want.kind == "function" and not callable(value):
        raise TypeError(f"{name} is a {type(value).__name__}; it must be a function")
    if want.kind == "choice" and value not in want.choices:
        raise ValueError(f"{name} is {value!r}; it must be one of {', '.join(map(repr, want.choices))}")
    if not want.dtype:
        return value
    if isinstance(value, Tensor):
        if value.device != device:
            raise ValueError(f"{name} is on {value.device} and another argument on {device}; all must be on one device")
        tensor = value
    else:
        tensor = as_tensor(value, name).to(device)
    return _numbers(name, tensor, want)


def _numbers(name: str, tensor: Tensor, want: Expected) -> Tensor:
    """The tensor, with elements of the kind asked for. Raises ValueError naming the argument for others."""
    integer = numbers_of(tensor.dtype) == WHOLE and not tensor.is_quantized
    if (want.dtype == "Float" and integer) or (tensor.dtype in WIDENED and want.dtype in ("Float", "Real")):
        return widened(tensor)
    if want.dtype == "Bool" and integer:
        return tensor != 0
    if tensor.is_quantized or not want.holds(tensor.dtype):
        raise ValueError(f"{name} is of {tensor.dtype}; it must hold {want.numbers}")
    return tensor


def _expect_shapes(tensors: Mapping[str, Tensor], expected: Mapping[str, Expected]) -> None:
    """Raises ValueError naming the first tensor whose shape does not fit its annotation or those before it."""
    sizes: dict[str, tuple[int, str]] = {}  # what a dimension's name stands for, and whose shape said so
    leading: dict[str, tuple[tuple[int, ...], str]] = {}  # the same of leading dimensions
    for name, tensor in tensors.items():
        shape, want = tuple(tensor.shape), expected[name].shape
        variadic = want[0] if want and want[0].startswith("*") else None
        trailing = want[1:] if variadic else want
        extra = len(shape) - len(trailing)
        if extra < 0 or (extra and variadic is None):
            raise ValueError(f"{name} has shape {shape}; it must be {_readable(want)}")
        for size, token in zip(shape[extra:], trailing, strict=True):
            known, whose = (int(token), "") if token.isdigit() else sizes.setdefault(token, (size, name))
            if size != known:
                where = f" with {token} = {known}, as of {whose}" if whose else ""
                raise ValueError(f"{name} has shape {shape}; it must be {_readable(want)}{where}")
        if variadic is not None:
            _expect_leading(name, shape, extra, variadic, leading)
    if MODELS in leading and SETS in leading:
        (models, name), (sets, whose) = leading[MODELS], leading[SETS]
        if models != sets and models[:-1] != sets:
            wanted = f"{sets}, as of {whose}, or {sets} and one more"
            raise ValueError(f"{name} has leading dimensions {models}; they must be {wanted}")


def _expect_leading(
    name: str, shape: tuple[int, ...], extra: int, variadic: str, leading: dict[str, tuple[tuple[int, ...], str]]
) -> None:
    """Leading dimensions equal to those of the same name before, or broadcast with them where a # says so."""
    group, mine = variadic.lstrip("*#"), shape[:extra]
    known, whose = leading.setdefault(group, (mine, name))
    if mine == known:
        return
    if "#" not in variadic:
        raise ValueError(f"{name} has shape {shape}; its leading dimensions must be {known}, as of {whose}")
    try:
        leading[group] = tuple(torch.broadcast_shapes(known, mine)), whose  # type: ignore[no-untyped-call]
    except RuntimeError:
        wanted = f"broadcast with {known}, as of {whose}"
        raise ValueError(f"{name} has shape {shape}; its leading dimensions must {wanted}") from None


def _common_type(tensors: Mapping[str, Tensor], expected: Mapping[str, Expected]) -> dict[str, Tensor]:
    """Those floating-point tensors that are not of the widest type among them, in that type."""
    floats = {name: tensor for name, tensor in tensors.items() if expected[name].dtype == "Float"}
    kinds = {tensor.dtype for tensor in floats.values()}
    if len(kinds) < 2:
        return {}
    widest = functools.reduce(torch.promote_types, kinds)
    return {name: tensor.to(widest) for name, tensor in floats.items()}


def _readable(shape: tuple[str, ...]) -> str:
    """``(..., N, 2)`` of jaxtyping's ``*#batch n 2``."""
    tokens = ["..." if token.startswith("*") else token.lstrip("#").upper() for token in shape]
    return f"({', '.join(tokens)}{',' if len(tokens) == 1 else ''})"


def expect_sizes(**sizes: Tensor | None) -> None:
    """Raises ValueError naming the argument and the first size that is not positive and finite."""
    given = {name: size for name, size in sizes.items() if size is not None}
    if all(bool(SIZE.holds(size).all()) for size in given.values()):
        return
    for name, size in given.items():
        rows = size.detach().reshape(-1, size.shape[-1])
        for row in rows[~SIZE.holds(rows).all(-1)].tolist():
            raise ValueError(f"{name} is {tuple(row)}; {SIZE.text}")


MIN_MATCHES = 8  # fewer say nothing of their unit and image
MAX_OUTSIDE = 0.5  # fraction of points outside an image of the given size: some are undistorted far beyond its border
SWAPPED = 0.05  # fraction outside from which on a size is taken for (w, h), if all points are inside then


class Box(NamedTuple):
    """Of points of B pairs: which are real and finite, and the ends of the box around these, infinite around none."""

    real: Bool[Tensor, "b n"]
    low: Float[Tensor, "b 2"]
    high: Float[Tensor, "b 2"]

    @property
    def enough(self) -> Bool[Tensor, " b"]:
        """Of which pairs the points tell of their unit and image."""
        return self.real.sum(1) >= MIN_MATCHES


def box_of(x: Float[Tensor, "b n 2"], mask: Bool[Tensor, "b n"]) -> Box:
    """The box of points, on no graph."""
    x = x.detach()
    real = mask & x[..., 0].isfinite() & x[..., 1].isfinite()
    if not x.shape[1]:
        return Box(real, x.new_full((len(x), 2), torch.inf), x.new_full((len(x), 2), -torch.inf))
    if bool(real.all()):
        return Box(real, *x.aminmax(dim=1))
    each = real[..., None]
    return Box(real, torch.where(each, x, torch.inf).amin(1), torch.where(each, x, -torch.inf).amax(1))


def expect_inside(x: Tensor, box: Box, size: Tensor, name: str, size_name: str) -> None:
    """Raise ValueError where the points (b, n, 2) of all pairs contradict the image's size (b, 2), h and w.
    Points that reach beyond opposite borders are no pixels of another image or unit: a wide lens was undistorted."""
    enough, size = box.enough, size.detach().to(x.device)
    low, high, limit = box.low, box.high, size.flip(-1)
    if not bool(enough.any()) or bool((((low >= -1) & (high <= limit)).all(-1) & enough).any()):
        return
    x, real, limit = x.detach()[enough], box.real[enough], limit[enough][:, None]
    far, turned = _fraction_outside(x, real, limit), _fraction_outside(x, real, limit.flip(-1))
    swapped = (far > SWAPPED) & (turned == 0)
    undistorted = ((low[enough] < -1) & (high[enough] > limit[:, 0])).any(-1)
    if not bool((((far > MAX_OUTSIDE) & ~undistorted) | swapped).all()):
        return
    h, w = size[enough][0].tolist()
    hint = "sizes are (h, w), and it looks like (w, h)" if bool(swapped[0]) else "sizes are (h, w) in pixels"
    outside = f"{100 * float(far[0]):.0f} % of {name} lie outside such an image"
    raise ValueError(f"{size_name} is ({h:g}, {w:g}), but {outside}; {hint}")


def _fraction_outside(x: Tensor, mask: Tensor, limit: Tensor) -> Tensor:
    """The fraction (b,) of points beyond the border, of the first pixel's centre and of the last one's, by a pixel."""
    return (((x < -1) | (x > limit)).any(-1) & mask).sum(1) / mask.sum(1)
