"""`fmtorch train pruner=lc`: train a learned pruner on the labelled matches of a data set."""

import functools
import sys

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from fmtorch.commands.config import job, run_command
from fmtorch.commands.options import TRAIN
from fmtorch.core.terminal import console


@job
def task(config: DictConfig) -> None:
    """What Hydra runs."""
    try:
        from lightning.fabric.utilities.exceptions import MisconfigurationException

        from fmtorch.training.run import run
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ("lightning", "tensorboard"):
            raise
        raise ImportError(f"training needs {error.name}: pip install 'fmtorch[train]'") from error
    name = str(HydraConfig.get().runtime.choices["pruner"])
    if not any(word.startswith("pruner=") for word in HydraConfig.get().overrides.task):
        console.print(f"no pruner= is given: {name} is trained, the network of Yi et al. (CVPR 2018)")
    if sys.argv[1:2] != ["train"]:
        sys.argv.insert(1, "train")  # Lightning starts its other processes by these words
    try:
        run(config, name)
    except MisconfigurationException as error:
        raise ValueError(f"{str(error).partition(' HINT')[0]} (trainer=, validation.monitor=)") from error


main = functools.partial(run_command, TRAIN, task)
