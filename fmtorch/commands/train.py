"""`fmtorch train pruner=lc`: train a learned pruner on the labelled matches of a data set."""

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from fmtorch.commands.config import job, run_command
from fmtorch.commands.options import TRAIN


@job
def task(config: DictConfig) -> None:
    """What Hydra runs."""
    try:
        from fmtorch.training.run import run
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ("lightning", "tensorboard"):
            raise
        raise ImportError(f"training needs {error.name}: pip install 'fmtorch[train]'") from error
    run(config, str(HydraConfig.get().runtime.choices["pruner"]))


def main() -> None:
    """The command."""
    run_command(TRAIN, task)
