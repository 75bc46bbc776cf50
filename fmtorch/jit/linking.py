"""How compiled kernels call one another: through an address that is looked up when the call is made.

What numba compiles it links with all that it calls, and so compiles a kernel again for each that calls it. Here each
kernel has a cell of memory that holds its address, and what calls it knows the cell by name. So every kernel is
compiled once, alone and in any order; before it is first called, those that it calls must have their addresses."""

import ctypes
import functools
import importlib
import re
from collections.abc import Callable
from typing import Any

SYMBOL = "fmtorch_kernel:{module}:{name}:"  # of a cell; colons, since machine code may not separate its names
_NAME = re.compile(rb"fmtorch_kernel:([\w.]+):(\w+):")
RETURNED = {"None": "none", "bool": "boolean", "int": "int64", "float": "float64"}  # numba's types, by annotation
_cells: dict[str, ctypes.c_void_p] = {}
KERNELS: dict[tuple[str, str], Any] = {}  # all kernels of this process, by module and name


def cell(module: str, name: str) -> ctypes.c_void_p:
    """The cell of the kernel of this name, which compiled code finds from now on."""
    from llvmlite import binding

    symbol = SYMBOL.format(module=module, name=name)
    if symbol not in _cells:
        _cells[symbol] = ctypes.c_void_p()
        binding.add_symbol(symbol, ctypes.addressof(_cells[symbol]))
    return _cells[symbol]


def called(machine_code: bytes) -> list[Any]:
    """The kernels whose cells are named in machine code; from now on it finds these cells."""
    places = sorted({(match[1].decode(), match[2].decode()) for match in _NAME.finditer(machine_code)})
    for module, name in places:
        cell(module, name)
    return [kernel_of(module, name) for module, name in places]


def register(kernel: Any) -> None:
    """Makes a kernel the one of its name, by which its callers find it.
    Raises ValueError where a function has made another one of this name, from other values."""
    function = kernel.function
    place = (function.__module__, function.__qualname__)
    if place in KERNELS:
        other = KERNELS[place].function
        cells, others = ([each.cell_contents for each in f.__closure__ or ()] for f in (function, other))
        if function.__code__ is other.__code__ and any(a is not b for a, b in zip(cells, others, strict=True)):
            raise ValueError(f"two kernels are called {'.'.join(place)}: make each with a name=... of its own")
    KERNELS[place] = kernel


def kernel_of(module: str, name: str) -> Any:
    """The kernel of this name in a module, which is imported if need be."""
    importlib.import_module(module)
    return KERNELS[module, name]


def callable_type(function: Callable[..., Any], signature: Any) -> Any:
    """What a kernel is to numba where another one calls it: a function of one signature, called by its cell.
    Raises TypeError unless the function says by an annotation that it returns None, bool, int or float."""
    from llvmlite import ir
    from numba.core import cgutils, registry, sigutils, types, typing

    annotation = returned(function)
    if annotation not in RETURNED:
        names = ", ".join(RETURNED)
        raise TypeError(f"{function.__qualname__} is called by a kernel: annotate what it returns as one of {names}")
    arguments, _ = sigutils.normalize_signature(signature)
    numba_signature = typing.signature(getattr(types, RETURNED[annotation]), *arguments)
    module, name = function.__module__, function.__qualname__
    cell(module, name)

    def call(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        code = context.call_conv.get_function_type(numba_signature.return_type, numba_signature.args).as_pointer()
        symbol = SYMBOL.format(module=module, name=name)
        place = builder.module.globals.get(symbol) or ir.GlobalVariable(builder.module, code, symbol)
        status, value = context.call_conv.call_function(
            builder, builder.load(place), numba_signature.return_type, numba_signature.args, values
        )
        with cgutils.if_unlikely(builder, status.is_error):
            context.call_conv.return_status_propagate(builder, status)
        return value

    registry.cpu_target.target_context.insert_func_defn([(call, function, numba_signature.args)])
    return types.Function(typing.templates.make_concrete_template(name, function, [numba_signature]))


def publish(function: Callable[..., Any], result: Any) -> None:
    """Put a compiled function's address into its cell. result: numba's `CompileResult`.
    Raises TypeError where it returns something else than its annotation says to those that call it."""
    from numba.core import types

    annotation = returned(function)
    kind = result.signature.return_type
    if annotation in RETURNED and kind != getattr(types, RETURNED[annotation]):
        raise TypeError(f"{function.__qualname__} is annotated to return {annotation}, but returns {kind}")
    address = result.library.get_pointer_to_function(result.fndesc.llvm_func_name)
    cell(function.__module__, function.__qualname__).value = address


def returned(function: Callable[..., Any]) -> str:
    """The name of what a function says that it returns; empty where it does not say."""
    annotation = function.__annotations__.get("return", "")
    return annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))


@functools.cache
def inner_compiler() -> Any:
    """The compiler of inner functions, for numba's `pipeline_class`: neither optimised nor machine code on their own.
    numba compiles each function that another calls as if it were called from Python, too. A kernel is optimised as a
    whole after all of its inner functions have been linked in, so that this would be half of compiling's time for
    nothing. They become part of what calls them in any case, however long: a call in the middle of a loop keeps it from
    being vectorised, and values from staying in registers. The names used here are numba's own."""
    from numba.core import codegen, compiler

    class Codegen:
        """The code generator of a library whose functions have no environment in memory."""

        def __init__(self, generator: Any) -> None:
            self._generator = generator

        def __getattr__(self, name: str) -> Any:
            return getattr(self._generator, name)

        def set_env(self, name: str, env: Any) -> None:
            """Nothing: there is no machine code that would read it."""

    class InnerLibrary(codegen.JITCodeLibrary):  # type: ignore[misc]
        """Code that is only linked."""

        @property
        def codegen(self) -> Any:
            return Codegen(self._codegen)

        def add_ir_module(self, module: Any) -> None:
            for function in module.functions:
                if not function.is_declaration and "noinline" not in function.attributes:
                    function.attributes.add("alwaysinline")
            super().add_ir_module(module)

        def _optimize_final_module(self) -> None:
            pass

        def _finalize_final_module(self) -> None:
            self._finalized = True

        def get_pointer_to_function(self, name: str) -> int:
            return 0

    class InnerCompiler(compiler.Compiler):  # type: ignore[misc]
        """numba's compiler, into an `InnerLibrary`."""

        def __init__(self, typingctx: Any, targetctx: Any, library: Any, *others: Any) -> None:
            super().__init__(typingctx, targetctx, library or InnerLibrary(targetctx.codegen(), "inner"), *others)

    return InnerCompiler
