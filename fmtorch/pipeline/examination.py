"""Which configurations the pairs of a run are in, by the matches and what the estimator was given of the cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from fmtorch.core.stages import model_of
from fmtorch.core.types import Correspondences, collate
from fmtorch.jobs.threads import one_thread
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from fmtorch.two_view.pair_type import classify

Knowledge = Callable[[Correspondences], Correspondences]


def examined(
    pipeline: Pipeline, outcomes: Sequence[Outcome], seed: int = 0, knowledge: Knowledge | None = None
) -> list[Outcome]:
    """The outcomes of a run with their configurations; a pair that cannot be examined has none and harms no other.

    knowledge: gives correspondences what the estimator was given of their cameras; None: nothing, and their K counts
    for nothing here. Matches of the results have what it gives. Of homographies nothing is asked.
    """
    if model_of(pipeline.estimator) != "fundamental":
        return list(outcomes)
    matched = [i for i, o in enumerate(outcomes) if o.correspondences is not None and o.estimate is not None]
    results = list(outcomes)
    with one_thread(pipeline.device):
        try:
            own = _examined([outcomes[i] for i in matched], seed, knowledge) if matched else []
        except Exception:  # whose fault it is shows pair by pair
            own = [_alone(outcomes[i], seed, knowledge) for i in matched]
    for i, outcome in zip(matched, own, strict=True):
        results[i] = outcome
    return results


def _examined(outcomes: Sequence[Outcome], seed: int, knowledge: Knowledge | None) -> list[Outcome]:
    c = collate([o.correspondences for o in outcomes if o.correspondences is not None])
    estimate = collate([o.estimate for o in outcomes if o.estimate is not None])
    if knowledge is None:
        configuration = classify(c.derived(K0=None, K1=None), estimate, seed=seed)
    else:
        c = knowledge(c)
        configuration = classify(c, estimate, seed=seed)
    return [
        dataclasses.replace(outcome, correspondences=c[i], configuration=configuration.of_pair(i))
        for i, outcome in enumerate(outcomes)
    ]


def _alone(outcome: Outcome, seed: int, knowledge: Knowledge | None) -> Outcome:
    try:
        return _examined([outcome], seed, knowledge)[0]
    except Exception as error:  # what it is in stays unknown, and the row says why
        reason = f"not examined: {type(error).__name__}: {error}".splitlines()[0]
        return dataclasses.replace(outcome, not_examined=reason)
