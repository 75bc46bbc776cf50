"""The kernel form of the prior on focal lengths: each module that of its namesake in `estimators.focal`."""
