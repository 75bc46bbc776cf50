"""Options that a user sets: declared as fields of a dataclass, and checked against the signature of what takes them.

Nothing here imports more than Python's own library, so that a command's ``--help`` waits for nothing."""

import dataclasses
import difflib
import enum
import functools
import inspect
import math
import numbers
import os
import re
import sys
import types
from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin

T = TypeVar("T")
PLAIN = (bool, int, float, str, type(None), list, tuple, Mapping)  # what a YAML file or a command line can say
MAX_NAMES = 12  # that a message lists
UNIONS = (Union, types.UnionType)
UNRESOLVED = (NameError, AttributeError, TypeError, SyntaxError)  # of annotations for type checkers alone


@dataclasses.dataclass(frozen=True)
class Within:
    """Bounds of a number, for ``Annotated[int, Within(1)]``; both may be reached unless they are exclusive."""

    minimum: int | float = -math.inf
    maximum: int | float = math.inf
    exclusive: bool = False

    def __call__(self, value: Any) -> bool:
        number = float(value) if isinstance(value, numbers.Real) else math.nan
        ends = (self.minimum, self.maximum) if self.exclusive else ()
        return self.minimum <= number <= self.maximum and number not in ends

    def __str__(self) -> str:
        low, high = (str(bound) if isinstance(bound, int) else f"{bound:g}" for bound in (self.minimum, self.maximum))
        if self.maximum == math.inf:
            return f"above {low}" if self.exclusive else f"of at least {low}"
        if self.minimum == -math.inf:
            return f"below {high}" if self.exclusive else f"of at most {high}"
        return f"between {low} and {high}" if self.exclusive else f"from {low} to {high}"


class DeviceName:
    """A rule for texts: what `torch.device` takes, and ``auto``."""

    def __call__(self, value: str) -> bool:
        return re.fullmatch(r"auto|cpu|mps|(cuda|xpu)(:\d+)?", value) is not None

    def __str__(self) -> str:
        return "that names a device: auto, cpu, cuda, cuda:1 or mps"


Count = Annotated[int, Within(1)]
Seed = Annotated[int, Within(-(2**63), 2**63 - 1)]
Device = Annotated[str, DeviceName()]
Cache = Path | bool | None  # false is off
Gigabytes = Annotated[int | float, Within(0)]
CACHE = "folder of features computed before; null: features in $FMTORCH_CACHE or ~/.cache/fmtorch; off: none"
DEBUG = "true: stop at the first error of a part and show all of its traceback; pdb: and look at it in the debugger"
Debug = bool | Literal["pdb"]
CACHE_LIMIT = "GB, beyond which the least recently used features go; null: no bound"


def option(default: T, about: str) -> T:
    """A field of a dataclass of options, with its default and what ``--help`` says of it."""
    metadata = {"about": about}
    if isinstance(default, list | dict):
        return cast(T, dataclasses.field(default_factory=lambda: default.copy(), metadata=metadata))
    return dataclasses.field(default=default, metadata=metadata)


@functools.lru_cache(maxsize=256)
def parameters_of(target: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    """The parameters of a class or function, by name."""
    return inspect.signature(target).parameters


def expect_options(
    target: Callable[..., Any], values: Mapping[str, Any], where: str, given: Iterable[str] = ()
) -> None:
    """Raises ValueError, naming the option, where `values` are no keyword arguments of a class or function.
    Values are compared with the target's annotations as far as these say what a plain value may be; objects, and
    mappings with a `_target_`, are taken on trust. A mapping for a dataclass is checked against its fields. where: the
    name of the whole, as a user knows it: ``pruner.ratio`` or ``estimator=fmtorch``. given: arguments added later."""
    known = parameters_of(target)
    named = [name for name, p in known.items() if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    if len(named) == len(known):  # else it takes any
        for key in values:
            if key not in known:
                raise ValueError(f"{where}: no option {key}; there are: {nearest(str(key), named) or 'none'}")
    missing = [n for n in named if known[n].default is inspect.Parameter.empty and n not in {*values, *given}]
    missing += [str(name) for name, value in values.items() if isinstance(value, str) and value == "???"]
    if missing:
        hint = "" if isinstance(target, type) else ". A function is called once, with the options, and returns the part"
        raise ValueError(f"{where}: {', '.join(missing)} is missing{hint}")
    annotations = resolved(target)
    for key, value in values.items():
        annotation = annotations.get(str(key), Any)
        place = f"{where}: {key}" if "=" in where else f"{where}.{key}" if where else str(key)
        nested = dataclass_in(annotation)
        if nested is not None and isinstance(value, nested):
            value = vars(value)
        if isinstance(value, Mapping) and "_target_" not in value and nested is not None:
            expect_options(nested, value, place)
        elif not fits(value, annotation):
            raise ValueError(f"{place}={shown(value)}; it must be {expected(annotation)}")


def fits(value: Any, annotation: Any) -> bool:
    """Whether a value may stand where an annotation is; what an annotation leaves open is not checked."""
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return fits(value, args[0]) and all(rule(value) for rule in args[1:] if callable(rule))
    if origin in UNIONS:
        return any(fits(value, option) for option in args)
    if origin is Literal:
        return value in args
    if not isinstance(value, PLAIN) or (isinstance(value, Mapping) and "_target_" in value):
        return True
    if annotation in (None, type(None)):
        return value is None
    if annotation in (bool, int, float, str):
        if isinstance(value, float) and math.isnan(value):
            return False
        number = annotation is float and isinstance(value, int) and not isinstance(value, bool)
        return number or (isinstance(value, annotation) and isinstance(value, bool) is (annotation is bool))
    kind = origin or annotation
    if annotation is Any or annotation is object or not isinstance(kind, type):  # or a type variable
        return True
    if issubclass(kind, os.PathLike | enum.Enum):
        return isinstance(value, str)
    if isinstance(value, list | tuple):
        return _fit(value, kind, args)
    if isinstance(value, str) and issubclass(kind, Iterable):
        return False
    try:
        return isinstance(value, kind)
    except TypeError:  # a protocol that is not for run time
        return True


def _fit(values: Sequence[Any], kind: type, args: tuple[Any, ...]) -> bool:
    if not _holds_a_list(kind):
        return False
    if issubclass(kind, tuple) and args and args[-1] is not Ellipsis:
        return len(values) == len(args) and all(map(fits, values, args))
    return not args or all(fits(value, args[0]) for value in values)


def _holds_a_list(kind: Any) -> bool:  # no protocol with attributes, of which issubclass cannot be asked
    protocol = getattr(kind, "_is_protocol", False)
    return (not protocol and issubclass(list, kind)) or issubclass(kind, list | tuple | set | frozenset)


def expected(annotation: Any) -> str:
    """What fits an annotation, in words."""
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return " ".join([expected(args[0]), *(str(rule) for rule in args[1:])])
    if origin in UNIONS:
        words = list(dict.fromkeys(expected(option) for option in args if not (option is int and float in args)))
        return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"
    if origin is Literal:
        return f"one of: {', '.join(map(shown, args))}"
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "text", type(None): "null"}
    if annotation in names:
        return names[annotation]
    kind = origin or annotation
    if not isinstance(kind, type):
        return str(annotation)
    if issubclass(kind, os.PathLike):
        return "a path"
    if issubclass(kind, Mapping):
        return "a mapping"
    if args and issubclass(kind, tuple) and args[-1] is not Ellipsis:
        return f"a list of {', '.join(map(expected, args))}"
    if _holds_a_list(kind):
        return "a list" + (f", each {expected(args[0])}" if args and args[0] is not Any else "")
    if dataclasses.is_dataclass(kind):
        return f"a mapping of: {', '.join(field.name for field in dataclasses.fields(kind))}"
    return f"a {kind.__name__}: a mapping with a `_target_`"


def shown(value: Any) -> str:
    """A value as a command line or a YAML file has it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"[{', '.join(map(shown, value))}]" if isinstance(value, list | tuple) else str(value)


def nearest(name: str, names: Iterable[str]) -> str:
    """The names there are, those most like `name` first; of many only those."""
    ordered = sorted(names, key=lambda known: -difflib.SequenceMatcher(None, str(name), known).ratio())
    more = len(ordered) - MAX_NAMES
    return ", ".join(ordered[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "")


def dataclass_in(annotation: Any) -> type | None:
    """The dataclass that an annotation allows, if it is one."""
    options = get_args(annotation) if get_origin(annotation) in UNIONS else ()
    kinds = [kind for kind in (annotation, *options) if isinstance(kind, type) and dataclasses.is_dataclass(kind)]
    return kinds[0] if len(kinds) == 1 else None


def resolved(target: Callable[..., Any]) -> dict[str, Any]:
    """The annotations of the parameters of anybody's class or function; without those for type checkers alone.
    Those of a dataclass's fields may stand in a base of it, in whose module they mean something."""
    function = inspect.unwrap(target.__init__ if isinstance(target, type) else target)  # type: ignore[misc]
    names = getattr(function, "__globals__", {})
    bases = [vars(sys.modules[base.__module__]) for base in target.__mro__] if isinstance(target, type) else []
    hints = {}
    for name, annotation in getattr(function, "__annotations__", {}).items():
        try:
            hints[name] = eval(annotation, names, ChainMap(*bases)) if isinstance(annotation, str) else annotation
        except UNRESOLVED:
            continue
    return hints
