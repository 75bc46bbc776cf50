"""Training of learned pruners: what is minimised, how it is validated, and the loop; needs the extra `train`."""
