"""Data sets of image pairs."""
