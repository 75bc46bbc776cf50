"""`python -m fmtorch.train pruner=lc`: train a learned pruner on the labelled matches of a data set."""

from __future__ import annotations

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from fmtorch.command import exits_with_message
from fmtorch.resources import conf_dir


@hydra.main(version_base=None, config_path=str(conf_dir()), config_name="train")
def main(config: DictConfig) -> None:
    """The command."""
    with exits_with_message("interrupted; the same command continues the training"):
        try:
            from fmtorch.training.pruners.run import run
        except ModuleNotFoundError as error:
            if (error.name or "").split(".")[0] not in ("lightning", "tensorboard"):
                raise
            raise ImportError(f"training needs {error.name}: pip install 'fmtorch[train]'") from error
        run(config, str(HydraConfig.get().runtime.choices["pruner"]))


if __name__ == "__main__":
    main()
