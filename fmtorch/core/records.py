"""Records: frozen dataclasses of tensors that share a leading batch dimension, and perhaps one of slots.

The annotation of a field is what is known of it: ``Float[Tensor, "b n 2"]`` is a shape that is checked when the record
is made, the numbers that it holds, and, by the dimension ``n``, that it has an entry for each slot. Annotations, those
of functions' arguments too, are read here alone, and only here is jaxtyping's form of them known."""

import dataclasses
import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar, cast, get_args, get_origin, get_type_hints

import torch
from jaxtyping import AbstractArray, Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from fmtorch.core import files
from fmtorch.core.options import UNIONS

FLOATING, WHOLE, REAL, BOOLEAN = "floating-point numbers", "whole numbers", "real numbers", "booleans"
NUMBERS = {"Float": FLOATING, "Int": WHOLE, "Int8": WHOLE, "Real": REAL, "Bool": BOOLEAN}
FOREIGN = (".h5", ".json", ".npy", ".npz", ".pkl", ".pt", ".pth")  # which `Record.save` does not write


class Rule(NamedTuple):
    """A rule for values: ``Annotated[Float[Tensor, "b n"], Rule(...)]``."""

    holds: Callable[[Any], Any]  # of an array or a tensor, entry by entry
    text: str  # what is said of values for which it does not


class Expected(NamedTuple):
    """What an annotation asks for."""

    kind: str  # "array", "number or array", "int", "float", "bool", "str", "numbers", "choice", ...; "" for anything
    shape: tuple[str, ...] = ()  # of an array, as jaxtyping writes it: "*#batch", "n", "2"
    dtype: str = ""  # of an array, a key of NUMBERS
    bounds: Rule | None = None
    choices: tuple[Any, ...] = ()  # of which the value must be one
    optional: bool = False

    @property
    def numbers(self) -> str:
        """What an array must hold, in words."""
        return NUMBERS[self.dtype]

    def holds(self, dtype: torch.dtype) -> bool:
        """Whether an array of this type holds that."""
        numbers = numbers_of(dtype)
        return numbers == self.numbers or (self.numbers == REAL and numbers in (FLOATING, WHOLE))


def expectation(hint: Any) -> Expected:
    """What a resolved annotation asks for."""
    alternatives = get_args(hint) if get_origin(hint) in UNIONS else (hint,)
    kinds = [alternative for alternative in alternatives if alternative is not type(None)]
    each = [_of_one(kind) for kind in kinds]
    expected = next((entry for entry in each if entry.kind == "array"), each[0] if len(each) == 1 else Expected(""))
    if set(kinds) == {float, Tensor}:
        expected = Expected("number or array", dtype="Float")
    return expected._replace(optional=len(kinds) < len(alternatives))


def _of_one(hint: Any) -> Expected:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        rules = [rule for rule in arguments[1:] if isinstance(rule, Rule)]
        return _of_one(arguments[0])._replace(bounds=rules[0] if rules else None)
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return Expected("array", tuple(str(hint.dim_str).split()), hint.__name__.partition("[")[0])
    if origin is Sequence:
        return Expected("whole numbers" if arguments == (int,) else "numbers")
    if origin is Literal:
        return Expected("choice", choices=arguments)
    if origin is Callable:
        return Expected("function")
    return Expected(hint.__name__ if hint in (int, float, bool, str) else "")


def arguments_of(function: Callable[..., Any]) -> dict[str, Expected]:
    """What a function's annotations say of its parameters, by name."""
    hints = get_type_hints(function, include_extras=True)
    return {name: expectation(hints.get(name, Any)) for name in inspect.signature(function).parameters}


def arrays_of(kind: type) -> dict[str, Expected]:
    """What the annotations of a class say of its arrays, by field."""
    fields = {name: expectation(hint) for name, hint in get_type_hints(kind, include_extras=True).items()}
    return {name: expected for name, expected in fields.items() if expected.kind == "array"}


def numbers_of(dtype: torch.dtype) -> str:
    """What a tensor's elements are, in words."""
    words = FLOATING if dtype.is_floating_point else "complex numbers" if dtype.is_complex else WHOLE
    return BOOLEAN if dtype == torch.bool else words


Index = int | slice | Sequence[int] | Sequence[bool] | Tensor
AnyRecord = TypeVar("AnyRecord", bound="Record")

BATCH, SLOTS = "*batch", "n"  # dimensions: of a batch, where there is one; of features or matches, padding included
FIXED = {"2": 2, "3": 3}  # dimensions that have a size by their names


class Record:
    """Tensors with a common leading batch dimension, moved, indexed and replaced together.
    declared: what the annotations of a kind's tensors say, by field. per_slot: those with an entry a slot."""

    declared: ClassVar[Mapping[str, Expected]] = {}
    per_slot: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls) -> None:
        cls.declared = arrays_of(cls)
        cls.per_slot = tuple(name for name, field in cls.declared.items() if SLOTS in field.shape)

    def to(self: AnyRecord, device: torch.device | str) -> AnyRecord:
        """The same record with every tensor on `device`."""
        return self._each(lambda value: value.to(device))

    def detach(self: AnyRecord) -> AnyRecord:
        """The same record cut off from the graph."""
        return self._each(lambda value: value.detach())

    @property
    def requires_grad(self) -> bool:
        """Whether a gradient can reach any of the tensors."""
        if not torch.is_grad_enabled():
            return False
        return any(isinstance(v, Tensor | Record) and v.requires_grad for v in vars(self).values())

    def replace(self: AnyRecord, **changes: Any) -> AnyRecord:
        """A copy with some fields changed (shapes are checked again)."""
        return cast(AnyRecord, dataclasses.replace(cast(Any, self), **changes))

    @classmethod
    def unchecked(cls: type[AnyRecord], **fields: Any) -> AnyRecord:
        """A record of all its fields, unchecked: of tensors that fit because of how they are made."""
        record = object.__new__(cls)
        vars(record).update(fields)
        return record

    def derived(self: AnyRecord, **changes: Any) -> AnyRecord:
        """As `replace`, unchecked, by tensors that fit because of how they are made of this record: not a user's."""
        return self.unchecked(**{**vars(self), **changes})

    def save(self, path: Path | str) -> None:
        """Write the record to a file in the format of safetensors, which holds numbers and text, never code.
        Raises OSError where it cannot be written, ValueError for the name of another format."""
        if Path(path).suffix.lower() in FOREIGN:
            raise ValueError(f"{path}: save() writes the format of safetensors; the name must end with .safetensors")
        values = vars(self)
        tensors = {name: value.detach().cpu().clone() for name, value in values.items() if isinstance(value, Tensor)}
        plain = {name: value for name, value in values.items() if not isinstance(value, Tensor | None)}
        stored = {"record": type(self).__name__, "fields": json.dumps(plain)}
        with files.replacing(Path(path)) as temporary:
            temporary.touch()  # which says what is wrong with a folder; safetensors names its own file
            save_file({name: value.contiguous() for name, value in tensors.items()}, temporary, stored)

    @classmethod
    def load(cls: type[AnyRecord], path: Path | str) -> AnyRecord:
        """The record that `save` wrote, on the CPU, checked again.
        Raises FileNotFoundError, or ValueError for another file."""
        try:
            with safe_open(path, "pt") as file:
                stored = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except SafetensorError as error:
            raise ValueError(f"{path} is no file that save() wrote: {error}") from error
        kinds = {kind.__name__ for kind in (cls, *cls.__subclasses__())}
        if stored.get("record") not in kinds:
            record = stored.get("record", "no record")
            raise ValueError(f"{path} holds {record}; {cls.__name__}.load reads {min(kinds)}")
        plain = json.loads(stored["fields"])
        return cls(**tensors, **{name: tuple(v) if isinstance(v, list) else v for name, v in plain.items()})

    def __repr__(self) -> str:
        tensors = ((name, value) for name, value in vars(self).items() if isinstance(value, Tensor))
        shapes = (f"{name}: {tuple(x.shape)} {str(x.dtype).removeprefix('torch.')}" for name, x in tensors)
        return f"{type(self).__name__}({', '.join(shapes)})"

    def _map(self: AnyRecord, function: Any, **changes: Any) -> AnyRecord:
        return self.replace(**_mapped(self, function, Record._map), **changes)

    def _each(self: AnyRecord, function: Any) -> AnyRecord:
        """As `_map`, of a function that keeps shape and kind."""
        return self.derived(**_mapped(self, function, Record._each))


def _mapped(record: Record, function: Any, within: Any) -> dict[str, Any]:
    """The function of each tensor of a record; within(record, function) of a record in it."""
    values = {name: v for name, v in vars(record).items() if isinstance(v, Tensor | Record)}
    return {name: function(v) if isinstance(v, Tensor) else within(v, function) for name, v in values.items()}


def expect_fields(record: Record, **sizes: int) -> None:
    """Raises TypeError or ValueError for a field that is no tensor of the declared shape and numbers, on one device.
    sizes: of dimensions by their names, where known beforehand; else the first field that has a dimension decides."""
    known, device, batched = FIXED | sizes, None, None
    for name, field in record.declared.items():
        value = getattr(record, name)
        if value is None and field.optional:
            continue
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} is a {type(value).__name__}; it must be a tensor")
        shape, dimensions = value.shape, field.shape
        if dimensions[0] == BATCH:
            batched = len(shape) >= len(dimensions) if batched is None else batched
            dimensions = dimensions if batched else dimensions[1:]
        if len(shape) == len(dimensions):
            for dimension, size in zip(dimensions, shape, strict=True):
                known.setdefault(dimension, size)
        wanted = tuple([known.get(dimension) for dimension in dimensions])
        if shape != wanted:
            letters = ", ".join(name.upper() for name in field.shape if name != BATCH)
            batch = f", or (B, {letters}) of a batch" if BATCH in field.shape else ""
            said = f"({letters}){batch}" if None in wanted else wanted
            raise ValueError(f"{name} has shape {tuple(shape)}; it must be {said}")
        device = value.device if device is None else device
        if value.device != device:
            raise ValueError(f"{name} is on {value.device} and another field on {device}; all must be on one device")
        if not field.holds(value.dtype):
            raise ValueError(f"{name} is of {value.dtype}; it must hold {field.numbers}")


def slotted(record: Record) -> dict[str, Tensor]:
    """Those fields of a record that have an entry for each slot and are there."""
    values = {name: getattr(record, name) for name in record.per_slot}
    return {name: value for name, value in values.items() if value is not None}


def ungraphed(inputs: Record, compute: Callable[[], AnyRecord]) -> AnyRecord:
    """compute(), without autograd's bookkeeping unless a gradient can reach the inputs.
    That takes a fifth of the time of small tensors. The result's tensors are ordinary ones, free to use in a graph."""
    if inputs.requires_grad or torch.is_inference_mode_enabled():
        return compute()
    with torch.inference_mode():
        result = compute()
    return result._each(lambda value: value.clone() if value.is_inference() else value)


def as_index(index: Index, length: int) -> slice | Tensor:
    """An index that keeps the batch dimension: the integer i selects the batch of one that holds element i.
    A list of booleans is a mask. Raises IndexError for an integer that is out of range, which also ends iteration."""
    if isinstance(index, slice):
        return index
    if isinstance(index, Tensor) and index.dim() > 0:
        return index
    if isinstance(index, int | Tensor):
        i = int(index)
        if not -length <= i < length:
            raise IndexError(f"index {i} is out of range for {length} elements")
        return slice(i, i + 1 or None)
    chosen = list(index)
    is_mask = bool(chosen) and all(isinstance(i, bool) for i in chosen)
    return torch.as_tensor(chosen, dtype=torch.bool if is_mask else torch.int64)


def padded(value: Tensor, dim: int, length: int) -> Tensor:
    """`value` filled with zeros (False) along `dim` up to `length`."""
    missing = length - value.shape[dim]
    return torch.nn.functional.pad(value, [0, 0] * (value.dim() - 1 - dim) + [0, missing]) if missing > 0 else value


def gathered(value: Tensor, order: Int[Tensor, "b m"]) -> Tensor:
    """The entries of a tensor (B, N, ...) in the slots `order` of each row, in that order."""
    index = order.reshape(*order.shape, *[1] * (value.dim() - 2)).expand(-1, -1, *value.shape[2:])
    return torch.gather(value, 1, index)
