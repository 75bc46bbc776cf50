"""Evaluation by executors and workers, and what identifies a run."""

import contextlib
import dataclasses
import functools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from omegaconf import OmegaConf

from fmtorch import presets
from fmtorch.core import Correspondences, Estimate, Features, Pruner
from fmtorch.data import ImagePair, ImageSource
from fmtorch.evaluation import evaluate_pairs, run_identity
from fmtorch.jobs import Execution, WorkersLost
from fmtorch.pipeline import Pipeline, build_pipeline, load_pipeline
from fmtorch.runs import PairRow, identity_digest, libraries
from scripts.benchmark.pairs import synthetic_pair
from tests.helpers import compose, draw, pair
from tests.jobs.work import ends, given_pipeline, slow_pipeline
from tests.processes import alive

PAIRS = 24
PATIENCE = 240.0  # seconds for a scheduler to answer, or workers to come


@pytest.fixture(scope="module")
def pairs() -> list[ImagePair]:
    return [synthetic_pair(i, 150, 0) for i in range(PAIRS)]


@pytest.fixture(scope="module")
def expected(pairs: list[ImagePair]) -> dict[int, str]:
    return evaluated(pairs, Execution("threads", 1))


def evaluated(pairs: list[ImagePair], execution: Execution, make: Any = given_pipeline) -> dict[int, str]:
    """The rows by key, without seconds. Fails where a pair has several."""
    rows: list[PairRow] = []
    options: dict[str, Any] = {"execution": execution, "store": rows.extend, "build": make}
    list(evaluate_pairs(given_pipeline(), pairs, seed=0, batch=2, **options))
    assert len(rows) == len({row.key for row in rows})
    return timeless(rows)


def timeless(rows: list[PairRow]) -> dict[int, str]:
    seconds = {field.name: None for field in dataclasses.fields(PairRow) if field.name.startswith("seconds")}
    return {row.key: repr(dataclasses.replace(row, **seconds)) for row in rows}  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_rows_of_threads_and_processes(kind: str, pairs: list[ImagePair], expected: dict[int, str]) -> None:
    assert evaluated(pairs, Execution(kind, 2)) == expected


@pytest.mark.parametrize(("workers", "many", "kind"), [
    (1, True, "threads"), (2, True, "processes"), (2, False, "threads"), (None, True, "processes"),
])  # fmt: skip
def test_many_pairs_go_to_processes_unless_there_is_a_single_worker(workers, many, kind, monkeypatch):
    monkeypatch.setattr("fmtorch.jobs.execution.cores", lambda: 2)
    assert Execution("auto", workers).decided(many).kind == kind
    assert Execution("processes", workers).decided(many).kind == "processes"  # as it was asked for


class Cluster:
    """A scheduler in a process of its own, and workers, each with a nanny that starts it again."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "log.txt"
        self.processes: list[subprocess.Popen[bytes]] = []
        self.scheduler = self._start("scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard")
        self.address = self._read_address()
        self._start("worker", self.address, "--nworkers", "2", "--nthreads", "1", "--no-dashboard")

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

    def client(self) -> Any:
        import distributed

        return distributed.Client(self.address, set_as_default=False, timeout=PATIENCE)

    def close(self) -> None:
        for process in reversed(self.processes):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Of two workers; the last test that takes it ends its scheduler."""
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    dask_cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    yield dask_cluster
    dask_cluster.close()


def test_workers_are_killed(cluster: Cluster, pairs: list[ImagePair], expected: dict[int, str]) -> None:
    killed: list[int] = []

    def kill() -> None:
        with cluster.client() as client:
            client.wait_for_workers(2, timeout=PATIENCE)
            started.set()
            for pid in sorted(client.run(os.getpid).values()):
                time.sleep(0.7)
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

    started = threading.Event()
    killer = threading.Thread(target=kill)
    killer.start()
    assert started.wait(PATIENCE)
    rows = evaluated(pairs, Execution("dask", address=cluster.address, send_images=True), slow_pipeline)
    killer.join()
    assert (len(set(killed)), rows) == (2, expected)


def test_a_scheduler_that_is_lost(cluster: Cluster, pairs: list[ImagePair], expected: dict[int, str]) -> None:
    rows, execution = list[PairRow](), Execution("dask", address=cluster.address)
    options: dict[str, Any] = {"execution": execution, "store": rows.extend, "build": slow_pipeline}
    counts = evaluate_pairs(given_pipeline(), pairs, seed=0, batch=2, **options)
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


def test_a_cluster_of_this_machine(pairs: list[ImagePair], expected: dict[int, str]) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    assert evaluated(pairs, Execution("dask", 1)) == expected


WORKER = """
import multiprocessing, time
from fmtorch.jobs.runner import end_with_parent
def work():
    end_with_parent()
    print(multiprocessing.current_process().pid, flush=True)
    time.sleep(300)
multiprocessing.get_context("fork").Process(target=work).start()
time.sleep(300)
"""


def test_a_worker_ends_with_the_process_that_was_killed() -> None:
    parent = subprocess.Popen([sys.executable, "-c", WORKER], stdout=subprocess.PIPE, text=True)
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 60
    while alive(worker) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(worker)


def test_a_process_that_ends_is_reported() -> None:
    """After the pairs of its batch were tried alone."""
    images = [ImageSource(f"{i}", Path(f"{i}.png")) for i in range(3)]
    pairs, rows = [pair(f"0-{i}", images[0], images[i]) for i in (1, 2)], list[PairRow]()
    build = functools.partial(ends, Path())
    options: dict[str, Any] = {"execution": Execution("processes", 2), "store": rows.extend, "build": build}
    with pytest.raises(WorkersLost, match="the same command goes on"):
        list(evaluate_pairs(load_pipeline("sift_ratio"), pairs, seed=0, batch=2, **options))
    assert rows == []


def test_features_are_computed_while_kernels_are_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = [draw(tmp_path / f"{i}.png", i) for i in range(7)]
    pairs = [pair(f"0-{i}", images[0], image) for i, image in enumerate(images)][1:]
    pairs.insert(2, pair("0-bad", images[0], ImageSource("bad", tmp_path / "absent.png")))
    expected, rows, options = list[PairRow](), list[PairRow](), {"seed": 0, "batch": 2}
    first = load_pipeline("sift_ratio")
    list(evaluate_pairs(first, pairs, **options, execution=Execution("threads", 1), store=expected.extend))
    pipeline = load_pipeline("sift_ratio")
    extracted, enough, extractor = list[int](), threading.Event(), pipeline.extractor

    def extract(image: NDArray[np.uint8]) -> Features:
        extracted.append(int(image.sum()))
        enough.set()
        return extractor(image)

    def wait(stages: Sequence[object]) -> None:
        assert enough.wait(60)  # for features, which nobody computes before

    pipeline.extractor = extract  # type: ignore[assignment]
    monkeypatch.setattr("fmtorch.two_view.pair_type.compile_with", wait)
    counts = list(evaluate_pairs(pipeline, pairs, **options, execution=Execution("threads", 2), store=rows.extend))
    assert len(extracted) == len(set(extracted)) == len(images)  # each once
    assert sum(counts) == len(pairs)
    assert timeless(rows) == timeless(expected)
    assert sum("absent.png" in row.reason for row in rows) == 1


@dataclasses.dataclass(frozen=True)
class Learned:
    """A stage of any kind that says which file it was learned from."""

    model: Path

    def __call__(self, c: Correspondences) -> Correspondences:
        return c


class Secretive:
    def __init__(self, weights: str) -> None:
        self.values = Path(weights).read_bytes()

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        raise NotImplementedError


class Described:
    """A stage whose `identity` names its file, and a network of its own."""

    def __init__(self, model: Path) -> None:
        self.identity = {"threshold": 0.5, "files": [model]}

    def __call__(self, c: Correspondences) -> Correspondences:
        return c


def identity(*overrides: str, pipeline: Pipeline | None = None, **own: dict[str, object]) -> dict[str, object]:
    composed = compose("eval", ("pipeline=sift_ratio", "cache=off", *overrides))
    config = OmegaConf.create({**{name: composed[name] for name in composed}, **own})
    return run_identity(config, "sift_ratio", pipeline or build_pipeline(config), "abc")


def test_what_changes_speed_alone_is_no_part_of_it() -> None:
    plain = identity()
    for change in ("limit=3", "batch=1", "workers=7", "processes=true", "device=cuda", "output=x", "cache_limit=1"):
        assert identity(change) == plain, change
    for change in ("seed=1", "pruner.ratio.threshold=0.9", "pruner=[one_to_one,ratio]", "dataset.size=full"):
        assert identity_digest(identity(change)) != identity_digest(plain), change


def test_versions_of_libraries_and_whether_kernels_are_used_are_part_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert {"torch", "opencv", "onnxruntime", "numpy"} <= set(libraries())
    for kernels in ("on", "off"):
        monkeypatch.setenv("FMTORCH_KERNELS", kernels)
        own = identity()
        assert own["kernels"] == ("off" if kernels == "off" else f"numba {numba.__version__}")
        assert own["libraries"]["torch"] == torch.__version__.partition("+")[0]  # not for which device it was built
        assert "poselib" not in own["libraries"]
    pytest.importorskip("poselib", reason="poselib (extra `peers`) is not installed")
    assert "poselib" in identity("estimator=poselib")["libraries"]


def test_learned_files_of_every_stage_are_part_of_it(tmp_path: Path) -> None:
    files = {name: tmp_path / f"{name}.bin" for name in ("matcher", "first", "second", "estimator")}
    for name, file in files.items():
        file.write_bytes(name.encode())

    def learned() -> dict[str, list[str]]:
        pruners: dict[str, Pruner] = {"a": Learned(files["first"]), "b": Described(files["second"])}
        estimator = {"_target_": f"{__name__}.Secretive", "weights": str(files["estimator"])}
        parts = Pipeline(
            presets.build("features", "rootsiftpca"), Learned(files["matcher"]), pruners,  # type: ignore[arg-type]
            presets.instantiate(estimator, "estimator"),
        )  # fmt: skip
        return identity(pipeline=parts, estimator=estimator)["learned"]  # type: ignore[return-value]

    before = learned()
    assert {group: len(digests) for group, digests in before.items()} == {
        "features": 1, "matcher": 1, "pruner": 2, "estimator": 1,
    }  # fmt: skip
    for name, file in files.items():
        file.write_bytes(b"other")
        now = learned()
        group = "pruner" if name in ("first", "second") else name
        assert {g for g in now if now[g] != before[g]} == {group}, name
        before = now


@pytest.mark.parametrize("group", ["features", "matcher", "pruner", "estimator", "dataset"])
def test_code_of_a_users_own_stage_is_part_of_it(group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert identity()["code"] == {}
    own = {"_target_": f"{__name__}.Learned", "model": "x"}
    parts = load_pipeline("sift_ratio")
    changed = {group: {"mine": own} if group == "pruner" else own}
    first = identity(pipeline=parts, **changed)
    assert list(first["code"]) == [f"{__name__}.Learned"]  # type: ignore[call-overload]
    monkeypatch.setattr("fmtorch.evaluation.run.code_digest", lambda module: f"edited {module}")
    second = identity(pipeline=parts, **changed)
    assert second["code"] == {f"{__name__}.Learned": f"edited {__name__}"}
    assert identity_digest(first) != identity_digest(second)
