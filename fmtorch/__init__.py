"""fmtorch: batched, differentiable two-view geometry in PyTorch."""

__version__ = "0.1.0"
