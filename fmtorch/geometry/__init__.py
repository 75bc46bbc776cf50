"""Two-view projective geometry as pure, batched, differentiable functions."""
