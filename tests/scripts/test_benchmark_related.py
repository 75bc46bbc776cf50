"""`python -m scripts.benchmark related`: unrelated pairs, tables, ROC curves, and the command."""

from pathlib import Path

import numpy as np

from fmtorch.data import ImagePair, ImageSource
from fmtorch.scenes import PICTURES, Plan, RenderedPairs
from scripts.benchmark import pairs, related
from scripts.benchmark.runner import Row
from tests.helpers import draw_set
from tests.scripts.samples import read, run
from tests.scripts.samples import row as plain_row


def pair(scene: str, i: int, j: int) -> ImagePair:
    images = [ImageSource(f"{scene}/{k}", Path(f"{scene}{k}.png")) for k in (i, j)]
    return ImagePair(f"family/{scene}/{i}-{j}", "family", scene, *images, np.eye(3))


def row(true: bool, nsgd: float, significance: float, inliers: int) -> Row:
    of = "f" if true else pairs.UNRELATED
    return plain_row("sift", f"{of}/s/{id(object())}", nsgd, significance=significance, corrs=inliers, corrs_before=50)


def test_unrelated_pairs_cross_scenes_and_are_chosen_once() -> None:
    ours = [pair(scene, i, i + 1) for scene in ("a", "b", "c") for i in range(4)]
    every = pairs.unrelated_pairs(ours, [], 100)
    assert len(every) == len({frozenset((p.image0.identity, p.image1.identity)) for p in every}) == 3 * 5 * 5
    assert all(p.image0.identity[0] != p.image1.identity[0] for p in every)
    some = pairs.unrelated_pairs(ours, [], 7)
    assert {p.identity for p in some} < {p.identity for p in every}
    assert len(some) == 3 * 7
    assert all(p.family.startswith(pairs.UNRELATED) and not p.F.any() for p in every)


def test_rendered_scenes_that_show_one_photograph_are_not_paired(tmp_path, monkeypatch):
    dataset = RenderedPairs("train", families=["indoor"], root=tmp_path, plan=Plan(1, 2, 1, scale=0.2), workers=1)
    (shown,) = pairs.photographs_shown(dataset).values()
    assert shown
    assert shown <= set(PICTURES["train"])
    shows = {"a": frozenset({"moon"}), "b": frozenset({"moon", "text"}), "c": frozenset({"text"}), "d": frozenset()}
    monkeypatch.setattr(pairs, "photographs_shown", lambda dataset: shows)
    monkeypatch.setattr(pairs, "RenderedPairs", list)
    unrelated = pairs.unrelated_pairs([*(pair(scene, 0, 1) for scene in "abcd"), pair("real", 0, 1)], [[]], 100)
    crossed = {p.scene.replace("family/", "") for p in unrelated}
    assert crossed == {"a | c", "a | d", "b | d", "c | d"}  # neither a | b, b | c, nor a drawn and a real one


def test_the_command_tells_pairs_apart(tmp_path, capsys, monkeypatch):
    rows, pipelines = tmp_path / "rows.jsonl", ["sift_gms", "sift_ratio*"]
    root = draw_set(tmp_path / "Set", "ab", images=2)
    run(capsys, monkeypatch, "related", "--root", root, "--unrelated", 3, "--pipelines",
        *pipelines, "--cache", "off", "--rows", rows, "--figure", tmp_path / "roc.svg")  # fmt: skip
    own = read(rows)
    assert len(own) == 2 * (2 + 3)
    assert all(related.called_related(r) == related.true(r) for r in own)
    assert "sift_gms" in run(capsys, monkeypatch, "related", "--rows", rows)
    assert "estimator=lmeds_eight_point" in (tmp_path / "roc.svg").read_text()
