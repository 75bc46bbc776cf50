"""What the commands share: the console, plain parts of a config, and how errors end a command."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Any

from omegaconf import DictConfig, OmegaConf
from rich.console import Console

console = Console()


def plain(config: Any) -> dict[str, Any]:
    """A part of a config as a dictionary without interpolations; empty for null."""
    container = OmegaConf.to_container(config, resolve=True) if isinstance(config, DictConfig) else {}
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


@contextlib.contextmanager
def exits_with_message(interrupted: str = "interrupted") -> Iterator[None]:
    """Ends the process with status 1 and one line for what a user can put right, rather than with a traceback."""
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(interrupted)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"error: {error}")
