"""Features x Features -> Correspondences."""
