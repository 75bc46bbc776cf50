"""`python scripts/benchmark estimators ...`: speed and accuracy against peers, in one run, on the same inputs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import estimators
import features
import learned
import matching
import memory
import pipelines
import pruning
import speed
import thresholds


def main() -> None:
    parser = argparse.ArgumentParser(prog="scripts/benchmark", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for module in (estimators, features, learned, matching, memory, pipelines, pruning, speed, thresholds):
        module.add_arguments(commands)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
