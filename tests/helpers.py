"""What several tests share."""

from __future__ import annotations

import fmtorch.commands.config  # noqa: F401  the commands' configs, by their names
from fmtorch.presets.composition import compose as compose
