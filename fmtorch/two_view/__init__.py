"""Matches of two images -> fundamental, essential and homography matrices: what users call."""
