"""Two-view geometries of matches that others made."""
