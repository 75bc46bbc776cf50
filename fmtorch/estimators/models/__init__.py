"""Model families: what a minimal sample is, how it is solved, refined and fitted."""
