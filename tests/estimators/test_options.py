"""Options as configs write them: groups, parts by name, by mapping and by object, and what is refused."""

import pytest
import torch

from fmtorch import find_fundamental, presets
from fmtorch.estimators import PARTS, InlierCount, Msac, Preselect, Ransac, part
from tests.laws import scene

MEDIAN = {"score": "median", "inliers": "lmeds", "confidence": None}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"refine": {"loss": "truncated", "threshold": 1}}, "refine: no option threshold; there are: "),
        ({"refine": {"scale": 1.0}}, "refine: loss is missing"),
        ({"refine": {"loss": "l1"}}, "refine.loss=l1; it must be one of: huber, cauchy, geman_mcclure"),
        ({"refine": {"loss": "cauchy", "scale": 0.0}}, "refine.scale=0.0; it must be a number above 0"),
        ({"refine": {"loss": "cauchy", "matches": 0}}, "refine.matches=0; it must be a whole number of at least 1"),
        ({"preselect": {"matches": 0}}, "preselect.matches=0; it must be a whole number of at least 1"),
        ({"preselect": Preselect(survivors=0)}, "preselect.survivors=0; it must be a whole number of at least 1"),
        ({"select": {"scale": 0.0}}, "select.scale=0.0; it must be a number above 0"),
        ({"select": {}, "focal": {"samples": -1}}, "focal.samples=-1; it must be a whole number of at least 0"),
        ({"select": {}, "focal": {"min_rounds": 2}}, "focal.min_rounds is 2; it must be at most focal.rounds, 1"),
        ({"select": {}, "focal": {"confirmations": 0}}, "focal.confirmations=0; it must be a whole number"),
        ({"focal": {}}, "focal needs select"),
        ({"score": "prior_saturated"}, "score is 'prior_saturated'; it must be one of: inlier_count, msac, saturated"),
        ({"score": {"name": "msac", "weighted": True}}, "score=msac: no option weighted; there are: prior_weighted"),
        ({"score": {"prior_weighted": True}}, "score is None; it must be one of"),
        ({"pool": 0}, "pool=0; it must be a whole number of at least 1"),
        ({"confidence": 1.0}, "confidence=1.0; it must be a number between 0 and 1 or null"),
        ({"select": {}, "focal": {"exact": {"scale": -1}}}, "focal.exact.scale=-1; it must be a number above 0"),
        (MEDIAN | {"threshold": 2.0}, "threshold=2.0 has no effect: score=median takes none"),
        (MEDIAN | {"inlier_threshold": 2.0}, "inlier_threshold=2.0 has no effect: inliers=lmeds takes none"),
        ({"local_optimization": "x"}, "local_optimization is 'x'; it must be one of: graph_cut"),
    ],
)
def test_bad_options_are_told(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Ransac(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options",
    [
        {"threshold": 2.0, "inliers": "threshold"},
        {"inlier_threshold": 2.0, "inliers": "threshold"},
        {"threshold": 2.0, "confidence": 0.99},  # of the stopping rule
        {"threshold": 2.0, "local_optimization": "graph_cut"},
    ],
)
def test_thresholds_that_something_asks_for_are_taken(options: dict[str, object]) -> None:
    Ransac(**(MEDIAN | options))  # type: ignore[arg-type]


def test_a_part_is_a_name_a_mapping_or_an_object() -> None:
    named = part("score", "msac", threshold=2.0)
    assert isinstance(named, Msac)
    assert (named.threshold, named.prior_weighted) == (2.0, False)
    weighted = part("score", {"name": "msac", "prior_weighted": True}, threshold=2.0)
    assert (weighted.threshold, weighted.prior_weighted) == (2.0, True)
    own = part("score", {"name": "msac", "threshold": 3.0}, threshold=2.0)
    assert own.threshold == 3.0
    assert part("score", weighted) is weighted
    assert part("degeneracy", None) is None


@pytest.mark.parametrize("role", PARTS)
def test_every_part_can_be_made(role: str) -> None:
    for name in PARTS[role]:
        assert part(role, name, threshold=1.0, score=InlierCount(1.0)) is not None


def test_flat_and_nested_options_replace_those_of_a_preset() -> None:
    c = scene(0, 200)
    estimate = find_fundamental(
        c.x0, c.x1, prior=c.prior, size0=c.size0, size1=c.size1, hypotheses=500, preselect={"survivors": 30},
        focal={"samples": 100},
    )  # fmt: skip
    built = presets.build("estimator", "fmtorch", hypotheses=500, preselect={"survivors": 30}, focal={"samples": 100})
    assert built.search.hypotheses == 500
    assert built.search.preselection.options == Preselect(64, 30)
    assert (built.focal.search.hypotheses, built.focal.search.pool) == (100, 24)
    assert torch.equal(estimate.F, built(c.replace(key=None, ratio=None)).F)
    without = presets.build("estimator", "fmtorch", focal=None)
    assert without.focal is None
