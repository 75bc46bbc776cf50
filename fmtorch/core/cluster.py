"""A cluster of dask.distributed, one that runs or one of this machine, as an executor."""

from __future__ import annotations

import time
from concurrent.futures import CancelledError, Executor
from typing import Any

SECONDS_TO_CONNECT = 10.0
SECONDS_FOR_WORKERS = 60.0
SECONDS_BETWEEN_COUNTS = 2.0


class Cluster:
    """A client of a scheduler.

    Raises ImportError without dask, and ValueError where nobody answers at the address or no worker comes.
    """

    def __init__(self, address: str | None, workers: int) -> None:
        try:
            import distributed
        except ImportError as error:
            raise ImportError("executor=dask needs dask and distributed: pip install 'fmtorch[dask]'") from error
        self._local: Any = None
        if address is None:
            # What workers log of a worker that died, and of their own end, is ours to say.
            self._local = distributed.LocalCluster(
                workers, threads_per_worker=1, dashboard_address=None, silence_logs=50, protocol="tcp"
            )
        try:
            self.client = distributed.Client(self._local or address, timeout=SECONDS_TO_CONNECT, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ValueError(
                f"executor.address={address}: no scheduler answers; start one by `dask scheduler`, or leave the "
                "address out for a cluster on this machine"
            ) from error
        self.address = str(address or self._local.scheduler_address)
        try:
            self.client.wait_for_workers(1, timeout=SECONDS_FOR_WORKERS)
        except TimeoutError as error:
            self.close()
            raise ValueError(
                f"executor.address={address}: the scheduler has no workers; start some by `dask worker {address}`"
            ) from error
        self.executor: Executor = self.client.get_executor(pure=False)
        self._threads, self._counted = 1, 0.0

    def threads(self) -> int:
        """How many calls the workers do at a time, counted now and then: workers join and leave."""
        if time.monotonic() - self._counted > SECONDS_BETWEEN_COUNTS:
            try:
                self._threads = max(1, sum(self.client.nthreads().values()))
            except (OSError, TimeoutError, CancelledError):
                return self._threads  # the calls will tell
            self._counted = time.monotonic()
        return self._threads

    def lost(self, error: BaseException) -> bool:
        """Whether an error of a call, which nobody cancelled, means that the scheduler is gone."""
        return isinstance(error, CancelledError) or self.client.status != "running"

    def close(self) -> None:
        """Leave the cluster, and end one of this machine."""
        self.client.close(timeout=SECONDS_TO_CONNECT)
        if self._local is not None:
            self._local.close(timeout=SECONDS_TO_CONNECT)
