"""Which families of pairs have wide baselines."""

from __future__ import annotations

WIDE = (
    "Tanks_and_Temples", "CPC",  # of FM-Bench
    "Strecha", "Strecha_train", "PhotoTourism", "TanksLike",  # further photographs of unordered scenes
    "orbit", "collection",  # rendered
)  # fmt: skip
"""Families of wide baselines by name. The others are taken for videos, whose baselines are short."""
