"""Sizes of images from their headers alone."""

from __future__ import annotations

from pathlib import Path

from PIL import Image


def stored_size(path: Path) -> tuple[int, int] | None:
    """(h, w) of an image file, in pixels as stored; None where there is none, or no header that tells."""
    try:
        with Image.open(path) as image:
            return image.height, image.width
    except (OSError, ValueError, Image.DecompressionBombError):
        return None
