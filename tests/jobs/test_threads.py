"""Stages of many small operations compute with one thread, whatever torch may use, and leave that as it was."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

import fmtorch
from fmtorch import presets
from fmtorch.core import collate
from fmtorch.data import read_image
from fmtorch.jobs import available, mapped, one_thread
from tests.helpers import draw, pair
from tests.helpers import small_pipeline as pipeline
from tests.laws import degenerate, scene


@pytest.fixture
def threads() -> Iterator[int]:
    """More threads than one, as torch has by default."""
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
        return item, torch.get_num_threads(), available()

    with one_thread("cpu"):
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


@pytest.mark.parametrize("graph", [True, False])
def test_a_batch_in_threads_has_the_bits_of_one_thread(threads: int, graph: bool) -> None:
    """Of pairs of many sizes with degenerate ones among them; gradients are summed in another order."""
    c = collate([*(scene(i, 20 + 61 * i % 400) for i in range(9)), *degenerate().values()])
    estimator, results = presets.build("estimator", "msac", hypotheses=100, round=50), []
    for count in (threads, 1):
        torch.set_num_threads(count)
        x0 = c.x0.double().requires_grad_()
        with torch.set_grad_enabled(graph):
            e = estimator(c.replace(x0=x0, x1=c.x1.double()), seed=5)
        assert e.F.requires_grad == graph
        if graph:
            e.F.square()[:, 0, 1].sum().backward()
        results.append((e, x0.grad))
    (threaded, gradient), (single, expected) = results
    for name in ("F", "inliers", "ok", "samples", "significance"):
        assert torch.equal(getattr(threaded, name), getattr(single, name)), name
    assert threaded.reason == single.reason
    if graph:
        torch.testing.assert_close(gradient, expected)


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
