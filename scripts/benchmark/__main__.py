"""`python -m scripts.benchmark estimators ...`, in the checkout's folder: one command for each benchmark."""

from __future__ import annotations

import argparse

if not __package__:
    raise SystemExit("run it in the checkout's folder, as a module: python -m scripts.benchmark COMMAND ...")

from scripts.benchmark import (
    estimators,
    features,
    learned,
    matching,
    memory,
    pipelines,
    pruning,
    related,
    speed,
    stress,
    thresholds,
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m scripts.benchmark", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for module in (
        estimators,
        features,
        learned,
        matching,
        memory,
        pipelines,
        pruning,
        related,
        speed,
        stress,
        thresholds,
    ):
        module.add_arguments(commands)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
