"""Functions compiled by numba: how they are declared, compiled, kept, and called by one another."""
