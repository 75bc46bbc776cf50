"""The embedded data set: scenes drawn from known cameras, and a real stereo pair; nothing is downloaded."""

from fmtorch.scenes.dataset import RenderedPairs, StereoPair
from fmtorch.scenes.generate import Plan

__all__ = ["Plan", "RenderedPairs", "StereoPair"]
