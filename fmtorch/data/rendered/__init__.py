"""The embedded data set: scenes drawn from known cameras, and a real stereo pair; nothing is downloaded."""

from fmtorch.data.rendered.dataset import RenderedPairs
from fmtorch.data.rendered.generate import Plan
from fmtorch.data.rendered.stereo import StereoPair

__all__ = ["Plan", "RenderedPairs", "StereoPair"]
