"""Runs by threads, processes, a cluster of dask and anybody's executor: the same rows, whatever dies meanwhile."""

import contextlib
import dataclasses
import functools
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from fmtorch.data import ImagePair
from fmtorch.evaluation import evaluate_pairs
from fmtorch.jobs import Execution, WorkersLost
from fmtorch.pipeline import Pipeline, load_pipeline
from fmtorch.runs import PairRow
from scripts.benchmark.pairs import synthetic_pair

PAIRS = 96
SLOW_SECONDS = 0.3  # of each batch of a slow pipeline, so that there is time to kill its workers
PATIENCE = 240.0  # seconds for a scheduler to answer, or workers to come


def build() -> Pipeline:
    built: Pipeline = load_pipeline("given_fmtorch")
    return built


class Slow:
    """An estimator that waits."""

    model = "fundamental"

    def __init__(self, estimator: Any) -> None:
        self.estimator = estimator

    def __call__(self, c: Any, seed: int = 0) -> Any:
        time.sleep(SLOW_SECONDS)
        return self.estimator(c, seed)


def build_slow() -> Pipeline:
    pipeline = build()
    pipeline.estimator = Slow(pipeline.estimator)
    return pipeline


@pytest.fixture(scope="module")
def pairs() -> list[ImagePair]:
    return [synthetic_pair(i, 150, 0) for i in range(PAIRS)]


@pytest.fixture(scope="module")
def expected(pairs: list[ImagePair]) -> dict[int, PairRow]:
    return evaluated(pairs, Execution("threads", 1))


def evaluated(pairs: list[ImagePair], execution: Execution, make: Any = build) -> dict[int, PairRow]:
    """The rows by key, without seconds. Fails where a pair has several."""
    rows: list[PairRow] = []
    for _ in evaluate_pairs(build(), pairs, seed=0, batch=4, execution=execution, store=rows.extend, build=make):
        pass
    assert len(rows) == len({row.key for row in rows})
    return timeless(rows)


def timeless(rows: list[PairRow]) -> dict[int, PairRow]:
    seconds = {field.name: None for field in dataclasses.fields(PairRow) if field.name.startswith("seconds")}
    return {row.key: dataclasses.replace(row, **seconds) for row in rows}  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_rows_of_threads_and_processes(kind: str, pairs: list[ImagePair], expected: dict[int, PairRow]) -> None:
    assert evaluated(pairs, Execution(kind, 2)) == expected


@pytest.mark.parametrize(("workers", "many", "kind"), [
    (1, True, "threads"), (2, True, "processes"), (2, False, "threads"), (None, True, "processes"),
])  # fmt: skip
def test_many_pairs_go_to_processes_unless_there_is_a_single_worker(
    workers: int | None, many: bool, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fmtorch.jobs.execution.cores", lambda: 2)
    assert Execution("auto", workers).decided(many).kind == kind
    assert Execution("processes", workers).decided(many).kind == "processes"  # as it was asked for


def test_rows_of_an_executor_of_ones_own(pairs: list[ImagePair], expected: dict[int, PairRow]) -> None:
    own = Execution(workers=2, send_images=True, make=functools.partial(ThreadPoolExecutor, 2))
    assert evaluated(pairs, own) == expected


class Cluster:
    """A scheduler in a process of its own, and workers, each with a nanny that starts it again."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "log.txt"
        self.processes: list[subprocess.Popen[bytes]] = []
        self.scheduler = self._start("scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard")
        self.address = self._read_address()

    def _start(self, name: str, *words: str) -> subprocess.Popen[bytes]:
        with self.log.open("ab") as log:
            command = [sys.executable, "-m", "dask", name, *words]
            process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        self.processes.append(process)
        return process

    def _read_address(self) -> str:
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            for word in self.log.read_text().split():
                if word.startswith("tcp://"):
                    return word
            time.sleep(0.05)
        raise AssertionError(self.log.read_text())

    def add_workers(self, count: int) -> None:
        self._start("worker", self.address, "--nworkers", str(count), "--nthreads", "1", "--no-dashboard")

    def client(self) -> Any:
        import distributed

        return distributed.Client(self.address, set_as_default=False, timeout=PATIENCE)

    def close(self) -> None:
        for process in reversed(self.processes):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    dask_cluster = Cluster(tmp_path)
    yield dask_cluster
    dask_cluster.close()


def test_two_of_four_workers_are_killed(cluster: Cluster, pairs: list[ImagePair], expected: dict[int, PairRow]) -> None:
    cluster.add_workers(4)
    killed: list[int] = []

    def kill() -> None:
        with cluster.client() as client:
            client.wait_for_workers(4, timeout=PATIENCE)
            started.set()
            moments = random.Random(0)
            for _ in range(2):
                time.sleep(moments.uniform(0.5, 1.5))
                pid = moments.choice(sorted(client.run(os.getpid).values()))
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

    started = threading.Event()
    killer = threading.Thread(target=kill)
    killer.start()
    assert started.wait(PATIENCE)
    rows = evaluated(pairs, Execution("dask", address=cluster.address, send_images=True), build_slow)
    killer.join()
    assert len(set(killed)) == 2
    assert rows == expected


def test_a_scheduler_that_is_lost(cluster: Cluster, pairs: list[ImagePair], expected: dict[int, PairRow]) -> None:
    cluster.add_workers(1)
    rows: list[PairRow] = []
    execution = Execution("dask", address=cluster.address)
    counts = evaluate_pairs(
        build(), pairs, seed=0, batch=2, execution=execution, store=rows.extend, build=build_slow
    )  # fmt: skip
    next(counts)
    cluster.scheduler.kill()
    with pytest.raises(WorkersLost, match=rf"the scheduler at {cluster.address} was lost; .* the same command goes on"):
        list(counts)
    assert 0 < len(rows) < PAIRS
    missing = [pair for pair in pairs if pair.key not in timeless(rows)]
    assert timeless(rows) | evaluated(missing, Execution("threads", 1)) == expected


def test_an_address_that_nobody_answers(pairs: list[ImagePair], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    monkeypatch.setattr("fmtorch.jobs.runner.SECONDS_TO_CONNECT", 1.0)
    with pytest.raises(ValueError, match=r"executor\.address=tcp://127\.0\.0\.1:9: no scheduler answers"):
        evaluated(pairs, Execution("dask", address="tcp://127.0.0.1:9"))


def test_a_cluster_of_this_machine(pairs: list[ImagePair], expected: dict[int, PairRow]) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    assert evaluated(pairs, Execution("dask", 2)) == expected
