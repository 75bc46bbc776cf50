"""The percentile bootstrap of a mean over clusters, one resample at a time."""

import random
from collections.abc import Sequence


def bootstrap_interval(values: Sequence[float], clusters: Sequence[str], resamples: int) -> tuple[float, float]:
    """The 2.5 % and 97.5 % points of the mean over resampled clusters."""
    members: dict[str, list[float]] = {}
    for value, cluster in zip(values, clusters, strict=True):
        members.setdefault(cluster, []).append(value)
    rng = random.Random(0)
    names, means = list(members), []
    for _ in range(resamples):
        drawn = [value for name in rng.choices(names, k=len(names)) for value in members[name]]
        means.append(sum(drawn) / len(drawn))
    means.sort()
    return means[int(0.025 * resamples)], means[int(0.975 * resamples)]
