"""A round by one kernel against the same round by one kernel for each part, to the bit."""

from __future__ import annotations

import pytest
import torch

from fmtorch import presets
from fmtorch.core.types import Correspondences, collate
from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.one_pair.focal.rounds import JoinedRounds
from fmtorch.estimators.verbs import FocalParts
from tests.estimators.test_one_pair import real_pairs
from tests.laws import degenerate, scene, small

pytest.importorskip("numba", reason="numba is not installed")

CHOICE = {"sampler": "prior", "score": "saturated", "select": {"scale": 1.0}, "threshold": 1.5}
REFINE = {"kernel": "truncated", "matches": 64}
JOINED = CHOICE | {"refine": REFINE, "focal": {"samples": 60, "rounds": 3, "pool": 6, "iterations": 3}}


def parts(estimator: HypothesizeAndVerify) -> FocalParts:
    """What makes the rounds of one pair."""
    assert estimator.kernel_form is not None
    found = estimator.kernel_form.selected.focal
    assert found is not None
    return found


def in_both_ways(estimator: HypothesizeAndVerify, c: Correspondences, monkeypatch: pytest.MonkeyPatch) -> None:
    joined = estimator(c, seed=3)
    with monkeypatch.context() as step_by_step:
        step_by_step.setattr(JoinedRounds, "round", FocalParts.round)
        parts_alone = estimator(c, seed=3)
    for name in ("F", "inliers", "ok", "draws", "significance"):
        assert torch.equal(getattr(joined, name), getattr(parts_alone, name)), name
    assert joined.reason == parts_alone.reason


@pytest.mark.parametrize("name", ["fmtorch", "fmtorch_max", "fmtorch_fast"])
def test_the_presets_join_their_rounds(name: str) -> None:
    assert isinstance(parts(presets.build("estimator", name)), JoinedRounds)


@pytest.mark.parametrize(
    "options",
    [
        {"score": "msac"},
        {"refine": None},
        {"refine": REFINE | {"matches": None}},
        {"focal": {"samples": 501}},  # more than are drawn at a time
    ],
)
def test_other_parts_take_a_step_each(options: dict[str, object]) -> None:
    assert isinstance(parts(HypothesizeAndVerify(**JOINED)), JoinedRounds)  # type: ignore[arg-type]
    assert not isinstance(parts(HypothesizeAndVerify(**(JOINED | options))), JoinedRounds)  # type: ignore[arg-type]


@pytest.mark.parametrize("sampler", ["prior", "prosac", "uniform"])
@pytest.mark.parametrize("preselect", [None, {"matches": 32, "survivors": 12}])
@pytest.mark.parametrize("told", ["all", "nothing"])
def test_scenes(sampler: str, preselect: object, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    estimator = HypothesizeAndVerify(**(JOINED | {"sampler": sampler, "preselect": preselect}))  # type: ignore[arg-type]
    pairs = [scene(i, count, outliers=0.5) for i, count in enumerate((9, 40, 150, 700))]
    pairs.append(scene(5, 300).replace(size1=torch.tensor([[700, 900]])))
    if told == "nothing":
        pairs = [c.replace(prior=None, quality=None, noise=None) for c in pairs]
    in_both_ways(estimator, collate(pairs), monkeypatch)


def test_few_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    in_both_ways(HypothesizeAndVerify(**JOINED), collate(list(small().values())), monkeypatch)  # type: ignore[arg-type]


@pytest.mark.parametrize("factor", [1.0, 1e-9, 1e9])
def test_degenerate_pairs(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = [c.replace(x0=c.x0.double() * factor, x1=c.x1.double() * factor) for c in degenerate().values()]
    sized = [c if c.size0 is not None else c.replace(size0=torch.tensor([[480, 640]]), size1=torch.tensor([[480, 640]]))
             for c in pairs]  # fmt: skip
    in_both_ways(HypothesizeAndVerify(**JOINED), collate(sized), monkeypatch)  # type: ignore[arg-type]


def test_real_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    in_both_ways(presets.build("estimator", "fmtorch"), real_pairs()[0], monkeypatch)
