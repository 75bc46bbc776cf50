"""`python -m scripts.benchmark`: speed and accuracy against peers, in one run, on the same inputs."""
