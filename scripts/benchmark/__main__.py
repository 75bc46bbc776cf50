"""`python -m scripts.benchmark estimators ...`, in the checkout's folder: one command for each benchmark."""

from __future__ import annotations

import argparse

import cv2
import torch

if not __package__:
    raise SystemExit("run it in the checkout's folder, as a module: python -m scripts.benchmark COMMAND ...")

from scripts.benchmark import cameras, estimators, pipelines, planes, posebench, related, stress


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m scripts.benchmark", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for module in (cameras, estimators, pipelines, planes, posebench, related, stress):
        module.add_arguments(commands)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    arguments.run(arguments)


if __name__ == "__main__":
    main()
