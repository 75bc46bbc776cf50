"""A prior on cameras: square pixels, a central principal point, a usual focal length.

With the principal points at the image centres a fundamental matrix ``F = K1^-T E K0^-1`` has the same seven degrees of
freedom as an essential matrix and two focal lengths. Refined in these, a model pays for implausible focal lengths:
maximum a posteriori instead of maximum likelihood. Cropped photographs violate the assumption, so the result stands
only where it explains the matches about as well as the best model without it.

prior: costs and draws of focal lengths. cameras: factors of F. posterior: refinement with the prior. hypotheses:
models of five matches and drawn focal lengths. cheirality: matches behind a camera. selection: which candidate is the
estimate. fit: the last one, at the noise of the pair. None of them knows the engine. A pair has the same bits in any
batch.
"""
