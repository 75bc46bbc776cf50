"""Figures of merit for fundamental matrices and matches, as plain batched functions."""
