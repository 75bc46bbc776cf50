"""The benchmark of cameras: what each level tells, peers, judgement, tables between their markers."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fmtorch.core.types import Correspondences
from fmtorch.data import ImagePair, ImageSource
from fmtorch.evaluation.statistics import bootstrap_mean
from scripts.benchmark import cameras, cameras_knowledge, cameras_methods, cameras_peers, cameras_table, matched
from scripts.benchmark.cameras_knowledge import Answer, applies, bougnoux, fundamental, knowledge
from scripts.benchmark.specs import read_specs

SPECS = Path(__file__).resolve().parents[2] / "scripts" / "benchmark" / "cameras.txt"
SIZES = np.array([[760, 1000], [760, 1000]])
K = np.array([[950.0, 0, 499.5], [0, 950, 379.5], [0, 0, 1]])
R = cv2.Rodrigues(np.array([0.05, 0.3, 0.02]))[0]
T = np.array([-1.0, 0.1, 0.3])


def item(seed: int = 0, K0: np.ndarray = K, family: str = "orbit", scene: str = "s") -> matched.Item:
    """A pair of cameras with 200 right matches, of 0.1 px of noise, and 50 wrong ones of larger ratio."""
    rng = np.random.default_rng(seed)
    X = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (250, 3))
    x0, x1 = (Y[:, :2] / Y[:, 2:] + rng.normal(0, 0.1, (250, 2)) for Y in (X @ K0.T, (X @ R.T + T) @ K.T))
    x1[200:] = rng.uniform(0, 760, (50, 2))
    image = ImageSource("none", Path("none.png"))  # not looked at
    name = f"{family}/{scene}/{seed}"
    pair = ImagePair(name, family, scene, image, image, fundamental(K0, K, R, T), K0, K, R, T)
    ratio = torch.linspace(0.3, 0.8, 250)[None]
    sizes, frames = torch.from_numpy(SIZES), [torch.diag(torch.tensor([4.0, 4])).expand(1, 250, 2, 2)] * 2
    points = [torch.from_numpy(x)[None].float() for x in (x0, x1)]
    lafs0, lafs1 = (torch.cat([A, x[..., None]], -1) for A, x in zip(frames, points, strict=True))
    matches = Correspondences(
        *points, torch.ones(1, 250, dtype=torch.bool), quality=ratio, lafs0=lafs0, lafs1=lafs1, size0=sizes[:1],
        size1=sizes[1:], key=torch.tensor([pair.key]),
    )  # fmt: skip
    return pair, matches


def zoomed(factor: float) -> np.ndarray:
    return K @ np.diag([factor, factor, 1])


def test_levels_tell_what_they_say() -> None:
    pair, _ = item()
    known = knowledge("known", pair, SIZES, 0)
    assert known.deviation == 0
    assert np.array_equal(known.K0, K)
    wrong = knowledge("wrong", pair, SIZES, 0)
    assert np.allclose(wrong.K1, zoomed(1.5))
    one_sided = knowledge("one_sided", pair, SIZES, 0)
    assert one_sided.K0 is not None
    assert one_sided.K1 is None
    shared, unknown = (knowledge(level, pair, SIZES, 0) for level in ("shared", "unknown"))
    assert (shared.K0, shared.K1, shared.one_camera, unknown.one_camera) == (None, None, True, False)
    assert np.array_equal(unknown.centres, [[499.5, 379.5]] * 2)
    with pytest.raises(ValueError, match="level is 'some'; it must be one of: known"):
        knowledge("some", pair, SIZES, 0)


def test_roughly_known_focal_lengths_are_off_by_a_tenth_at_most_each_for_itself_and_by_the_seed() -> None:
    factors = []
    for seed in range(200):
        given = knowledge("rough", item(seed % 7)[0], SIZES, seed)
        again = knowledge("rough", item(seed % 7)[0], SIZES, seed)
        assert np.array_equal(given.K0, again.K0)
        factors.append([np.log(k[0, 0] / 950) for k in (given.K0, given.K1)])
    logs = np.array(factors)
    assert np.abs(logs).max() <= np.log(1.1)
    assert abs(logs.std() - np.log(1.1) / np.sqrt(3)) < 4 * 0.45 * logs.std() / np.sqrt(400)  # uniform: kurtosis 1.8
    assert abs(np.corrcoef(logs.T)[0, 1]) < 4 / np.sqrt(200)


def test_one_focal_length_is_taken_for_shared_where_it_is() -> None:
    assert applies("shared", item()[0])
    assert not applies("shared", item(K0=zoomed(1.01))[0])
    assert applies("unknown", item(K0=zoomed(1.01))[0])


def test_bougnoux_gives_the_focal_lengths_of_a_true_matrix() -> None:
    pair, _ = item(K0=zoomed(1.3))
    given = knowledge("unknown", pair, SIZES, 0)
    assert bougnoux(pair.F, given) == pytest.approx([1.3 * 950, 950], rel=1e-8)
    forward = fundamental(K, K, np.eye(3), np.array([0, 0, 1.0]))  # axes that are one line determine none
    assert bougnoux(forward, given) == pytest.approx([1200, 1200])


CASES = [(name, level) for name, levels in cameras_peers.TAKES.items() for level in levels]


@pytest.mark.parametrize(("name", "level"), CASES)
def test_every_peer_solves_an_easy_pair_at_each_level_that_it_takes(name: str, level: str) -> None:
    pytest.importorskip({"opencv": "cv2"}.get(name, cameras_peers.PACKAGES[name].partition("-")[0]))
    pair, matches = item()
    given = knowledge(level, pair, SIZES, 0)
    row = cameras.judge(cameras_methods.build(f"{name}:{level}:threshold=1"), (pair, matches), given, 0)
    assert row["posed"]
    assert not row["flipped"]
    focals = row.get("focals", ())
    assert len(focals) == {"known": 0, "one_sided": 1}.get(level, 2)
    if level in ("rough", "wrong"):  # which it takes for exact
        assert focals == pytest.approx(abs(given.focals / 950 - 1))
    else:
        bound = 1 if level == "known" else 3  # degrees
        assert row["rotation"] < bound
        assert row["translation"] < bound
        assert row["nsgd"] < 0.01
        assert all(error < 0.1 for error in focals)  # the usual focal length is off by a quarter


@pytest.mark.parametrize("method", [f"fmtorch:{level}" for level in cameras_knowledge.LEVELS] + ["fmtorch_f:known"])
def test_our_own_methods_solve_an_easy_pair(method: str) -> None:
    pair, matches = item()
    given = knowledge(cameras_methods.read(method).level, pair, SIZES, 0)
    row = cameras.judge(cameras_methods.build(method), (pair, matches), given, 0)
    assert row["posed"]
    assert row["rotation"] < 1
    assert row["translation"] < 1
    assert row["nsgd"] < 0.01
    assert all(error < 0.05 for error in row.get("focals", ()))
    assert len(row.get("focals", ())) == {"known": 0, "one_sided": 1}.get(cameras_methods.read(method).level, 2)


def test_a_peer_that_refuses_or_has_too_few_matches_gives_nothing() -> None:
    given = knowledge("known", item()[0], SIZES, 0)
    few = np.zeros((5, 2))
    assert cameras_peers.peer("opencv", "known")((few, few), given, 0).F is None
    same = np.full((40, 2), 3.0)
    result = cameras_peers.peer("opencv", "known")((same, same), given, 0)
    assert result.R is None or np.isfinite(result.R).all()


@pytest.mark.parametrize(("text", "message"), [
    ("poselib", "write NAME:LEVEL"), ("poselib:some", "with a level of known, rough"),
    ("opencv:shared", "opencv has no estimator for 'shared'"), ("peer:known", "no method 'peer'; there are poselib"),
])  # fmt: skip
def test_a_method_that_there_is_not_is_refused(text: str, message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        cameras_methods.build(text)


def test_the_methods_of_the_page_are_methods() -> None:
    texts = read_specs(SPECS)
    assert len(set(texts)) == len(texts)
    for text in texts:
        cameras_methods.build(text)
    assert {cameras_methods.read(text).level for text in texts} == set(cameras_knowledge.LEVELS)


def judged(answer: Answer, level: str = "known") -> dict[str, object]:
    pair, matches = item()
    return cameras.judge(lambda c, given, seed: answer, (pair, matches), knowledge(level, pair, SIZES, 0), 0)


def test_judgement_of_a_true_a_flipped_and_no_pose() -> None:
    true = judged(Answer(fundamental(K, K, R, T), R, 3 * T, np.array([950.0, 1000])), "unknown")
    assert [true[key] for key in ("rotation", "translation", "nsgd")] == pytest.approx([0, 0, 0], abs=1e-5)
    assert true["focals"] == pytest.approx([0, 50 / 950])
    flipped = judged(Answer(fundamental(K, K, R, -T), R, -T))
    assert flipped["flipped"]
    assert flipped["translation"] == pytest.approx(0, abs=1e-5)
    nothing = judged(Answer(None), "shared")
    assert (nothing["rotation"], nothing["translation"], nothing["nsgd"], nothing["posed"]) == (180, 90, 1, False)
    assert nothing["focals"] == [1, 1]
    assert judged(Answer(None, R * np.nan, T))["rotation"] == 180


def test_a_run_goes_on_where_it_stopped_and_its_tables_stand_in_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    items = [item(i, family=family, scene=f"{i}") for i, family in enumerate(["orbit", "orbit", "driving", "driving"])]
    items[1] = item(1, K0=zoomed(1.2), scene="1")
    monkeypatch.setattr(matched, "load", lambda _: items)
    monkeypatch.setattr(matched, "identity", lambda _: "matches")
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- cameras -->\nearlier\n<!-- end cameras -->\nafter\n")
    methods = ["opencv:known:threshold=1", "opencv:known:method=RANSAC,threshold=0.01", "colmap:shared:threshold=1"]
    arguments = argparse.Namespace(
        methods=methods[:1], specs=None, seeds=1, rows=tmp_path / "rows.jsonl", json=tmp_path / "figures.json",
        update=page, marker="cameras",
    )  # fmt: skip
    cameras.run(arguments)
    first = (tmp_path / "rows.jsonl").read_text()
    assert len(first.splitlines()) == 4
    cameras.run(argparse.Namespace(**{**vars(arguments), "methods": methods, "seeds": 2}))
    assert (tmp_path / "rows.jsonl").read_text().startswith(first)
    assert len((tmp_path / "rows.jsonl").read_text().splitlines()) == 2 * (4 + 4 + 3)  # one pair has two focal lengths
    text = page.read_text()
    assert text.startswith("before\n<!-- cameras -->\nPose: area")
    assert text.endswith("<!-- end cameras -->\nafter\n")
    assert "earlier" not in text
    for part in (
        "wide baselines: 2 pairs of 2",
        "### shared: one unknown focal length",
        "| `opencv:threshold=1` ",
    ):
        assert part in text
    monkeypatch.setattr(cameras, "judge", lambda *_: pytest.fail("all rows are there"))
    cameras.run(argparse.Namespace(**{**vars(arguments), "methods": methods, "seeds": 2}))
    page.write_text("no marks")
    with pytest.raises(SystemExit, match="has no lines <!-- cameras -->"):
        cameras.run(arguments)
    monkeypatch.setattr(matched, "load", lambda _: [])
    with pytest.raises(SystemExit, match="no pair has cameras"):
        cameras.run(arguments)
    with pytest.raises(SystemExit, match="name at least one method"):
        cameras.run(argparse.Namespace(**{**vars(arguments), "methods": []}))


def test_leads_are_differences_of_areas_under_step_curves() -> None:
    rng = np.random.default_rng(0)
    pairs = [item(i, scene=f"{i % 12}")[0] for i in range(48)]
    errors = rng.uniform(0, 8, (2, 2, 48))  # methods, seeds, pairs
    methods = ["opencv:known", "fmtorch:known"]
    rows = {
        method: [
            {"pair": pair.identity, "seed": seed, "ms": 2.0 if m else 4.0, "nsgd": 0.02, "rotation": errors[m, seed, i],
             "translation": errors[m, seed, i] / 2, "flipped": i < 12, "posed": True, "focals": [0.07, 0.2]}
            for seed in range(2) for i, pair in enumerate(pairs)
        ]
        for m, method in enumerate(methods)
    }  # fmt: skip
    figures = cameras_table.figures(rows, pairs)["opencv:known"]["orbit"]
    share = np.clip(1 - errors / 5, 0, 1).mean(1)
    expected = bootstrap_mean(100 * share[1] - 100 * share[0], [f"orbit/{pair.scene}" for pair in pairs])
    assert figures["pose_5"] == pytest.approx(100 * share[0].mean())
    assert figures["ahead_pose_5"] == pytest.approx([expected.value, expected.low, expected.high], abs=1e-9)
    assert (figures["flipped"], figures["focal_5"], figures["focal_10"]) == (25, 0, 50)
    assert (figures["ms_median"], figures["ms_ratio"]) == (4, 2)
    assert cameras_table.figures(rows, pairs)["fmtorch:known"]["orbit"]["ahead_pose_5"] is None
