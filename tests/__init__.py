"""Tests, and the checker of arguments while they run."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""As beartype, and a whole number is a float, as in Python's typing (PEP 484)."""
