"""Evaluation of poses, homographies, cameras and pair types."""

import dataclasses
import functools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

import fmtorch
from fmtorch import evaluation, presets
from fmtorch.core import PAIR_TYPES, WARNINGS, Correspondences, Estimate
from fmtorch.data import GivenMatches, ImagePair, ImageSource, load
from fmtorch.evaluation.statistics import homography_figures
from fmtorch.metrics import corner_error, pose_auc
from fmtorch.pipeline import Outcome, Pipeline, examined
from fmtorch.runs import PairRow, RunFolder, to_table
from fmtorch.training import MatchedPairs
from tests.conftest import shared_path
from tests.data import native
from tests.data.test_images import with_exif
from tests.geometry.scenes import K, batch, draw, scene
from tests.helpers import call_command, unused
from tests.reference import metrics as reference
from tests.reference import solvers

N = 30


def outcome(seed: int, noise: float = 1.0) -> Outcome:
    """A pair of known cameras whose F is of the eight-point algorithm, with a match or two that are no inliers."""
    s = scene(N, seed, noise)
    F = torch.from_numpy(solvers.eight_point(s.x0.numpy(), s.x1.numpy()))
    pair = ImagePair(
        f"p{seed}", "family", "scene", ImageSource("a", Path("a")), ImageSource("b", Path("b")), s.F.numpy(),
        s.K0.numpy(), s.K1.numpy(), s.R.numpy(), s.t.numpy(),
    )  # fmt: skip
    size = torch.tensor([[800, 1000]])
    c = Correspondences(s.x0[None], s.x1[None], torch.ones(1, N, dtype=torch.bool), size0=size, size1=size)
    inliers = torch.arange(N)[None] < N - seed
    estimate = Estimate((F / F.norm())[None], inliers, torch.tensor([True]), ("",), torch.tensor([1]))
    return Outcome(pair, (N, N), c, estimate)


def without(o: Outcome, **changes: object) -> Outcome:
    return dataclasses.replace(o, pair=dataclasses.replace(o.pair, **changes))


def test_rows_have_the_pose_errors_of_the_reference() -> None:
    outcomes = [outcome(seed) for seed in range(4)]
    for o, row in zip(outcomes, evaluation.evaluate(outcomes), strict=True):
        kept = o.estimate.inliers[0].numpy()
        x0, x1 = (x[0].numpy()[kept] for x in (o.correspondences.x0, o.correspondences.x1))
        R, t, _ = solvers.pose(o.estimate.F[0].numpy(), o.pair.K0, o.pair.K1, x0, x1)
        assert row.rotation_error == pytest.approx(reference.rotation_angle(R, o.pair.R), abs=1e-7)
        assert row.translation_error == pytest.approx(reference.direction_angle(t, o.pair.t), abs=1e-7)
        assert row.pose_reason is None
        assert 0 < row.rotation_error < 20


def test_why_a_pair_has_no_pose_error() -> None:
    sound = outcome(0)
    failed = dataclasses.replace(outcome(1), estimate=None, correspondences=None, reason="no keypoints in image 0")
    no_inliers = sound.estimate.replace(inliers=torch.zeros(1, N, dtype=torch.bool))
    nothing = dataclasses.replace(outcome(2), estimate=no_inliers)
    uncalibrated = without(outcome(3), K0=None, K1=None)
    unposed = without(outcome(4), R=None, t=None)
    broken = without(outcome(5), t=np.full(3, np.nan))
    rows = evaluation.evaluate([failed, uncalibrated, sound, unposed, nothing, broken])
    assert [(row.rotation_error, row.translation_error, row.pose_reason) for row in (*rows[:2], *rows[3:])] == [
        (180.0, 90.0, "no F"),
        (None, None, "K0, K1 unknown"),
        (None, None, "R, t unknown"),
        (180.0, 90.0, "no inlier in front of both cameras"),
        (None, None, "t not finite"),
    ]
    (alone,) = evaluation.evaluate([sound])
    assert (alone.rotation_error, alone.translation_error) == (rows[2].rotation_error, rows[2].translation_error)


def test_signed_errors_are_of_the_best_of_four_poses_and_keep_the_sign_of_an_estimates_own() -> None:
    outcomes = [outcome(seed) for seed in range(3)]
    for o, row in zip(outcomes, evaluation.evaluate(outcomes, signed=True), strict=True):
        four = solvers.poses(o.pair.K1.T @ o.estimate.F[0].numpy() @ o.pair.K0)
        expected = reference.closest_pose_error(four, o.pair.R, o.pair.t)
        assert (row.rotation_error, row.translation_error) == pytest.approx(expected, abs=1e-6)
    own = [o.estimate.replace(R=torch.eye(3)[None], t=-torch.from_numpy(o.pair.t)[None].float()) for o in outcomes]
    posed = [dataclasses.replace(o, estimate=estimate) for o, estimate in zip(outcomes, own, strict=True)]
    for row, folded in zip(evaluation.evaluate(posed, signed=True), evaluation.evaluate(posed), strict=True):
        assert row.translation_error == pytest.approx(180, abs=0.1)  # t in float32: the root of its rounding
        assert folded.translation_error == pytest.approx(0, abs=0.1)
        assert row.rotation_error == folded.rotation_error
    failed = dataclasses.replace(outcomes[0], estimate=None, correspondences=None, reason="no keypoints in image 0")
    zero = outcomes[1].estimate.replace(matrix=torch.zeros(1, 3, 3).double())
    rows = evaluation.evaluate([failed, dataclasses.replace(outcomes[1], estimate=zero)], signed=True)
    assert [(row.rotation_error, row.translation_error) for row in rows] == [(180.0, 180.0)] * 2
    assert [row.pose_reason for row in rows] == ["no F", "F has no pose"]


def run(folder: Path, name: str, *words: str) -> None:
    fixed = ("dataset=hpatches", "dataset.root=hpatches", "dataset.short_side=200", "cache=off", f"output={name}")
    with pytest.MonkeyPatch.context() as patch:
        call_command(patch, folder, "eval", "pipeline=sift_ratio", "estimator=homography", *fixed, *words)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs on two sequences, one image of which is missing."""
    folder = tmp_path_factory.mktemp("runs")
    root = native.write_hpatches(folder / "hpatches")
    (root / "v_view/6.ppm").unlink()
    run(folder, "runs/a")
    run(folder, "runs/b", "estimator.hypotheses=250", "executor=processes", "workers=1")
    return folder


def test_rows_hold_homographies_and_corner_errors(runs: Path) -> None:
    pairs = {pair.identity: pair for pair in load("hpatches", root=runs / "hpatches", short_side=200)}
    rows = RunFolder.load(runs / "runs/a").read().to_pylist()
    assert len(rows) == 10
    for row in rows:
        pair = pairs[row["pair"]]
        assert row["F"] is None
        assert math.isnan(row["nsgd"])
        assert row["rotation_error"] is None
        if pair.problem is not None:
            assert (row["ok"], row["corner_error"]) == (False, math.inf)
            assert row["reason"] == "no image hpatches/v_view/6.ppm"
            continue
        H, true = (torch.tensor(np.reshape(m, (3, 3))) for m in (row["H"], pair.H))
        assert row["corner_error"] == pytest.approx(float(corner_error(H, true, torch.tensor([200, 300]))))
        assert row["corner_error"] < 1
        assert row["inlier_rate"] > 0.9
    assert sum(not row["ok"] for row in rows) == 1


def test_the_summary_is_of_corner_errors(runs: Path) -> None:
    summary = json.loads((runs / "runs/a/summary.json").read_text())
    errors = torch.tensor(RunFolder.load(runs / "runs/a").read()["corner_error"].to_pylist(), dtype=torch.float64)
    overall = summary["all"]["homography"]
    assert overall["pairs"] == 10
    assert [overall[f"auc_{t}px"] for t in (1, 3, 5)] == pytest.approx(pose_auc(errors, (1, 3, 5)).tolist())
    assert summary["viewpoint"]["failures"] == 1
    assert summary["all"]["recall"] is summary["all"]["pose"] is None
    page = (runs / "runs/a/summary.md").read_text()
    assert "AUC@1 px" in page
    assert "%Recall" not in page
    assert (runs / "runs/a/recall.svg").stat().st_size > 0


def test_the_report_compares_corner_errors(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    call_command(monkeypatch, runs, "report", "runs", "root=hpatches", "pictures=2", "output=report.html")
    page = (runs / "report.html").read_text()
    for part in ("AUC@3 px", "corner error threshold [px]", "inliers of H", "minus each other run", "corner error 0."):
        assert part in page
    assert "NSGD" not in page.partition("<h2>Runs")[0].partition("</style>")[2]


def test_figures_of_known_errors() -> None:
    figures = homography_figures(np.array([0.5, 2.0, np.inf, np.nan]))
    # To 1: a triangle to (0.5, 1/3), then 0.5 at 1/3.
    assert figures["auc_1px"] == pytest.approx(0.5 / 6 + 0.5 / 3)
    assert (figures["pairs"], figures["corner_error"]) == (3, 2.0)
    assert homography_figures(np.array([np.nan])) is None
    failed = homography_figures(np.array([np.inf, np.inf, 1.0]))
    assert failed["corner_error"] is None


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("estimator=lmeds", "gives fundamental matrices; a pipeline needs homography matrices here: estimator=homog"),
        ("cameras=unknown", "the data set has homography matrices, which take no export=, cameras=, lens="),
        ("export=h5", "take no export="),
    ],
)
def test_what_does_not_go_together_is_refused(words: str, error: str, runs: Path) -> None:
    with pytest.raises(SystemExit, match=error):
        run(runs, "refused", words)
    assert not (runs / "refused").exists()


def test_homographies_need_a_set_that_has_them_and_label_no_matches(monkeypatch, runs, tmp_path):
    with pytest.raises(SystemExit, match="gives homography matrices; a pipeline needs fundamental matrices here"):
        call_command(monkeypatch, tmp_path, "eval", "dataset=stereo", "estimator=homography", "cache=off")
    with pytest.raises(ValueError, match="the data set hpatches has homography matrices; matches are labelled by"):
        MatchedPairs(load("hpatches", root=runs / "hpatches"), "sift_ratio", root=tmp_path)


def test_what_each_word_gives(tmp_path: Path) -> None:
    pair = outcome(0).pair
    paths = with_exif(tmp_path, (40, 60), FocalLengthIn35mmFilm=36), with_exif(tmp_path, (40, 60), "b.jpg")
    image0, image1 = (ImageSource(path.stem, path) for path in paths)
    pair = dataclasses.replace(pair, image0=image0, image1=image1)
    known, exif, shared, unknown = (given(pair, word) for word in ("known", "exif", "shared", "unknown"))
    assert torch.equal(known["K0"], torch.from_numpy(pair.K0))
    assert known["focal"].tolist() == [[1, 0], [1, 0]]
    assert exif["K0"] is exif["K1"] is None
    assert exif["focal"][0].tolist() == pytest.approx([60, math.hypot(0.06, 1 / math.sqrt(12) / 36)])
    assert exif["focal"][1].tolist() == [1, math.inf]
    assert (shared["shared_focal"], unknown["shared_focal"]) == (True, False)
    assert shared["focal"][:, 1].tolist() == unknown["focal"][:, 1].tolist() == [math.inf, math.inf]


def given(pair: ImagePair, cameras: str) -> Any:
    return evaluation.informed([pair], cameras)[0].given  # type: ignore[arg-type]


def test_a_calibration_that_is_missing_is_named() -> None:
    pair = dataclasses.replace(outcome(1).pair, K1=None)
    with pytest.raises(ValueError, match="cameras=known, but the data set has no calibration of pair p1"):
        given(pair, "known")
    assert given(dataclasses.replace(pair, problem="no image"), "known") is None


def estimated(outcomes: list[Outcome], cameras: str | None, lens: float | str | None = None) -> list[Outcome]:
    """The outcomes with the estimates of a batch whose estimator is given the cameras."""
    pairs = evaluation.informed([o.pair for o in outcomes], cameras, lens)  # type: ignore[arg-type]
    keyed = [o.correspondences.replace(key=torch.tensor([o.pair.key])) for o in outcomes]
    each = zip(outcomes, pairs, keyed, strict=True)
    return pipeline().estimate([dataclasses.replace(o, pair=p, correspondences=c) for o, p, c in each])


def test_rows_have_the_pose_of_the_estimate_and_neighbours_change_nothing() -> None:
    outcomes = [outcome(seed, noise=0.1) for seed in range(3)]
    rows = evaluation.evaluate(estimated(outcomes, "known"))
    for row, alone in zip(rows, (evaluation.evaluate(estimated([o], "known"))[0] for o in outcomes), strict=True):
        assert row.ok
        assert row.pose_reason is None
        assert row.rotation_error < 0.5
        assert row.translation_error < 5
        assert (alone.rotation_error, alone.translation_error) == (row.rotation_error, row.translation_error)


def test_poses_that_are_not_determined_and_pairs_without_estimates_among_others() -> None:
    (posed,) = estimated([outcome(0, noise=0.1)], "known")
    nothing = torch.full((1, 3, 3), torch.nan, dtype=torch.float64)
    lost = dataclasses.replace(posed, estimate=posed.estimate.replace(R=nothing, t=nothing[:, 0]))
    rows = evaluation.evaluate([lost, posed, outcome(1)])
    assert (rows[0].rotation_error, rows[0].translation_error) == (180, 90)
    assert [row.pose_reason for row in rows] == ["the pose is not determined", None, None]
    assert rows[1].rotation_error < 0.5


@pytest.mark.parametrize("cameras", [None, "shared"])
def test_a_lens_is_given_to_the_estimator(cameras: str | None) -> None:
    """As `find_fundamental` is given it, and rows say what it was taken for."""
    o = outcome(0, noise=0.1)
    key, prior = torch.tensor([o.pair.key]), torch.full_like(o.correspondences.mask, 0.5, dtype=torch.float64)
    c = o.correspondences.replace(key=key, prior=prior)
    (lensed,) = estimated([dataclasses.replace(o, correspondences=c)], cameras, -0.02)
    given = {name: getattr(c, name) for name in ("mask", "prior", "size0", "size1", "key")}
    alone = fmtorch.find_fundamental(c.x0, c.x1, **given, focal=cameras, lens=-0.02)
    assert torch.equal(lensed.estimate.F, alone.F)
    (row,) = evaluation.evaluate([lensed])
    assert (row.lens0, row.lens1) == pytest.approx((-0.02, -0.02), abs=1e-6)
    assert row.lens_suggested is None


def test_known_lenses_are_judged_in_photographs_and_rows_are_of_undistorted_matches() -> None:
    straight = outcome(0, noise=0.1)
    c, calibrations = straight.correspondences, (straight.pair.K0, straight.pair.K1)
    lenses = [fmtorch.Lens(*K[[0, 1, 0, 1], [0, 1, 2, 2]], "OPENCV", (-0.2, 0.0, 0.0, 0.0)) for K in calibrations]
    images = (ImageSource("a", Path("a"), lens=lens) for lens in lenses)
    x0, x1 = (torch.from_numpy(lens.distort(x[0].numpy()))[None] for lens, x in zip(lenses, (c.x0, c.x1), strict=True))
    c = c.replace(x0=x0, x1=x1, prior=torch.full_like(c.mask, 0.5, dtype=torch.float64))
    o = without(dataclasses.replace(straight, correspondences=c), image0=next(images), image1=next(images))
    (known,), (guessed,) = estimated([o], "known", "known"), estimated([o], "known", "shared")
    given = {name: getattr(c, name) for name in ("prior", "size0", "size1")}
    alone = fmtorch.find_essential(x0, x1, **given, lens=lenses, key=known.pair.key)
    assert torch.equal(known.estimate.F, alone.F)
    assert torch.equal(known.keypoints.x0, x0)
    for each in (known, guessed):
        torch.testing.assert_close(each.correspondences.x0, straight.correspondences.x0, atol=1e-6, rtol=0)
        (row,) = evaluation.evaluate(examined(pipeline(), [each]))
        assert (row.inlier_rate, row.pair_type) == (1, "general")
    assert guessed.estimate.lens.max() < -0.05


def test_a_run_with_cameras_is_another_run(command: Callable[..., str], tmp_path: Path) -> None:
    words = ["eval", "pipeline=sift_fmtorch", "dataset=fmbench", f"dataset.root={shared_path('data/Strecha_train')}"]
    words += ["limit=1", "workers=1", "features.max_features=2000"]

    def run(name: str, *more: str) -> tuple[str, dict[str, Any], dict[str, Any]]:
        said = command(*words, *more, f"output={name}", cwd=tmp_path)
        run, summary = (json.loads((tmp_path / name / f"{file}.json").read_text()) for file in ("run", "summary"))
        return said, run["config"], summary["all"]["pose"]

    assert {"cameras", "pose"}.isdisjoint(run("without")[1])
    _, identity, pose = run("known", "cameras=known")
    assert identity["cameras"] == "known"
    assert max(pose["rotation"], pose["translation"]) < 0.5
    said, identity, pose = run("signed", "cameras=known", "pose.signed=true")
    assert identity["pose"] == {"signed": True}
    assert pose["signed"] is True
    for text in (said, (tmp_path / "signed" / "summary.md").read_text()):
        spoken = " ".join(text.split())
        assert "t error, signed" in spoken
        assert "whose sign counts" in spoken
    assert "ended: error: pose.signed=2; it must be true or false" in command(*words, "pose.signed=2", cwd=tmp_path)
    assert "holds another run" in command(*words, "cameras=shared", "output=known", cwd=tmp_path)
    assert 'lens: (absent) -> "shared"' in command(*words, "lens=shared", "output=without", cwd=tmp_path)
    assert "ended: error: lens=known, but no lens of the data set bends" in command(*words, "lens=known", cwd=tmp_path)
    assert "ended: error: lens=some" in command(*words, "lens=some", cwd=tmp_path)
    assert "ended: error: cameras=some" in command(*words, "cameras=some", cwd=tmp_path)


def pipeline() -> Pipeline:
    return Pipeline(unused, unused, {}, presets.build("estimator", "fmtorch"))


def pair(kind: str, n: int = 150) -> ImagePair:
    drawn = draw(kind, 1, n)
    fields = batch([drawn])
    c = Correspondences(**{name: fields[name] for name in ("x0", "x1", "mask", "size0", "size1")})
    image, matches = ImageSource(kind, Path(kind)), functools.partial(GivenMatches, c, (n, n))
    return ImagePair(kind, "family", kind, image, image, drawn.F, K, K, drawn.R, drawn.t, matches=matches)


def rows(pairs: list[ImagePair], word: str | None) -> list[PairRow]:
    built = pipeline()
    return evaluation.evaluate(examined(built, built.run(evaluation.informed(pairs, word))))  # type: ignore[arg-type]


@pytest.mark.parametrize("word", [None, "known", "unknown"])
def test_rows_say_which_configuration_and_neighbours_change_nothing(word: str | None) -> None:
    pairs = [pair(kind, 150 + 10 * i) for i, kind in enumerate(PAIR_TYPES)]
    together = rows([*pairs, dataclasses.replace(pairs[0], identity="lost", problem="no image")], word)
    assert [row.pair_type for row in together] == [*PAIR_TYPES, None]
    assert [row.warning for row in together] == [*(WARNINGS[kind] for kind in PAIR_TYPES), None]
    for each, row in zip(pairs, together, strict=False):
        (alone,) = rows([each], word)
        assert (alone.F, alone.pair_type) == (row.F, row.pair_type)
        assert alone.focal_log_ratio0 == row.focal_log_ratio0


def test_a_pair_that_cannot_be_examined_harms_no_other() -> None:
    built = pipeline()
    outcomes = built.run([pair("general"), pair("planar")])
    broken = dataclasses.replace(outcomes[0], estimate=outcomes[0].estimate.replace(model="homography"))
    results = examined(built, [broken, outcomes[1]])
    assert [o.pair_type is None for o in results] == [True, False]
    first, second = evaluation.evaluate([dataclasses.replace(results[0], estimate=outcomes[0].estimate), results[1]])
    assert first.warning.startswith("not examined: ValueError: estimate is of homography matrices")
    assert second.pair_type == "planar"


def test_errors_of_focal_lengths() -> None:
    """Known answers: 10 % too long, not determined, given exactly, without truth, of pixels that are not square."""
    source = pair("general")
    (outcome,), (c, _) = pipeline().run([source]), source.matches()

    def errors(c: Correspondences, focals: list[float], *true: np.ndarray | None) -> dict[str, float]:
        estimate = outcome.estimate.replace(focals=torch.tensor([focals], dtype=torch.float64))
        known = dataclasses.replace(source, K0=true[0], K1=true[1])
        changed = dataclasses.replace(outcome, pair=known, correspondences=c, estimate=estimate)
        return evaluation.focal_errors(changed)

    asked = c.replace(focal=torch.tensor([[[1.0, torch.inf], [1.0, torch.inf]]], dtype=torch.float64))
    right = {"focal_error0": 0.1, "focal_log_ratio0": math.log(1.1), "focal_error1": math.inf}
    assert errors(asked, [1.1 * 768, math.nan], K, K) == pytest.approx(right)
    exact = asked.replace(focal=torch.tensor([[[768.0, 0.0], [768.0, 0.05]]], dtype=torch.float64))
    wide = np.diag([4.0, 1.0, 1.0]) @ K
    right = {"focal_error1": 0.5, "focal_log_ratio1": -math.log(2)}
    assert errors(exact, [768.0, 768.0], K, wide) == pytest.approx(right)
    assert errors(asked, [768.0, 768.0], None, K) == {"focal_error1": 0, "focal_log_ratio1": 0}
    assert errors(c, [768.0, 768.0], K, K) == {}  # nobody asked


def test_summaries_and_reports_show_them() -> None:
    pairs = [pair(kind) for kind in ("general", "planar")]
    table = to_table(rows(pairs, "unknown"))
    summary = evaluation.summarize(table)
    assert summary["all"]["pair_types"] == {**dict.fromkeys(PAIR_TYPES, 0), "general": 1, "planar": 1}
    assert summary["all"]["focals"]["images"] == 4
    console = Console(width=80, record=True)
    for each in evaluation.terminal_tables(summary, "t")[1:]:
        console.print(each)
    shown = console.export_text()
    assert "Focal lengths" in shown
    assert "do not determine F" in shown
    page = evaluation.summary_markdown(summary, "run")
    assert "| family | 1 | 1 | 0 | 0 | 0 |" in page
    assert "folded" in page
    of_report = {each.heading: each for each in evaluation.tables.report_tables({"run": table}, {"run": summary})}
    assert [cell.text for cell in of_report["Pair types"].rows["run"]] == ["1", "1", "0", "0", "0"]
    assert of_report["Focal lengths"].rows["run"][0].text == "4"
    nobody = to_table([dataclasses.replace(row, pair_type=None) for row in rows(pairs[:1], None)])
    assert "Pair types" not in {part.heading for part in evaluation.tables.parts(evaluation.summarize(nobody))}
    alone = evaluation.terminal_tables(evaluation.summarize(to_table(rows(pairs[:1], None))), "t")
    assert [each.title for each in alone] == ["t", "Relative pose", "Pruning"]  # all general: nothing to say
