"""The stress test: what each change does to matches and to F, and the command."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from fmtorch.core.types import Correspondences
from fmtorch.data import ImagePair
from fmtorch.geometry import fundamental_from_calibration
from scripts.benchmark import stress_changes
from scripts.benchmark.stress_changes import CONDITIONED, RIGHT_PX, SWEEPS, ZOOM, Case
from tests.helpers import draw_set
from tests.scripts.samples import pair, read, run

FOCAL, SIZE = 900.0, (600, 800)  # px, (h, w)
CONDITIONS = SWEEPS[CONDITIONED]


def nearest(of: ImagePair, rng: np.random.Generator, right: int, flat: int, wrong: int) -> Correspondences:
    """Nearest neighbours of a pair: right ones, some on a plane, then twice as many wrong ones."""
    h, w = SIZE
    n = right + flat
    depth = np.concatenate([rng.uniform(6, 9, right), np.full(flat, 7.0)])
    x0 = rng.uniform([60, 60], [w - 60, h - 60], (n, 2))
    X = np.concatenate([x0, np.ones((n, 1))], 1) @ np.linalg.inv(of.K0).T * depth[:, None]
    x1 = (X @ of.R.T + of.t) @ of.K1.T
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


def case(turn: float = 0.1, t: tuple[float, float, float] = (-1.0, 0.1, 0.05)) -> Case:
    K = np.array([[FOCAL, 0, (SIZE[1] - 1) / 2], [0, FOCAL, (SIZE[0] - 1) / 2], [0, 0, 1]])
    R = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    F = fundamental_from_calibration(*(torch.from_numpy(np.asarray(a, np.float64)) for a in (K, K, R, t))).numpy()
    of = pair("orbit/a/0", F, K0=K, K1=K, R=R, t=np.array(t))
    return stress_changes.case_of(of, nearest(of, np.random.default_rng(0), right=150, flat=60, wrong=600))


def test_right_and_wrong_are_told_by_the_true_matrix() -> None:
    base = case()
    assert base.right[:200].float().mean() > 0.95  # of the right ones those inside image 1 or not: all keep their lines
    assert base.right[210:].float().mean() < 0.05
    assert not (base.right & base.wrong).any()
    assert (base.spare.quality > 0.8).all()
    flat = stress_changes.on_plane(base)
    assert flat[150:210].float().mean() > 0.95
    assert flat[:150].float().mean() < 0.5
    assert stress_changes.parallax(base) > 50
    assert stress_changes.parallax(case(t=(-1e-4, 0.0, 0.0))) < 1


@pytest.mark.parametrize("name", CONDITIONS)
def test_right_matches_stay_right_under_every_condition(name: str) -> None:
    changed = CONDITIONS[name](case())
    assert stress_changes.distances(changed.pair.F, changed.c)[changed.right].max() < RIGHT_PX
    assert torch.equal(changed.c.lafs0[..., 2], changed.c.x0)
    size0, size1 = changed.sizes()
    for x, size in ((changed.c.x0, size0), (changed.c.x1, size1)):
        if name not in ("as they are", "one plane"):  # wrong matches were made anywhere
            assert (x[0].double().numpy() > -0.5).all()
            assert (x[0].double().numpy() < size[::-1] - 0.5).all()
    if name.startswith("f = "):
        assert max(size0) == pytest.approx(FOCAL / float(name.removeprefix("f = ")), abs=1)
    if name == "one plane":
        assert stress_changes.on_plane(changed)[changed.right].float().mean() >= 0.89
    if name.startswith("f 1"):
        assert (tuple(size0) == tuple(size1)) == name.endswith("one size")
        assert max(size1) == pytest.approx(SIZE[1] / ZOOM, abs=1)


def test_the_command_goes_on_and_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    specs, rows = tmp_path / "specs.txt", tmp_path / "rows.jsonl"
    specs.write_text("opencv:method=lmeds\n(opencv:method=lmeds@ratio_prior+sizeless)\n")
    arguments = ["--root", draw_set(tmp_path / "Set", images=2), "--specs", specs, "--rows", rows, "--only"]
    run(capsys, monkeypatch, "stress", *arguments, "noise")
    first = read(rows)
    assert len(first) == len(SWEEPS["noise"])
    printed = run(capsys, monkeypatch, "stress", *arguments, "noise", CONDITIONED, "--figures", tmp_path)
    assert read(rows)[: len(first)] == first
    assert {r["level"] for r in read(rows) if "sizeless" in r["method"]} >= {"as they are", "crops"}
    assert "opencv, method=lmeds, no sizes" in printed
    ElementTree.parse(tmp_path / "stress_noise.svg")
