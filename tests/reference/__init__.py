"""Slow, obvious scalar versions, written from the definitions, that the batched code is compared with."""
