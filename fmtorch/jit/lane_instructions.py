"""`lanes` for numba: values of lanes as types, their operators as vector instructions of LLVM.

Imported when the first kernel that uses lanes is compiled."""

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import TypingError, types
from numba.core import cgutils, registry
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

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
    def mask(self) -> "LanesType":
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


def _comparison(sign: str) -> Callable[[Any, Any, Any], Any]:
    ordered = sign != "!="  # a number differs from what is none
    return lambda builder, a, b: (builder.fcmp_ordered if ordered else builder.fcmp_unordered)(sign, a, b)


for _name, _instruction in ARITHMETIC.items():
    for _function in (getattr(operator, _name), getattr(operator, f"i{_name}")):
        _typed(_function, lambda kind: kind)
        _lowered(_function, getattr(ir.IRBuilder, _instruction))
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


def _place(context: Any, builder: Any, array: Any, given: Any, row: Any, count: int, bits: Any) -> Any:
    data = context.make_array(array)(context, builder, given).data
    place = builder.gep(data, [builder.mul(row, ir.Constant(INDEX, count))])
    return builder.bitcast(place, ir.VectorType(bits, count).as_pointer())


def _size(dtype: Any) -> int:
    return 1 if dtype == types.boolean else int(dtype.bitwidth) // 8


def load(count: int) -> Any:
    """`lanes.load` of so many lanes."""

    @intrinsic  # type: ignore[untyped-decorator]
    def of_row(context: Any, A: Any, row: Any) -> Any:
        kind = LanesType(A.dtype, count)

        def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            bits = context.get_data_type(A.dtype)
            value = builder.load(_place(context, builder, A, args[0], args[1], count, bits), align=_size(A.dtype))
            if A.dtype != types.boolean:
                return value
            return builder.icmp_unsigned("!=", value, ir.Constant(value.type, [0] * count))

        return kind(A, types.int64), code

    return of_row


def fill(count: int) -> Any:
    """`lanes.fill` of so many lanes."""

    @intrinsic  # type: ignore[untyped-decorator]
    def of_number(context: Any, number: Any) -> Any:
        kind = LanesType(number if isinstance(number, types.Float) else types.float64, count)

        def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return filled(context, builder, args[0], sig.args[0], kind)

        return kind(number), code

    return of_number


@intrinsic  # type: ignore[untyped-decorator]
def store(context: Any, A: Any, row: Any, value: Any) -> Any:
    """`lanes.store`."""
    kinds = list(value) if isinstance(value, types.BaseTuple) else [value]
    if any(A.dtype != kind.dtype for kind in kinds):
        raise TypingError(f"{value} cannot be stored in an array of {A.dtype}")

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = context.get_data_type(A.dtype)
        vectors = cgutils.unpack_tuple(builder, args[2]) if isinstance(value, types.BaseTuple) else [args[2]]
        for k, (kind, vector) in enumerate(zip(kinds, vectors, strict=True)):
            wide = builder.zext(vector, ir.VectorType(bits, kind.count)) if A.dtype == types.boolean else vector
            row = builder.add(args[1], ir.Constant(INDEX, k))
            builder.store(wide, _place(context, builder, A, args[0], row, kind.count, bits), align=_size(A.dtype))
        return context.get_dummy_value()

    return types.void(A, types.int64, value), code


@intrinsic  # type: ignore[untyped-decorator]
def where(context: Any, mask: Any, this: Any, other: Any) -> Any:
    """`lanes.where`."""
    kind = operands((this, other))
    if kind is None or mask != kind.mask:
        raise TypingError(f"where of {mask}, {this} and {other}")

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        first = filled(context, builder, args[1], this, kind)
        return builder.select(args[0], first, filled(context, builder, args[2], other, kind))

    return kind(mask, this, other), code


@intrinsic  # type: ignore[untyped-decorator]
def any_lane(context: Any, mask: Any) -> Any:
    """`lanes.any_lane`."""

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(mask.count))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(mask), code


@intrinsic  # type: ignore[untyped-decorator]
def added(context: Any, value: Any) -> Any:
    """`lanes.added`."""

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        (total,), count = args, value.count
        while count > 1:
            count //= 2
            halves = [_selected_lanes(builder, total, range(k * count, (k + 1) * count)) for k in range(2)]
            total = builder.fadd(*halves)
        return builder.extract_element(total, ir.Constant(INDEX, 0))

    return value.dtype(value), code


def _selected_lanes(builder: Any, vector: Any, lanes: range) -> Any:
    which = ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes))
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), which)


def _library(name: str, arguments: int) -> Any:

    def implementation(kinds: tuple[Any, ...]) -> Any:
        def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            vector, kind = args[0].type, kinds[0]
            called = ir.FunctionType(vector, [vector] * len(args))
            suffix = f"v{kind.count}f{kind.dtype.bitwidth}"
            return builder.call(cgutils.get_or_insert_function(builder.module, called, f"{name}.{suffix}"), args)

        return kinds[0](*kinds), code

    if arguments == 1:

        @intrinsic  # type: ignore[untyped-decorator]
        def unary(context: Any, value: Any) -> Any:
            return implementation((value,))

        return unary

    @intrinsic  # type: ignore[untyped-decorator]
    def binary(context: Any, value: Any, other: Any) -> Any:
        return implementation((value, other))

    return binary


sqrt, absolute, copysign = _library("llvm.sqrt", 1), _library("llvm.fabs", 1), _library("llvm.copysign", 2)


def type_of(function: Any) -> Any:
    """The type of an intrinsic, as which a kernel knows it."""
    context = registry.cpu_target.typing_context
    context.refresh()
    return context.resolve_value_type(function)
