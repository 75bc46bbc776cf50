"""Libraries of inner functions, which are linked into kernels: neither optimised nor made machine code on their own.

numba compiles each function that another calls as if it were called from Python, too. A kernel is optimised as a whole
after all of its inner functions have been linked in, so that this work is done for nothing: half of compiling's time.
The names used here are numba's own; where one is missing, the plain library serves.
"""

from __future__ import annotations

import functools
from typing import Any


@functools.cache
def inner_compiler() -> Any:
    """The compiler of inner functions, for numba's `pipeline_class`; None where numba's own names have changed."""
    try:
        from numba.core.codegen import JITCodeLibrary
        from numba.core.compiler import Compiler
    except ImportError:
        return None
    if not all(hasattr(JITCodeLibrary, name) for name in ("_optimize_final_module", "_finalize_final_module")):
        return None

    class Codegen:
        """The code generator of a library whose functions have no environment in memory."""

        def __init__(self, generator: Any) -> None:
            self._generator = generator

        def __getattr__(self, name: str) -> Any:
            return getattr(self._generator, name)

        def set_env(self, name: str, env: Any) -> None:
            """Nothing: there is no machine code that would read it."""

    class InnerLibrary(JITCodeLibrary):  # type: ignore[misc]
        """Code that is only linked."""

        @property
        def codegen(self) -> Any:
            return Codegen(self._codegen)

        def _optimize_final_module(self) -> None:
            pass

        def _finalize_final_module(self) -> None:
            self._finalized = True

        def get_pointer_to_function(self, name: str) -> int:
            return 0

    class InnerCompiler(Compiler):  # type: ignore[misc]
        """numba's compiler, into an `InnerLibrary`."""

        def __init__(self, typingctx: Any, targetctx: Any, library: Any, *others: Any) -> None:
            super().__init__(typingctx, targetctx, library or InnerLibrary(targetctx.codegen(), "inner"), *others)

    return InnerCompiler
