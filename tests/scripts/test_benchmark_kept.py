"""Rows that benchmarks keep: an interrupted run goes on, and rows of other code or options do not count."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scripts.benchmark.kept import Kept, read

from fmtorch.data import ImagePair, ImageSource
from scripts.benchmark import estimators, kept, learned, specs
from tests.laws import scene


def unread_pairs(count: int) -> list[ImagePair]:
    image = ImageSource("none", Path("none.png"))  # not looked at
    return [ImagePair(f"orbit/{i}", "orbit", str(i), image, image, np.eye(3)) for i in range(count)]


def interrupted_at(call: int, function: Callable) -> Callable:
    """The function, which is interrupted from its call of this number on."""
    calls = iter(range(1000))

    def wrapped(*arguments, **options):
        if next(calls) >= call:
            raise KeyboardInterrupt
        return function(*arguments, **options)

    return wrapped


def test_a_line_that_was_cut_off_goes_and_other_files_stay_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    Kept(path).add([{"pair": "a", "seed": 0}, {"pair": "b", "seed": 0}])
    path.write_bytes(path.read_bytes() + b'{"pair": "\xc3')
    again = Kept(path)
    again.add([{"pair": "b", "seed": 0, "new": True}])
    assert read(path) == again.rows == [*({"pair": p, "seed": 0} for p in "ab"), {"pair": "b", "seed": 0, "new": True}]
    assert again.by("pair", "seed")["b", 0] == {"pair": "b", "seed": 0, "new": True}
    assert list(again.by("new")) == [(True,)]

    figures = tmp_path / "figures.json"
    figures.write_text('{\n"machine": 1,')
    with pytest.raises(SystemExit, match=r"figures\.json, line 1: no row"):
        Kept(figures)
    assert figures.read_text() == '{\n"machine": 1,'
    with pytest.raises(SystemExit, match=r"none/rows\.jsonl: there is no folder"):
        Kept(tmp_path / "none" / "rows.jsonl")
    with pytest.raises(SystemExit, match="no such file"):
        read(tmp_path / "none")


def test_estimators_go_on_where_they_were_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    items = [(pair, scene(i, 60, outliers=0.3)) for i, pair in enumerate(unread_pairs(3))]
    specs, path = ["opencv:method=lmeds", "opencv@ratio_prior"], tmp_path / "rows.jsonl"
    uninterrupted = estimators.measure(specs, items, 2)
    with monkeypatch.context() as patch:
        patch.setattr(estimators, "_row", interrupted_at(5, estimators._row))
        with pytest.raises(KeyboardInterrupt):
            estimators.measure(specs, items, 2, kept=Kept(path))
    assert len(read(path)) == 4  # of two pairs
    first = estimators.measure(specs, items, 2, kept=Kept(path))
    assert all(np.array_equal(first[spec]["nsgd"], uninterrupted[spec]["nsgd"]) for spec in specs)
    assert len(read(path)) == 12
    monkeypatch.setattr(estimators, "_row", interrupted_at(0, estimators._row))
    again = estimators.measure(specs, items, 2, kept=Kept(path))  # measures nothing
    assert all(np.array_equal(again[spec][name], first[spec][name]) for spec in specs for name in ("nsgd", "ms"))
    for other in ({"specs": ["opencv:method=lmeds,confidence=0.9"]}, {"seeds": 3}, {"matches": "others"}):
        with pytest.raises(KeyboardInterrupt):
            estimators.measure(**({"specs": specs, "items": items, "seeds": 2, "kept": Kept(path)} | other))


def test_learned_goes_on_where_it_was_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def rows_of(front, pair, built, estimators, features):
        calls.append((pair.identity, [name for methods in built.values() for name in methods]))
        for use, methods in built.items():
            for name in methods:
                for estimator in learned.USES[use][1]:
                    about = {"use": use, "method": name, "estimator": estimator, "features": features}
                    yield {**about, "pair": pair.identity, "nsgd": 0.0}

    monkeypatch.setattr(learned, "rows_of", interrupted_at(1, rows_of))
    monkeypatch.setattr(learned, "sets_of", lambda _: [unread_pairs(3)])
    arguments = argparse.Namespace(
        features="sift", methods=["ratio", "LPM"], ngransac=None, network=[], cache="off", limit=None,
        json=tmp_path / "rows.jsonl",
    )  # fmt: skip
    with pytest.raises(KeyboardInterrupt):
        learned.measure(arguments)
    both = ["ratio", "LPM", "ratio", "LPM"]  # before the paper's estimators, and as a prior
    assert calls == [("orbit/0", both)]
    monkeypatch.setattr(learned, "rows_of", rows_of)
    rows = learned.measure(arguments)
    assert calls[1:] == [("orbit/1", both), ("orbit/2", both)]
    assert len(rows) == len(read(arguments.json)) == 18
    arguments.methods = ["ratio", "LPM", "GMS"]
    learned.measure(arguments)
    assert calls[3:] == [(f"orbit/{i}", ["GMS", "GMS"]) for i in range(3)]


def test_what_a_row_was_made_with_is_options_code_and_learned_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept, "libraries", lambda others: dict.fromkeys(others, "1"))  # PoseLib may be absent
    names = ["usac", "usac:threshold=0.7", "usac@ratio_prior", "poselib", "truth", "truth@lc:soft=true"]
    before = [specs.identity(name) for name in names]
    assert len(set(before)) == len(names)
    assert [specs.identity(name) for name in names] == before
    with monkeypatch.context() as patch:
        patch.setattr(kept, "code_digest", lambda module: module)
        assert not set(before[:4]) & {specs.identity(name) for name in names[:4]}
    monkeypatch.setattr(kept, "libraries", lambda others: dict.fromkeys(others, "2"))
    assert specs.identity("poselib") != before[3]
