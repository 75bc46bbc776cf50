"""Correspondences -> Correspondences."""
