"""Training of learned parts: patch networks."""
