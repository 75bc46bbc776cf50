"""The stress test: what each change does to matches and to F, rows that are kept, tables and figures."""

from __future__ import annotations

import argparse
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from scripts.benchmark.stress_cases import RIGHT_PX, Case, on_plane, parallax

from fmtorch.core.types import Correspondences
from fmtorch.data import ImagePair, ImageSource
from fmtorch.geometry import fundamental_from_calibration
from scripts.benchmark import stress, stress_cases, stress_rows, stress_table
from scripts.benchmark.stress_changes import CONDITIONS, COUNTS, INLIER_RATIOS, SWEEPS, ZOOM, match_count, noise, sizes

FOCAL, SIZE = 900.0, (600, 800)  # px, (h, w)


def nearest(pair: ImagePair, rng: np.random.Generator, right: int, flat: int, wrong: int) -> Correspondences:
    """Nearest neighbours of a pair: right ones, some on a plane, then twice as many wrong ones."""
    h, w = SIZE
    n = right + flat
    depth = np.concatenate([rng.uniform(6, 9, right), np.full(flat, 7.0)])
    x0 = rng.uniform([60, 60], [w - 60, h - 60], (n, 2))
    X = np.concatenate([x0, np.ones((n, 1))], 1) @ np.linalg.inv(pair.K0).T * depth[:, None]
    x1 = (X @ pair.R.T + pair.t) @ pair.K1.T
    x1 = x1[:, :2] / x1[:, 2:] + rng.normal(0, 0.2, (n, 2))
    x = [np.concatenate([x, rng.uniform([0, 0], [w, h], (2 * wrong, 2))]) for x in (x0, x1)]
    ratio = np.concatenate([rng.uniform(0.3, 0.7, n), np.full(wrong, 0.75), np.full(wrong, 0.95)])
    points = [torch.from_numpy(ends.astype(np.float32))[None] for ends in x]
    frames = [torch.cat([5 * torch.eye(2).expand(*p.shape[:2], 2, 2), p[..., None]], -1) for p in points]
    size = torch.tensor([SIZE])
    return Correspondences(
        *points, torch.ones(1, n + 2 * wrong, dtype=torch.bool), torch.from_numpy(ratio.astype(np.float32))[None],
        lafs0=frames[0], lafs1=frames[1], size0=size, size1=size, key=torch.tensor([3]),
    )  # fmt: skip


def case(index: int = 0, turn: float = 0.1, t: tuple[float, float, float] = (-1.0, 0.1, 0.05)) -> Case:
    rng = np.random.default_rng(index)
    K = np.array([[FOCAL, 0, (SIZE[1] - 1) / 2], [0, FOCAL, (SIZE[0] - 1) / 2], [0, 0, 1]])
    R = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    F = fundamental_from_calibration(*(torch.from_numpy(np.asarray(a, np.float64)) for a in (K, K, R, t))).numpy()
    image = ImageSource("none", Path("none.png"))
    pair = ImagePair(f"orbit/a/{index}", "orbit", "a", image, image, F, K, K, R, np.array(t))
    return stress_cases.case_of(pair, nearest(pair, rng, right=150, flat=60, wrong=600))


def test_right_and_wrong_are_told_by_the_true_matrix() -> None:
    base = case()
    assert base.right[:200].float().mean() > 0.95  # of the right ones those inside image 1 or not: all keep their lines
    assert base.right[210:].float().mean() < 0.05
    assert not (base.right & base.wrong).any()
    assert (base.spare.quality > 0.8).all()
    assert on_plane(base)[150:210].float().mean() > 0.95
    assert on_plane(base)[:150].float().mean() < 0.5
    assert parallax(base) > 50
    assert parallax(case(t=(-1e-4, 0.0, 0.0))) < 1


@pytest.mark.parametrize("name", CONDITIONS)
def test_right_matches_stay_right_under_every_condition(name: str) -> None:
    base = case()
    changed = CONDITIONS[name](base)
    assert changed is not None
    assert changed.c.lafs0 is not None
    assert stress_cases.distances(changed.pair.F, changed.c)[changed.right].max() < RIGHT_PX
    assert torch.equal(changed.c.lafs0[..., 2], changed.c.x0)
    size0, size1 = sizes(changed)
    for x, size in ((changed.c.x0, size0), (changed.c.x1, size1)):
        if name not in ("as they are", "one plane"):  # wrong matches were made anywhere
            assert (x[0].double().numpy() > -0.5).all()
            assert (x[0].double().numpy() < size[::-1] - 0.5).all()
    focal = {"f = 0.4": 0.4, "f = 2": 2.0, "f = 4": 4.0}
    if name in focal:
        assert max(size0) == pytest.approx(FOCAL / focal[name], abs=1)
    if name == "one plane":
        assert on_plane(changed)[changed.right].float().mean() >= 0.89
    if name.startswith("f 1"):
        assert (tuple(size0) == tuple(size1)) == name.endswith("one size")
        assert max(size1) == pytest.approx(SIZE[1] / ZOOM, abs=1)


def test_sweeps_vary_one_quantity() -> None:
    base = case()
    rights = []
    for ratio in INLIER_RATIOS:
        changed = SWEEPS["inlier ratio"][ratio](base)
        assert changed is not None
        rights.append(int(changed.right.sum()))
        assert changed.right.float().mean().item() == pytest.approx(ratio, rel=0.03)
        assert changed.wrong.sum() == len(changed.right) - rights[-1]
    assert len(set(rights)) == 1
    few, more = match_count(base, 20), match_count(base, 50)
    assert few is not None
    assert more is not None
    assert torch.equal(few.c.x0, more.c.x0[:, :20])
    assert match_count(base, COUNTS[-1]) is None
    still, moved = noise(base, 0.0), noise(base, 2.0)
    assert still is not None
    assert moved is not None
    assert (moved.c.x0 - still.c.x0).std().item() == pytest.approx(2.0, rel=0.1)


def test_tables_are_of_pairs_that_all_estimators_have_and_say_who_has_fewer_seeds() -> None:
    def row(method: str, pair: str, level: float, seeds: int) -> stress.Row:
        return {
            "sweep": "noise",
            "level": level,
            "pair": pair,
            "method": method,
            "nsgd": [0.1] * seeds,
            "ms": [1.0] * seeds,
        }

    rows = [row("b", "0", 1.0, 1), row("b", "1", 1.0, 2), row("a", "0", 1.0, 3), row("a", "1", 1.0, 3),
            row("a", "2", 1.0, 1), row("a", "0", 2.0, 3)]  # fmt: skip
    comparable = stress_rows.comparable(rows, ["c", "a"])
    assert [(r["method"], r["pair"], r["level"]) for r in comparable] == [
        ("a", "0", 1.0), ("a", "1", 1.0), ("b", "0", 1.0), ("b", "1", 1.0),
    ]  # fmt: skip
    assert [len(r["nsgd"]) for r in comparable] == [len(r["ms"]) for r in comparable] == [3, 3, 1, 1]
    assert stress_table.seeds(comparable) == "3 seeds (b: 1)"
    assert stress_table.seeds(comparable[:2]) == "3 seeds"


def test_an_interrupted_run_goes_on_and_its_tables_stand_in_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    specs = tmp_path / "specs.txt"
    specs.write_text("opencv:method=lmeds\n(opencv:method=lmeds@ratio_prior+sizeless)\n")
    page = tmp_path / "page.md"
    names = [f"stress {sweep}" for sweep in ("noise", "conditions")]
    page.write_text("".join(f"<!-- {name} -->\n<!-- end {name} -->\n" for name in names))
    arguments = argparse.Namespace(
        root=["none"], rendered=None, earlier=[], specs=specs, only=["noise", "conditions"], seeds=1,
        json=tmp_path / "rows.jsonl", update=page,
    )  # fmt: skip
    monkeypatch.setattr(stress, "SWEEPS", {"noise": {sigma: SWEEPS["noise"][sigma] for sigma in (0.0, 4.0)}})
    monkeypatch.setattr(stress, "CONDITIONS", {name: CONDITIONS[name] for name in ("as they are", "f = 0.4")})
    cases = [case(0), case(1)]
    monkeypatch.setattr(stress_cases, "load", lambda _: iter(cases[:1]))
    stress.run(arguments)
    first = stress.read(arguments.json)
    monkeypatch.setattr(stress_cases, "load", lambda _: iter(cases))
    stress.run(arguments)
    rows = stress.read(arguments.json)
    assert rows[: len(first)] == first
    assert len(rows) == 2 * len(first)
    text = page.read_text()
    assert "| opencv, method=lmeds |" in text
    assert "opencv, method=lmeds, no sizes" in text
    assert "as they are (2)" in text
    ElementTree.parse(tmp_path / "stress_noise.svg")
    assert "stress_noise.svg" in text
    assert set(stress_rows.levels(rows)) >= {"as they are", "f = 0.4"}
    with pytest.raises(SystemExit, match="must be one of"):
        stress.run(argparse.Namespace(**{**vars(arguments), "only": ["colour"]}))
