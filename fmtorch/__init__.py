"""fmtorch: batched, differentiable two-view geometry in PyTorch."""

import importlib
import importlib.util
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from fmtorch.core.version import __version__

if TYPE_CHECKING:
    from fmtorch.core.types import Correspondences, Estimate, Features
    from fmtorch.pipeline.essential import find_essential
    from fmtorch.pipeline.fundamental import find_fundamental, find_homography
    from fmtorch.pipeline.pipeline import Pipeline
    from fmtorch.pipeline.two_images import MatchResult, match
    from fmtorch.pipeline.verification import verify
    from fmtorch.pipeline.verification_run import Verification

__all__ = [
    "Correspondences",
    "Estimate",
    "Features",
    "MatchResult",
    "Pipeline",
    "Verification",
    "__version__",
    "find_essential",
    "find_fundamental",
    "find_homography",
    "match",
    "verify",
]

_MODULES = {
    "Correspondences": "core.types", "Estimate": "core.types", "Features": "core.types",
    "MatchResult": "pipeline.two_images", "Pipeline": "pipeline.pipeline", "match": "pipeline.two_images",
    "find_essential": "pipeline.essential", "find_fundamental": "pipeline.fundamental",
    "find_homography": "pipeline.fundamental", "Verification": "pipeline.verification_run",
    "verify": "pipeline.verification",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """Public names and submodules, imported at their first use: `fmtorch --help` need not wait for torch."""
    if name in _MODULES:
        value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    elif not name.startswith("_") and importlib.util.find_spec(f"{__name__}.{name}") is not None:
        value = importlib.import_module(f"{__name__}.{name}")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """The package, in which `match` and `verify` are the functions.

    Python makes each submodule that is imported an attribute of its package, `fmtorch.match` too, which runs the
    command of that name; it stays ``sys.modules["fmtorch.match"]`` alone. Nothing shorter does: a module that puts the
    function in its own place in `sys.modules` has no ``__spec__``, without which neither `fmtorch match` nor
    ``importlib.reload`` finds it again.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in ("match", "verify") and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
