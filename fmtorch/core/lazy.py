"""Packages whose public names are imported when they are first used."""

import ast
import functools
import importlib
import importlib.util
import inspect
import sys
from pathlib import Path
from types import ModuleType
from typing import Any


def imported(library: str, needed: str) -> Any:
    """A library that is not always there. Raises ImportError, which says what is `needed`, where it is not."""
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise ImportError(needed) from error


def lazy_exports(package: str, checked: bool = False) -> None:
    """Import the names that a package lists under ``if TYPE_CHECKING:``, and its modules, at their first use.
    checked: exported functions check their arguments, see `fmtorch.core.checks.checked`. The package's own modules
    import each other's functions unchecked, from where they are defined."""
    vars(sys.modules[package])["_checked"] = checked
    sys.modules[package].__class__ = _LazyPackage


class _LazyPackage(ModuleType):
    _checked: bool

    def __getattr__(self, name: str) -> Any:
        source = None if name.startswith("_") else _sources(str(self.__file__)).get(name)
        if source is not None:
            value = getattr(importlib.import_module(source), name)
            if self._checked and inspect.isfunction(value):
                from fmtorch.core.checks import checked

                value = checked(value)
                value.__module__ = self.__name__  # where pickle finds it
        elif not name.startswith("_") and importlib.util.find_spec(f"{self.__name__}.{name}") is not None:
            value = importlib.import_module(f"{self.__name__}.{name}")
        else:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        setattr(self, name, value)
        return value

    def __setattr__(self, name: str, value: object) -> None:
        """Python makes a module that is imported an attribute of its package; the function of its name stays that."""
        if not (isinstance(value, ModuleType) and name in self.__all__):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*vars(self), *self.__all__})


@functools.cache
def _sources(file: str) -> dict[str, str]:
    """The names that a file imports under ``if TYPE_CHECKING:``, and the modules that it imports them from."""
    blocks = [node for node in ast.parse(Path(file).read_bytes()).body if isinstance(node, ast.If)]
    imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}
