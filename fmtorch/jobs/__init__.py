"""Who does the work: threads, processes, a cluster of Dask, shards; one scheduler for every loop over pairs."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.jobs.execution import Execution, available, mapped, one_thread, use_one_thread
    from fmtorch.jobs.runner import DEATH, Factory, Local, Source, TaskRunner, WorkerPool, WorkersLost, in_order

__all__ = [
    "DEATH", "Execution", "Factory", "Local", "Source", "TaskRunner", "WorkerPool", "WorkersLost", "available",
    "in_order", "mapped", "one_thread", "use_one_thread",
]  # fmt: skip

lazy_exports(__name__)
