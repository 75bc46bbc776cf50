"""Correspondences -> Estimate."""
