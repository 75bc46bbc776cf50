"""Functions compiled by numba: how they are declared, compiled, kept, and called by one another."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.jit.random import Stream, bits, mixed_seed, uniform

__all__ = [
    "Stream", "bits", "mixed_seed", "uniform",
]  # fmt: skip

lazy_exports(__name__)
