"""Tasks of workers that share what they need or make it, and of which some die."""

import functools
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch

import fmtorch
from fmtorch import presets
from fmtorch.core import collate
from fmtorch.data import read_image
from fmtorch.jobs import DEATH, Execution, Factory, Local, TaskRunner, WorkerPool, WorkersLost, in_order, mapped
from tests.helpers import draw, pair
from tests.helpers import small_pipeline as pipeline
from tests.jobs.work import ends, fails, late, make_needs, slow, squares
from tests.laws import scene

PROCESSES = Execution("processes", 2)


def calls(
    make: Callable[[], Any], execution: Execution, jobs: list[list[int]], **options: Any
) -> tuple[dict[int, int], dict[int, str], list[list[int]]]:
    """The results by number, why some have none, and the jobs that were yielded."""
    results, reasons = dict[int, int](), dict[int, str]()

    def keep(job: list[int], result: list[int]) -> None:
        results.update(zip(job, result, strict=True))

    def give_up(job: list[int], reason: str) -> None:
        reasons.update(dict.fromkeys(job, reason))

    source: Any = Local(make()) if execution.shared else Factory(make)
    options = {"give_up": give_up, "split": lambda numbers: [[number] for number in numbers], **options}
    with WorkerPool(execution) as pool:
        yielded = list(TaskRunner(pool, source, squares, keep, **options).each(jobs))
    return results, reasons, yielded


@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_results_of_each_job(kind: str, tmp_path: Path) -> None:
    jobs = [[i, i + 100] for i in range(20)]
    results, reasons, yielded = calls(functools.partial(make_needs, tmp_path), Execution(kind, 2), jobs)
    assert (results, reasons) == ({i: i * i for job in jobs for i in job}, {})
    assert sorted(yielded) == jobs
    assert len(list(tmp_path.glob("made-*"))) <= (1 if kind == "threads" else 2)  # once in each process


def test_a_long_factory_is_sent_to_workers_that_have_it_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fmtorch.jobs.runner.SENT_ALONG", 1000)
    size = 20_000
    results, _, _ = calls(functools.partial(make_needs, tmp_path, size), PROCESSES, [[i] for i in range(30)])
    assert results == {i: i * i for i in range(30)}
    assert len(list(tmp_path.glob("made-*"))) <= 2


def test_what_ends_its_workers_is_known_and_others_are_done(tmp_path: Path) -> None:
    jobs = [[1, 2], [3, -4, 5], [6, 7], [8], [-9], [10]]
    results, reasons, yielded = calls(functools.partial(make_needs, tmp_path), PROCESSES, jobs)
    assert results == {i: i * i for i in (1, 2, 3, 5, 6, 7, 8, 10)}
    assert reasons == {-4: DEATH, -9: DEATH}
    assert sorted(i for job in yielded for i in job) == sorted(i for job in jobs for i in job)
    assert len(list(tmp_path.glob("died-*"))) <= 2 * (3 + 2)  # bounded: with its neighbours, its batch, alone


def test_workers_that_cannot_begin_are_no_pairs_fault(tmp_path: Path) -> None:
    with pytest.raises(WorkersLost, match="the same command goes on"):
        calls(functools.partial(ends, tmp_path), PROCESSES, [[1], [2], [3]])


def test_without_a_reason_to_give_workers_that_die_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(WorkersLost, match="fewer workers"):
        calls(functools.partial(make_needs, tmp_path), PROCESSES, [[1], [-2]], give_up=None)


@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_what_a_call_raises_is_raised_here(kind: str, tmp_path: Path) -> None:
    execution = Execution(kind, 2)
    source: Any = Local(None) if execution.shared else Factory(functools.partial(make_needs, tmp_path))
    with WorkerPool(execution) as pool, pytest.raises(ValueError, match=r"job \d is wrong"):
        list(TaskRunner(pool, source, fails, lambda job, result: None).each([1, 2, 3]))


def test_interrupted_what_is_under_way_is_kept() -> None:
    event, kept = threading.Event(), list[int]()
    with WorkerPool(Execution("threads", 2)) as pool:
        run = TaskRunner(pool, Local(event), slow, lambda job, result: kept.append(job)).each(range(100))
        next(run)
        threading.Timer(0.2, event.set).start()
        run.close()
    assert kept[0] == 0
    assert 1 in kept
    assert len(kept) < 10


@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_results_in_the_order_of_the_jobs(kind: str) -> None:
    with WorkerPool(Execution(kind, 2)) as pool:
        assert list(in_order(pool, Local(None), late, range(20))) == [(i, -i) for i in range(20)]


def test_a_job_that_needs_the_result_of_another_waits_for_it() -> None:
    """Each number is ready when the one before it has ended; all at once are asked for."""
    done: list[int] = []

    def jobs() -> Iterator[int | None]:
        for number in range(6):
            while len(done) < number:
                yield None
            yield number

    with WorkerPool(Execution("threads", 3)) as pool:
        list(TaskRunner[int](pool, Local(None), late, lambda job, result: done.append(job)).each(jobs()))
    assert done == list(range(6))


SCRIPT = """
from fmtorch.jobs.execution import Execution
from fmtorch.jobs.runner import WorkerPool
with WorkerPool(Execution("processes", 2), needs_main=False) as pool:
    print(sorted(pool.executor.map(abs, range(-4, 0))))
"""


def test_a_script_without_a_guard_starts_processes_that_do_not_need_it(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120)
    assert (done.stdout, done.returncode) == ("[1, 2, 3, 4]\n", 0), done.stderr


def test_another_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    factory = Factory(functools.partial(make_needs, tmp_path))
    monkeypatch.setattr("fmtorch.jobs.runner.__version__", "9.9")
    with pytest.raises(ValueError, match=r"a worker has fmtorch 9\.9"):
        factory.call(squares, with_factory=True)([1])


def test_an_executor_of_ones_own(tmp_path: Path) -> None:
    execution = Execution(make=functools.partial(ThreadPoolExecutor, 3))
    results: list[int] = []
    source = Factory(functools.partial(make_needs, tmp_path))
    with WorkerPool(execution) as pool:
        keep = lambda job, result: results.extend(result)  # noqa: E731
        list(TaskRunner(pool, source, squares, keep).each([[i] for i in range(9)]))
        assert pool.size == 3
    assert sorted(results) == [i * i for i in range(9)]
    with pytest.raises(ValueError, match=r"executor: dict is no concurrent\.futures\.Executor"):
        WorkerPool(Execution(make=dict)).executor  # noqa: B018


def test_what_an_execution_may_be() -> None:
    with pytest.raises(ValueError, match="executor=mpi; it must be one of auto, threads, processes, dask"):
        Execution("mpi")
    with pytest.raises(ValueError, match="give executor=dask"):
        Execution("threads", address="tcp://localhost:8786")


@pytest.fixture
def threads() -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield 2
    torch.set_num_threads(before)


def test_pruners_and_estimators_of_a_pipeline_have_one_thread(threads: int, tmp_path: Path) -> None:
    seen = []

    def watching(stage: Callable[..., object]) -> Callable[..., object]:
        def watched(*arguments: object) -> object:
            seen.append(torch.get_num_threads())
            return stage(*arguments)

        return watched

    built = pipeline()
    built.pruners = {name: watching(pruner) for name, pruner in built.pruners.items()}  # type: ignore[misc]
    built.estimator = watching(built.estimator)  # type: ignore[assignment]
    image_pair = pair("a", draw(tmp_path / "a.png", 0), draw(tmp_path / "b.png", 0, shift=12))
    assert not built.run([image_pair])[0].reason
    assert seen == [1, 1, 1]
    assert fmtorch.match(read_image(image_pair.image0), read_image(image_pair.image1), pipeline=built).ok
    assert (seen[3:5], torch.get_num_threads()) == ([1, 1], threads)


def test_an_error_leaves_threads_as_they_were(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("no")

    monkeypatch.setattr("fmtorch.estimators.batch.normalize_pair", fails)
    built = presets.build("estimator", "msac", hypotheses=10)
    with pytest.raises(RuntimeError, match="no"):
        built(collate([scene(0, 60), scene(1, 60)]))
    assert torch.get_num_threads() == threads


def test_items_are_mapped_in_order_by_threads_that_share_no_more(threads: int) -> None:
    together = threading.Barrier(threads, timeout=60)

    def meet(item: int) -> tuple[int, int, int]:
        together.wait()  # for as many as there are threads
        return item, torch.get_num_threads(), fmtorch.jobs.available()

    with fmtorch.jobs.one_thread("cpu"):
        assert mapped(meet, range(6)) == [(i, 1, 1) for i in range(6)]
    torch.set_num_threads(1)
    here = threading.get_ident()
    assert mapped(lambda _: threading.get_ident(), range(3)) == [here] * 3


def test_the_first_error_of_an_item_is_raised(threads: int) -> None:
    begun = []

    def fails(item: int) -> None:
        begun.append(item)
        if item >= 2:
            raise RuntimeError(f"item {item}")

    with pytest.raises(RuntimeError, match="item 2"):
        mapped(fails, range(1000))
    assert len(begun) < 1000


def test_two_photographs_are_described_at_once(threads: int, tmp_path: Path) -> None:
    images = [read_image(pair(name, path, path).image0) for name, path in (
        ("a", draw(tmp_path / "a.png", 0)), ("b", draw(tmp_path / "b.png", 0, shift=12))
    )]  # fmt: skip
    built, both = pipeline(), threading.Barrier(2)
    extractor = built.extractor

    def together(image: object) -> object:
        both.wait(60)  # raises where the other does not come
        return extractor(image)  # type: ignore[arg-type]

    torch.set_num_threads(1)
    expected = fmtorch.match(*images, pipeline=built)
    torch.set_num_threads(threads)
    built.extractor = together  # type: ignore[assignment]
    matched = fmtorch.match(*images, pipeline=built)
    assert matched.ok
    assert torch.equal(matched.F, expected.F)
    for name in ("keypoints0", "keypoints1", "inliers"):
        assert torch.equal(getattr(matched, name), getattr(expected, name)), name
