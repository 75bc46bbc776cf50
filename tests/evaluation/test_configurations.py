"""Rows, summaries and reports with configurations, warnings and the errors of focal lengths."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from fmtorch import presets
from fmtorch.core import PAIR_TYPES, WARNINGS, Correspondences
from fmtorch.data import GivenMatches, ImagePair, ImageSource
from fmtorch.evaluation import (
    WithPairCameras,
    built_with,
    cameras_of,
    evaluate,
    focal_errors,
    summarize,
    summary_markdown,
    tables,
    terminal_tables,
)
from fmtorch.pipeline import Outcome, Pipeline, examined
from fmtorch.runs import PairRow, to_table
from tests.geometry.scenes import K, batch, draw
from tests.helpers import unused


def pipeline() -> Pipeline:
    return Pipeline(unused, unused, {}, presets.build("estimator", "fmtorch"))


def given(c: Correspondences) -> Callable[[], GivenMatches]:
    return lambda: GivenMatches(c, (c.mask.shape[1],) * 2)


def pair(kind: str, n: int = 150) -> ImagePair:
    drawn = draw(kind, 1, n)
    fields = batch([drawn])
    c = Correspondences(**{name: fields[name] for name in ("x0", "x1", "mask", "size0", "size1")})
    image = ImageSource(kind, Path(kind))
    return ImagePair(kind, "family", kind, image, image, drawn.F, K, K, drawn.R, drawn.t, matches=given(c))


def rows(pairs: list[ImagePair], word: str | None) -> list[PairRow]:
    built = pipeline()
    if word is not None:
        built = built_with(lambda: built, cameras_of(pairs, word))  # type: ignore[arg-type]
    knowledge = built.estimator.given if isinstance(built.estimator, WithPairCameras) else None
    return evaluate(examined(built, built.run(pairs), 0, knowledge))


@pytest.mark.parametrize("word", [None, "known", "unknown"])
def test_rows_say_which_configuration_and_neighbours_change_nothing(word: str | None) -> None:
    pairs = [pair(kind, 150 + 10 * i) for i, kind in enumerate(PAIR_TYPES)]
    lost = dataclasses.replace(pairs[0], identity="lost", problem="no image")
    together = rows([*pairs, lost], word)
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
    first, second = evaluate([dataclasses.replace(results[0], estimate=outcomes[0].estimate), results[1]])
    assert first.warning.startswith("not examined: ValueError: estimate is of homography matrices")
    assert second.pair_type == "planar"


def estimated(c: Correspondences, focals: list[float], true: tuple[np.ndarray | None, np.ndarray | None]) -> Outcome:
    source = pair("general")
    outcome = pipeline().run([source])[0]
    estimate = outcome.estimate.replace(focals=torch.tensor([focals], dtype=torch.float64))
    return dataclasses.replace(
        outcome, pair=dataclasses.replace(source, K0=true[0], K1=true[1]), correspondences=c, estimate=estimate
    )


def test_errors_of_focal_lengths() -> None:
    """Known answers: 10 % too long, not determined, given exactly, without truth, of pixels that are not square."""
    source = pair("general")
    c, _ = source.matches()
    asked = c.replace(focal=torch.tensor([[[1.0, torch.inf], [1.0, torch.inf]]], dtype=torch.float64))
    focals = focal_errors(estimated(asked, [1.1 * 768, math.nan], (K, K)))
    assert focals.error[0] == pytest.approx(0.1)
    assert focals.log_ratio[0] == pytest.approx(math.log(1.1))
    assert (focals.error[1], focals.log_ratio[1]) == (math.inf, None)
    exact = asked.replace(focal=torch.tensor([[[768.0, 0.0], [768.0, 0.05]]], dtype=torch.float64))
    wide = np.diag([4.0, 1.0, 1.0]) @ K
    focals = focal_errors(estimated(exact, [768.0, 768.0], (K, wide)))
    assert focals.error == (None, pytest.approx(0.5))
    assert focal_errors(estimated(asked, [768.0, 768.0], (None, K))).error == (None, 0)
    assert focal_errors(estimated(c, [768.0, 768.0], (K, K))).error == (None, None)  # nobody asked


def test_summaries_and_reports_show_them() -> None:
    pairs = [pair(kind) for kind in ("general", "planar")]
    table = to_table(rows(pairs, "unknown"))
    summary = summarize(table)
    assert summary["all"]["pair_types"] == {**dict.fromkeys(PAIR_TYPES, 0), "general": 1, "planar": 1}
    assert summary["all"]["focals"]["images"] == 4
    console = Console(width=80, record=True)
    for each in terminal_tables(summary, "t")[1:]:
        console.print(each)
    shown = console.export_text()
    assert "Focal lengths" in shown
    assert "do not determine F" in shown
    page = summary_markdown(summary, "run")
    assert "| family | 1 | 1 | 0 | 0 | 0 |" in page
    assert "folded" in page
    of_report = {each.heading: each for each in tables.report_tables({"run": table}, {"run": summary})}
    assert [cell.text for cell in of_report["Pair types"].rows["run"]] == ["1", "1", "0", "0", "0"]
    assert of_report["Focal lengths"].rows["run"][0].text == "4"
    nobody = to_table([dataclasses.replace(row, pair_type=None) for row in rows(pairs[:1], None)])
    assert "Pair types" not in {part.heading for part in tables.parts(summarize(nobody))}
    alone = terminal_tables(summarize(to_table(rows(pairs[:1], None))), "t")
    assert [each.title for each in alone] == ["t", "Relative pose"]  # all general: nothing to say
