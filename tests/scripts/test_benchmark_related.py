"""`python -m scripts.benchmark related`: unrelated pairs, rows that are kept, tables."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from fmtorch.core.types import RELATED
from fmtorch.data import ImagePair, ImageSource
from scripts.benchmark import related, related_figure, related_pairs, related_table
from tests.pipeline.test_pipeline import draw


def pair(scene: str, i: int, j: int, family: str = "family") -> ImagePair:
    images = [ImageSource(f"{scene}/{k}", Path(f"{scene}{k}.png")) for k in (i, j)]
    return ImagePair(f"{family}/{scene}/{i}-{j}", family, scene, *images, np.eye(3))


def test_unrelated_pairs_cross_scenes_and_are_chosen_once() -> None:
    related_ones = [pair(scene, i, i + 1) for scene in ("a", "b", "c") for i in range(4)]
    unrelated = related_pairs.unrelated_pairs(related_ones, [], 100)
    assert len(unrelated) == len({p.identity for p in unrelated}) == 3 * 5 * 5
    places = [{p.image0.identity[0], p.image1.identity[0]} for p in unrelated]
    assert all(len(place) == 2 for place in places)
    assert len({frozenset((p.image0.identity, p.image1.identity)) for p in unrelated}) == 75
    subset = related_pairs.unrelated_pairs(related_ones, [], 7)
    assert {p.identity for p in subset} < {p.identity for p in unrelated}
    assert len(subset) == 3 * 7
    assert all(p.family.startswith(related_pairs.UNRELATED) and not p.F.any() for p in unrelated)


def test_rendered_scenes_that_show_one_photograph_are_not_paired(monkeypatch: pytest.MonkeyPatch) -> None:
    shows = {"a": frozenset({"moon"}), "b": frozenset({"moon", "text"}), "c": frozenset({"text"}), "d": frozenset()}
    monkeypatch.setattr(related_pairs, "photographs_shown", lambda dataset: shows)
    monkeypatch.setattr(related_pairs, "RenderedPairs", list)
    pairs = [pair(scene, 0, 1) for scene in "abcd"] + [pair("real", 0, 1)]
    unrelated = related_pairs.unrelated_pairs(pairs, [[]], 100)
    crossed = {p.scene.replace("family/", "") for p in unrelated}
    assert crossed == {"a | c", "a | d", "b | d", "c | d"}  # neither a | b, b | c, nor a drawn and a real one


def test_the_photographs_of_a_drawn_scene_are_known(tmp_path: Path) -> None:
    from fmtorch.scenes import RenderedPairs
    from fmtorch.scenes.generate import Plan
    from fmtorch.scenes.textures import PICTURES

    plan = Plan(1, 2, 1, scale=0.2)
    dataset = RenderedPairs("train", families=["indoor"], root=tmp_path, plan=plan, workers=1)
    (shown,) = related_pairs.photographs_shown(dataset).values()
    assert shown
    assert shown <= set(PICTURES["train"])


def row(true: bool, nsgd: float, significance: float, inliers: int, matches: int = 50) -> related_table.Row:
    return {
        "pair": "p", "family": "f" if true else related_pairs.UNRELATED, "scene": "s", "true": true, "ok": True,
        "nsgd": nsgd, "significance": significance, "inliers": inliers, "matches": matches,
    }  # fmt: skip


def test_area_counts_ties_half() -> None:
    right, unrelated = [row(True, 0, s, 9) for s in (1.0, 2.0)], [row(False, 1, s, 9) for s in (0.0, 1.0, -math.inf)]
    assert related_table.area(right, unrelated, lambda r: r["significance"]) == pytest.approx(5.5 / 6)
    assert related_table.area(right, unrelated, lambda r: r["inliers"]) == 0.5


def test_tables_tell_what_each_rule_does() -> None:
    rows = [row(False, 1, -3.0, 12), row(False, 1, RELATED, 16), row(True, 0.01, 9.0, 14), row(True, 0.9, 0.0, 14)]
    text = related_table.text({"sift": rows})
    assert "| `sift` | 2 | 1 |" in text
    assert "50.00 / 0.00 | 50.00 / 0.00 | 0.00 / 0.00 |" in text  # at three of the levels
    assert "1 of 1; 0 of 1" in text  # of the family
    assert "0 of 0; 1 of 2" in text  # of unrelated pairs


def test_roc_goes_from_all_to_none_and_is_drawn_the_same_every_time(tmp_path: Path) -> None:
    rows = [row(False, 1, s, 9) for s in (-math.inf, 0.0, 1.0)] + [row(True, 0, s, 9) for s in (1.0, 2.0)]
    accepted, rejected = related_figure.roc([*rows, row(True, 0.9, 3.0, 9)], related_table.significance)
    assert accepted.tolist() == pytest.approx([1, 2 / 3, 1 / 3, 0, 0])  # at -inf, 0, 1, 2 and above all
    assert rejected.tolist() == [0, 0, 0, 0.5, 1]
    for name in ("a.svg", "b.svg"):
        related_figure.draw({"sift_a": rows, "sift_b": rows[:1] + rows[4:], "none": rows[:3]}, tmp_path / name)
    drawn = (tmp_path / "a.svg").read_text()
    assert drawn == (tmp_path / "b.svg").read_text()
    texts = [element.text.strip() for element in ElementTree.fromstring(drawn).iter("{http://www.w3.org/2000/svg}text")]
    assert {"sift_a", "sift_b (along the axes)", "unrelated pairs accepted, %", "right pairs rejected, %"} <= set(texts)


LMEDS = "sift_ratio estimator=lmeds_eight_point"


def test_an_interrupted_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed, scene in enumerate(("a", "b")):
        images = tmp_path / "Set" / scene / "Images"
        images.mkdir(parents=True)
        for i in range(2):
            draw(images / f"{i:08d}.png", seed=seed, shift=9 * i)
    (tmp_path / "Set" / "pairs_with_gt.txt").write_text("0 1 0 0 0 0 0 -1 0 1 0\n" * 2)
    (tmp_path / "Set" / "pairs_which_dataset.txt").write_text("a/\nb/\n")
    page = tmp_path / "page.md"
    page.write_text("<!-- related -->\n<!-- end related -->\n")
    arguments = argparse.Namespace(
        root=[str(tmp_path / "Set")], rendered=None, split="test", limit=None, pipelines=[LMEDS, "sift_gms"],
        unrelated=3, folder=tmp_path / "kept", update=page, marker="related",
        figure=tmp_path / "roc.svg",
    )  # fmt: skip
    monkeypatch.setattr(related, "BATCH", 2)
    related.run(arguments)
    rows = related.read(arguments.folder, arguments.pipelines)
    assert {name: len(method_rows) for name, method_rows in rows.items()} == {LMEDS: 5, "sift_gms": 5}
    assert [r["true"] for r in sorted(rows[LMEDS], key=lambda r: r["pair"])].count(True) == 2
    assert all(r["significance"] > RELATED for r in rows[LMEDS] if r["true"])
    assert not any(r["significance"] >= RELATED for r in rows[LMEDS] if not r["true"])
    text = page.read_text()
    assert "sift_gms" in text
    assert LMEDS in arguments.figure.read_text()

    next((tmp_path / "kept" / "rows" / "sift_gms").iterdir()).unlink()
    monkeypatch.setattr(related.Pipeline, "match", lambda *_: pytest.fail("matches are kept"))
    related.run(arguments)
    assert related.read(arguments.folder, arguments.pipelines) == rows
    assert page.read_text() == text
    with pytest.raises(SystemExit, match="has no lines"):
        related.run(argparse.Namespace(**{**vars(arguments), "marker": "other"}))
