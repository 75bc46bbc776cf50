"""The executor of a command's config: the group `executor`, and its short forms `workers` and `processes`."""

from __future__ import annotations

import dataclasses
import functools
from concurrent.futures import Executor
from typing import cast

from omegaconf import DictConfig

from fmtorch.core.options import Count
from fmtorch.jobs.execution import Execution
from fmtorch.presets.composition import plain
from fmtorch.presets.fields import read_fields
from fmtorch.presets.objects import expect_buildable, instantiate


@dataclasses.dataclass(frozen=True)
class ExecutorFields:
    """What ``conf/executor`` holds; its files say what each is."""

    name: str = "auto"
    workers: Count | None = None
    address: str | None = None
    send_images: bool = False


def execution_of(config: DictConfig, workers: int | None = None, processes: bool | None = None) -> Execution:
    """The execution that a composed config asks for.

    workers: in place of ``executor.workers``. processes: true or false in place of the executors of these kinds.
    Raises ValueError for what is wrong or contradicts itself.
    """
    options = plain(config.executor)
    fields = read_fields(ExecutorFields, config.executor, "executor")
    if workers is not None and fields.workers not in (None, workers):
        raise ValueError(f"workers={workers} and executor.workers={fields.workers} differ; give one of them")
    count = workers or fields.workers
    if "_target_" in options:
        target = {key: value for key, value in options.items() if key not in ExecutorFields.__dataclass_fields__}
        expect_buildable(target, "executor")
        make = functools.partial(instantiate, target, "executor")
        return Execution("threads", count, None, fields.send_images, cast("functools.partial[Executor]", make))
    kind = fields.name
    if processes is not None:
        wanted = "processes" if processes else "threads"
        if kind not in ("auto", wanted):
            raise ValueError(f"processes={str(processes).lower()} and executor={kind} differ; give one of them")
        kind = wanted
    return Execution(kind, count, fields.address, fields.send_images)
