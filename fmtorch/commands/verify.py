"""`fmtorch verify DATABASE`: two-view geometries of the matches in a COLMAP database."""

import functools
import re
import sys

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.table import Column, Table

from fmtorch import presets
from fmtorch.commands.config import job, run_command
from fmtorch.commands.options import VERIFY, VerifyOptions
from fmtorch.core.terminal import console, errors, progress_bars, reporter
from fmtorch.jobs.execution import shard_of
from fmtorch.presets.composition import execution_of, plain, read_fields
from fmtorch.verification.verify import ONE_THREAD, Verification, VerifyMode, VerifyPaths, verify_by

MAX_PROBLEMS = 20  # that are printed


def run(config: DictConfig, estimator: str) -> Verification:
    """Verify the database of a composed config, by a preset whose options are those of the config."""
    fields = read_fields(VerifyOptions, config)
    presets.expect_buildable(plain(config.estimator), "estimator")
    make = functools.partial(presets.instantiate, plain(config.estimator), "estimator")
    execution = execution_of(config).decided(False)
    if execution.shared and execution.workers is None:
        execution = ONE_THREAD
    shard, debug = shard_of(fields.shard), bool(fields.debug)
    mode = VerifyMode(fields.cameras, fields.lens, fields.force, fields.seed, execution, shard, debug)
    paths = VerifyPaths(fields.database, fields.features_file, fields.matches, fields.output)
    with progress_bars() as progress:
        result = verify_by(make, {"estimator": plain(config.estimator)}, paths, mode, reporter(progress, estimator))
    for problem in result.problems[:MAX_PROBLEMS]:
        errors.print(problem, style="bold", soft_wrap=True)
    if len(result.problems) > MAX_PROBLEMS:
        errors.print(f"and {len(result.problems) - MAX_PROBLEMS} more")
    for trace in result.tracebacks[:MAX_PROBLEMS]:
        errors.print(trace, soft_wrap=True)
    for warning in result.warnings[:MAX_PROBLEMS]:
        errors.print(f"warning: {warning}", soft_wrap=True)
    if result.kept == result.pairs and not result.configurations:
        said = f"{result.path} has a geometry of each pair ({result.pairs:,}); force=true replaces them"
        console.print(f"nothing to do: {said}", soft_wrap=True)
    console.print(_table(result))
    if result.pairs and len(result.problems) == result.pairs:
        sys.exit("error: no pair has a geometry")
    console.print(str(result.path), style="dim")
    return result


def _table(result: Verification) -> Table:
    table = Table("pairs", Column(justify="right"))
    kinds = sorted(result.configurations.items(), key=lambda entry: -entry[1])
    rows: list[tuple[str, int]] = [("with matches", result.pairs)]
    rows += [("had a geometry", result.kept)] * bool(result.kept)
    rows += [("verified", result.verified), *((f"  {kind.replace('_', ' ')}", count) for kind, count in kinds)]
    rows += [("failed", len(result.problems))] * bool(result.problems)
    for name, count in rows:
        table.add_row(name, f"{count:,}")
    table.add_row("seconds", f"{result.seconds:.1f}")
    table.add_row("a second", f"{sum(result.configurations.values()) / result.seconds:.1f}")
    return table


@job
def task(config: DictConfig) -> None:
    """What Hydra runs."""
    run(config, str(HydraConfig.get().runtime.choices.get("estimator", "estimator")))


def main() -> None:
    """The command."""
    sys.argv[1:] = [re.sub("^features=", "features_file=", word) for word in sys.argv[1:]]  # no preset of conf/features
    run_command(VERIFY, task)
