"""The embedded data set: scenes drawn from known cameras, and a real stereo pair; nothing is downloaded."""

from fmtorch.scenes.dataset import Plan, RenderedPairs, StereoPair

__all__ = ["Plan", "RenderedPairs", "StereoPair"]
