"""`python -m scripts.benchmark estimators ...`, in the checkout's folder: one command for each benchmark."""

from __future__ import annotations

import argparse

if not __package__:
    raise SystemExit("run it in the checkout's folder, as a module: python -m scripts.benchmark COMMAND ...")

from scripts.benchmark import (
    cameras,
    configuration,
    curves,
    end_to_end,
    estimators,
    features,
    gc_ransac,
    hard,
    homography,
    known_models,
    learned,
    matching,
    memory,
    paper,
    paper_times,
    pipelines,
    posebench,
    pruning,
    refinement,
    related,
    scale,
    similar,
    speed,
    stages,
    stress,
    sweep,
    thresholds,
    verify,
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m scripts.benchmark", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for module in (
        cameras, configuration, curves, end_to_end, estimators, features, gc_ransac, hard, homography, known_models,
        learned, matching, memory, paper, paper_times, pipelines, posebench, pruning, refinement, related, scale,
        similar, speed, stages, stress, sweep, thresholds, verify,
    ):  # fmt: skip
        module.add_arguments(commands)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
