"""Stages of many small operations compute with one thread, whatever torch may use, and leave that as it was."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

import fmtorch
from fmtorch import kernels, presets
from fmtorch.data import read_image
from fmtorch.estimators import batching
from fmtorch.matching import nearest
from fmtorch.pruning import position_consistency as consistency
from tests.laws import scene
from tests.test_pipeline import draw, pair, pipeline


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
    one = pair("a", draw(tmp_path / "a.png", 0), draw(tmp_path / "b.png", 0, shift=12))
    assert not built.run([one])[0].reason
    assert seen == [1, 1, 1]
    assert fmtorch.match(read_image(one.image0), read_image(one.image1), pipeline=built).ok
    assert seen[3:5] == [1, 1]
    assert torch.get_num_threads() == threads


def test_matching_and_find_fundamental_have_one_thread(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(kernels.SWITCH, "off")  # the tensor forms, which torch's threads would slow down
    seen = []

    def watch(module: object, name: str) -> None:
        function = getattr(module, name)

        def watched(*arguments: object) -> object:
            seen.append(torch.get_num_threads())
            return function(*arguments)

        monkeypatch.setattr(module, name, watched)

    for module, name in (
        (nearest, "_usable"),
        (nearest, "_two_nearest"),
        (batching, "normalized_pairs"),
        (consistency, "tiled"),
    ):
        watch(module, name)
    nearest.nearest_neighbors(torch.rand(30, 8), torch.rand(20, 8))
    c = scene(0, 60)
    assert bool(fmtorch.find_fundamental(c.x0, c.x1).ok)
    assert seen == [1] * 5
    assert torch.get_num_threads() == threads


def test_an_error_leaves_threads_as_they_were(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("no")

    monkeypatch.setattr(batching, "normalized_pairs", fails)
    built = presets.build("estimator", "msac", hypotheses=10)
    with pytest.raises(RuntimeError, match="no"):
        built(scene(0, 60))
    assert torch.get_num_threads() == threads
