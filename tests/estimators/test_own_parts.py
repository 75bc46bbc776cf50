"""A score, a sampler and a rule of one's own: as good as built-in ones, nearly as fast, and refused where wrong."""

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fmtorch import find_fundamental, presets
from fmtorch.core import collate
from fmtorch.estimators import PARTS, InlierCount, Msac, Preselect, Ransac, SummedGains, part
from fmtorch.geometry import sampson
from tests.estimators import own_parts
from tests.laws import assert_same, few, scene, scenes
from tests.processes import run_command

REPLACED: dict[str, dict[str, Any]] = {
    "score": {"score": own_parts.Welsch(1.0)},
    "compiled score": {"score": own_parts.CompiledSquares(1.0)},
    "sampler": {"sampler": own_parts.BestHalf()},
    "rule": {"inliers": own_parts.Within2Px()},
}
PRESETS = ("msac", "fmtorch")
OWN_PARTS = "tests.estimators.own_parts"
MEDIAN = {"score": "median", "inliers": "lmeds", "confidence": None}
ALIKE = {
    "score": own_parts.Squares(1.0),
    "compiled score": own_parts.CompiledSquares(1.0),
    "sampler": own_parts.Same(),
    "inliers": lambda squared_px, pair: squared_px <= 1.0,
}


def built(preset: str, parts: dict[str, Any], **options: Any) -> Any:
    """Few hypotheses. A score of one's own has a threshold of its own."""
    options |= {"threshold": None} if preset == "fmtorch" and "score" in parts else {}
    return presets.build("estimator", preset, **few(presets.load("estimator", preset)), **options, **parts)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", REPLACED)
def test_estimates_are_as_good_as_with_built_in_parts(name: str, preset: str) -> None:
    pairs = [scene(i, 200, outliers=0.3) for i in range(8)]
    estimator, builtin = built(preset, REPLACED[name]), built(preset, {})
    own, usual = estimator(collate(pairs)), builtin(collate(pairs))
    assert bool(own.ok.all())
    # 30 % outliers: 140 right matches of noise 0.3 px, nearly all of which a right model has for inliers.
    assert int(own.inliers.sum(1).min()) > 120
    assert abs(float(own.inliers.sum()) / float(usual.inliers.sum()) - 1) < (0.25 if name == "rule" else 0.05)
    for i in (0, 5):  # alone as in a batch
        alone = estimator(pairs[i])
        shared = {"F": own.F[i : i + 1], "inliers": own.inliers[i : i + 1]}
        assert_same({"F": alone.F, "inliers": alone.inliers}, shared, name)


@pytest.mark.parametrize("names", [*([name] for name in ALIKE), ["compiled score", "sampler", "inliers"]])
def test_parts_that_do_as_the_built_in_ones_give_the_same_bits(names: list[str]) -> None:
    parts = {name.removeprefix("compiled "): ALIKE[name] for name in names}
    own, builtin = (presets.build("estimator", "msac", **given)(scenes(), 3) for given in (parts, {}))
    assert bool(builtin.ok.all())
    results = ({name: getattr(e, name) for name in ("F", "inliers", "ok", "samples")} for e in (own, builtin))
    assert_same(*results, "msac")


def test_parts_are_named_as_targets() -> None:
    score = {"_target_": f"{OWN_PARTS}.Welsch", "threshold": 1.0}
    named = presets.build("estimator", "msac", score=score, sampler={"_target_": f"{OWN_PARTS}.BestHalf"})
    given = presets.build("estimator", "msac", score=own_parts.Welsch(1.0), sampler=own_parts.BestHalf())
    assert torch.equal(named(scene(0)).F, given(scene(0)).F)


def test_a_rule_decides_the_inliers() -> None:
    c = scene(1, 200)
    estimate = built("msac", {"inliers": own_parts.Within2Px()}, final="none", refit_inliers=True)(c)
    distance = sampson(estimate.F, c.x0.double(), c.x1.double())
    clear = (distance - 2).abs() > 1e-6
    assert torch.equal(estimate.inliers[clear], (distance <= 2)[clear])


class Gain(SummedGains):
    def __init__(self, gain: Any) -> None:
        super().__init__(1.0)
        self.gain = gain


def sampled(draw: Any) -> dict[str, Any]:
    return {"sampler": own_parts.Sampled(draw)}


def scored(scores: Any, part: Any = own_parts.Scored) -> dict[str, Any]:
    return {"score": part(scores)}


SAMPLES, GAINS = r"Sampled.draw returns .*", r"; it must be the shape of its argument, \(\d+, 60\): .* of numbers"
WRONG: list[tuple[dict[str, Any], str]] = [
    (sampled(lambda m, size: np.zeros((m, size), np.int64)), rf"{SAMPLES}int64 \(100, 7\); .* \(7, 100\)"),
    (sampled(lambda m, size: np.zeros((size, m))), rf"{SAMPLES}float64 \(7, 100\); it must be an array"),
    (sampled(lambda m, size: np.full((size, m), 60)), f"{SAMPLES}indices from 60 to 60; .* from 0 to 59"),
    (sampled(lambda m, size: np.full((size, m), -1)), f"{SAMPLES}indices from -1 to -1"),
    (sampled(None), f"{SAMPLES}NoneType; it must be an array of int64"),
    (scored(lambda which: np.zeros(len(which) + 1)), r"Scored returns float64 \(\d+,\); it must be an array"),
    (scored(lambda which: np.zeros(len(which), np.float32)), "Scored returns float32"),
    (scored(lambda which: 1.0), "Scored returns float; it must be"),
    (scored(lambda squared: squared[:, :3], Gain), rf"Gain.gain returns shape \(\d+, 3\) of float32{GAINS}"),
    (scored(lambda squared: squared.sum(1), Gain), rf"Gain.gain returns shape \(\d+,\) of float32{GAINS}"),
    (scored(lambda squared: squared * np.nan, Gain), GAINS),
    (scored(lambda squared: 1.0, Gain), rf"shape \(\) of float64{GAINS}"),
    (scored(lambda squared: squared + 0j, Gain), rf"shape \(\d+, 60\) of complex64{GAINS}"),
    (scored(lambda squared: [["one"] * 60] * len(squared), Gain), rf"shape \(\d+, 60\) of <U3{GAINS}"),
    ({"inliers": lambda r2, pair: r2}, r"function returns float64 \(60,\); it must be an array of bool \(60,\)"),
    ({"inliers": lambda r2, pair: (r2 <= 1)[:9]}, r"function returns bool \(9,\)"),
    ({"inliers": lambda r2, pair: [True] * len(r2)}, "function returns list"),
    ({"score": SummedGains(1.0)}, "SummedGains must override `gain` or name a `gain_kernel`"),
]


@pytest.mark.parametrize(("parts", "complaint"), WRONG)
def test_what_parts_return_wrongly_is_refused_by_name(parts: dict[str, Any], complaint: str) -> None:
    with pytest.raises((ValueError, NotImplementedError), match=complaint):
        built("msac", parts)(scene(1, 60))
    if isinstance(parts.get("score"), own_parts.Scored):  # with preselection, too
        with pytest.raises(ValueError, match=complaint):
            built("msac", parts)(scene(1, 600))


def test_scores_may_be_a_column() -> None:
    forms = (np.float64, lambda which: np.stack([which * 1.0, which * 0.0], 1)[:, 0])
    plain, column = (built("msac", scored(form))(scene(1, 600)).F for form in forms)
    assert torch.equal(column, plain)


def compared(preset: str) -> None:
    """Prints the draws of a preset and of its like with parts in NumPy, and the CPU times: each the least of some."""
    c = scene(1, 600, outliers=0.5)
    # The gain of `fmtorch` differs, but not the work: as many draws from all matches, as many models preselected.
    score = own_parts.Squares(1.0) if preset == "msac" else own_parts.Welsch(1.5, prior_weighted=True)
    threshold = {} if preset == "msac" else {"threshold": None}
    parts = {"score": score, "sampler": own_parts.AllAlike(), "inliers": own_parts.Within2Px()}
    estimators = presets.build("estimator", preset, **parts, **threshold), presets.build("estimator", preset)
    draws, fastest = [int(estimator(c).samples) for estimator in estimators], [math.inf, math.inf]
    for _ in range(20):
        for k, estimator in enumerate(estimators):
            start = time.process_time()
            estimator(c)
            fastest[k] = min(fastest[k], time.process_time() - start)
    print(*draws, *fastest)


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_parts_in_numpy_take_at_most_three_times_as_long(preset: str, tmp_path: Path) -> None:
    """Score, sampler and rule together, at the same work, in a process whose calls are not checked, as a user's."""
    ended = run_command("-c", f"from {__name__} import compared; compared({preset!r})", cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    draws, builtin_draws, seconds, builtin = map(float, ended.stdout.split())
    print(f"{preset}: {1000 * builtin:.2f} ms, with parts in NumPy {1000 * seconds:.2f} ms")
    assert draws == builtin_draws
    assert seconds < 3 * builtin


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
        ({"inlier_threshold": 0}, "inlier_threshold=0; it must be a number above 0 or null"),
        ({"confidence": 1.0}, "confidence=1.0; it must be a number between 0 and 1 or null"),
        (MEDIAN | {"threshold": 2.0}, "threshold=2.0 has no effect: score=median takes none"),
        (MEDIAN | {"inlier_threshold": 2.0}, "inlier_threshold=2.0 has no effect: inliers=lmeds takes none"),
        ({"local_optimization": "x"}, "local_optimization is 'x'; it must be one of: graph_cut"),
        ({"solver": "four_point", "degeneracy": "degensac"}, "seven_point"),
        ({"solver": "eight_point", "degeneracy": "degensac"}, "degensac needs solver=seven_point; solver is 'eight"),
        ({"solver": "four_point", "local_optimization": "graph_cut"}, "is for fundamental matrices"),
        ({"solver": "four_point", "focal": {}}, "is for fundamental matrices"),
    ],
)
def test_bad_options_are_reported(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Ransac(**options)  # type: ignore[arg-type]


def test_thresholds_that_something_asks_for_are_taken() -> None:
    Ransac(**(MEDIAN | {"inlier_threshold": 2.0, "inliers": "threshold"}))  # type: ignore[arg-type]
    for asks in ({"inliers": "threshold"}, {"confidence": 0.99}, {"local_optimization": "graph_cut"}):
        Ransac(**(MEDIAN | {"threshold": 2.0} | asks))  # type: ignore[arg-type]


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
