"""The exchangeable parts of the engine: one class a file, its kernels beside it."""
