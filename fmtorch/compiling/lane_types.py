"""`lanes` for numba: values of lanes as types, their operators as vector instructions of LLVM.

Imported when the first kernel that uses lanes is compiled.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

INDEX = ir.IntType(64)
ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "truediv": "fdiv"}
COMPARISONS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
LOGIC = {"and_": "and_", "or_": "or_", "xor": "xor"}


class LanesType(types.Type):  # type: ignore[misc]
    """Numbers of a type, or booleans: a mask."""

    def __init__(self, dtype: Any, count: int) -> None:
        self.dtype, self.count = dtype, count
        super().__init__(name=f"lanes({dtype} x {count})")

    @property
    def mask(self) -> LanesType:
        """The type of a comparison's value."""
        return LanesType(types.boolean, self.count)


@register_model(LanesType)
class _Model(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, lanes: LanesType) -> None:
        bits = {types.float64: ir.DoubleType(), types.float32: ir.FloatType(), types.boolean: ir.IntType(1)}
        super().__init__(manager, lanes, ir.VectorType(bits[lanes.dtype], lanes.count))


def operands(args: tuple[Any, ...]) -> LanesType | None:
    """The type of lanes that both operands have or become; None where there is none."""
    kinds = {kind for kind in args if isinstance(kind, LanesType)}
    if len(kinds) != 1 or not all(kind in kinds or isinstance(kind, (types.Float, types.Integer)) for kind in args):
        return None
    (kind,) = kinds
    return None if kind.dtype == types.boolean else kind


def filled(context: Any, builder: Any, number: Any, given: Any, kind: LanesType) -> Any:
    """A number in all lanes; a value of lanes as it is."""
    if isinstance(given, LanesType):
        return number
    vector = context.get_value_type(kind)
    first_lane = builder.insert_element(
        ir.Constant(vector, ir.Undefined), context.cast(builder, number, given, kind.dtype), ir.Constant(INDEX, 0)
    )
    everywhere = ir.Constant(ir.VectorType(ir.IntType(32), kind.count), [0] * kind.count)
    return builder.shuffle_vector(first_lane, ir.Constant(vector, ir.Undefined), everywhere)


def _typed(function: Any, kind_of: Callable[[LanesType], LanesType]) -> None:
    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Any, kws: Any) -> Any:
            kind = operands(args)
            return None if kind is None or len(args) != 2 else signature(kind_of(kind), *args)

    infer_global(function)(Template)


def _lowered(function: Any, instruction: Callable[[Any, Any, Any], Any]) -> None:
    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind: Any = operands(sig.args)
        a, b = (filled(context, builder, value, given, kind) for value, given in zip(args, sig.args, strict=True))
        return instruction(builder, a, b)

    for number in (types.Float, types.Integer):
        lower_builtin(function, LanesType, number)(code)
        lower_builtin(function, number, LanesType)(code)
    lower_builtin(function, LanesType, LanesType)(code)


def _arithmetic(name: str) -> Callable[[Any, Any, Any], Any]:
    return lambda builder, a, b: getattr(builder, name)(a, b)


def _comparison(sign: str) -> Callable[[Any, Any, Any], Any]:
    ordered = sign != "!="  # a number differs from what is none
    return lambda builder, a, b: (builder.fcmp_ordered if ordered else builder.fcmp_unordered)(sign, a, b)


for _name, _instruction in ARITHMETIC.items():
    for _function in (getattr(operator, _name), getattr(operator, f"i{_name}")):
        _typed(_function, lambda kind: kind)
        _lowered(_function, _arithmetic(_instruction))
for _name, _sign in COMPARISONS.items():
    _typed(getattr(operator, _name), lambda kind: kind.mask)
    _lowered(getattr(operator, _name), _comparison(_sign))


class _OfMasks(AbstractTemplate):  # type: ignore[misc]
    def generic(self, args: Any, kws: Any) -> Any:
        masks = all(isinstance(kind, LanesType) and kind.dtype == types.boolean for kind in args)
        return signature(args[0], *args) if masks and len(set(args)) == 1 else None


for _name, _instruction in LOGIC.items():
    for _function in (getattr(operator, _name), getattr(operator, f"i{_name.rstrip('_')}")):
        infer_global(_function)(type("OfMasks", (_OfMasks,), {}))
        lower_builtin(_function, LanesType, LanesType)(
            lambda context, builder, sig, args, name=_instruction: getattr(builder, name)(*args)
        )
infer_global(operator.invert)(type("OfMasks", (_OfMasks,), {}))
lower_builtin(operator.invert, LanesType)(lambda context, builder, sig, args: builder.not_(args[0]))


class _Negative(AbstractTemplate):  # type: ignore[misc]
    def generic(self, args: Any, kws: Any) -> Any:
        return None if operands(args) is None else signature(args[0], *args)


infer_global(operator.neg)(_Negative)
lower_builtin(operator.neg, LanesType)(lambda context, builder, sig, args: builder.fneg(args[0]))
