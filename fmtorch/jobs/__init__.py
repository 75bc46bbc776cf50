"""Who does the work: threads, processes, a cluster of Dask, shards; one scheduler for every loop over pairs."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.jobs.execution import Execution
    from fmtorch.jobs.pool import WorkerPool, WorkersLost
    from fmtorch.jobs.runner import DEATH, Factory, Local, TaskRunner, in_order
    from fmtorch.jobs.threads import available, mapped, one_thread

__all__ = [
    "DEATH", "Execution", "Factory", "Local", "TaskRunner", "WorkerPool", "WorkersLost", "available", "in_order",
    "mapped", "one_thread",
]  # fmt: skip

lazy_exports(__name__)
