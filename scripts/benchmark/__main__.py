"""`python -m scripts.benchmark estimators ...`, in the checkout's folder: one command for each benchmark."""

import argparse
import importlib

import cv2
import torch

from fmtorch.core.terminal import exits_with_message

if not __package__:
    raise SystemExit("run it in the checkout's folder, as a module: python -m scripts.benchmark COMMAND ...")

MODULES = "cameras estimators pipelines planes speed verify"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m scripts.benchmark", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for module in MODULES.split():
        importlib.import_module(f"scripts.benchmark.{module}").add_arguments(commands)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    with exits_with_message():
        arguments.run(arguments)


if __name__ == "__main__":
    main()
