"""The prior on focal lengths where these are measured, shared, or neither: its cost and its draws."""

import math

import numpy as np
import pytest

from fmtorch.estimators.models.focal_prior import draw_depths, focal_cost, focal_prior, same_camera_share
from tests.reference import focal as reference

KNOWN = {
    "nothing": (math.inf, math.inf), "one": (0.0, math.inf), "the other roughly": (math.inf, 0.1),
    "both": (0.001, 0.01), "both roughly": (0.06, 0.06),
}  # fmt: skip
"""Deviations of measured focal lengths."""
EXACT = 1e-5  # deviation that stands for 0
COUNT = 4000
STANDARD_ERROR = 0.5 / math.sqrt(COUNT)  # of a share of the draws, at most


@pytest.mark.parametrize("same", [True, False])
@pytest.mark.parametrize("known", KNOWN)
def test_its_cost_and_gradient(same: bool, known: str) -> None:
    rng, out, h, (s0, s1) = np.random.default_rng(0), np.empty(5), 1e-6, KNOWN[known]
    for _ in range(20):
        focal = rng.normal(0.2, 0.4) + rng.normal(0, 0.01 if same else 0.5, 2)
        m0, m1 = (focal + rng.normal(0, np.minimum((s0, s1), 0.3))).tolist()

        def cost(at: np.ndarray, measured: reference.Measured = ((m0, s0), (m1, s1))) -> float:
            return reference.prior_cost(*at, same_size=same, measured=measured)

        computed = focal_cost(focal, focal_prior(same, False, (m0, m1), (s0, s1)), out)
        assert computed == pytest.approx(cost(focal), rel=1e-9, abs=1e-9)
        for i, step in enumerate(h * np.eye(2)):
            # The well, 0.01 wide and 5 deep, has third derivatives of up to 1e8: h^2 of these.
            numeric = (cost(focal + step) - cost(focal - step)) / (2 * h)
            assert out[i] == pytest.approx(numeric, rel=1e-6, abs=1e-3)


def test_a_shared_focal_length_is_one_parameter() -> None:
    """The first; what does not depend on it is left out."""
    prior, out, h = focal_prior(True, True, (0.3, 0.0), (0.05, math.inf)), np.empty(5), 1e-6

    def cost(at: float) -> float:
        return reference.prior_cost(at, at, measured=((0.3, 0.05), (0.0, math.inf)))

    for at in (0.1, 0.3, 0.7):
        assert focal_cost(np.array([at, at]), prior, out) == pytest.approx(cost(at), rel=1e-12)
        assert out[0] == pytest.approx((cost(at + h) - cost(at - h)) / (2 * h), rel=1e-6, abs=1e-8)
        assert (out[1], out[3], out[4]) == (0.0, 1.0, 0.0)
        assert out[2] > 0


def drawn(known: str, same: bool, shared: bool = False) -> np.ndarray:
    """Logarithms (2, COUNT) for measurements of 0.5 and 0.4."""
    depth = np.empty((2, COUNT))
    draw_depths(focal_prior(same, shared, (0.5, 0.4), KNOWN[known]), np.ones(2), 3, 4, 0, depth)
    return np.log(depth)


@pytest.mark.parametrize("known", ["one", "the other roughly", "both", "both roughly"])
def test_draws_follow_prior_and_measurements(known: str) -> None:
    """The product of both, and where a measurement may be wrong three fifths of the prior alone."""
    deviation, a, b = KNOWN[known], 0.4**2, 0.5**2 / 4
    P = np.linalg.inv([[a + b, a - b], [a - b, a + b]])
    measured = np.array([1 / max(s, EXACT) ** 2 for s in deviation])
    total = P + np.diag(measured)
    mean = np.linalg.solve(total, P @ np.full(2, math.log(1.2)) + measured * [0.5, 0.4])
    spread = np.sqrt(np.diag(np.linalg.inv(total)))
    believed = 0.4 if any(0.02 <= s < math.inf for s in deviation) else 1.0
    for log_f, m, s in zip(drawn(known, False), mean, spread, strict=True):
        for z in (-1.0, 0.0, 1.0):
            of_prior = 0.5 * math.erfc((math.log(1.2) - m - z * s) / math.sqrt(2 * (a + b)))
            share = believed * 0.5 * math.erfc(-z / math.sqrt(2)) + (1 - believed) * of_prior
            assert float((log_f < m + z * s).mean()) == pytest.approx(share, abs=4 * STANDARD_ERROR)


def test_draws_of_one_camera() -> None:
    assert np.ptp(drawn("nothing", False, shared=True), axis=0).max() < 1e-12
    assert float((np.ptp(drawn("one", True), axis=0) < 1e-12).mean()) == pytest.approx(0.7, abs=4 * STANDARD_ERROR)
    assert not (np.ptp(drawn("both", True), axis=0) < 1e-12).any()  # which are not measured alike
    share = same_camera_share(0.1, np.array([0.06, 0.06]))
    believed, rest = 0.4 * share, 0.6 * share  # those from the prior have the same share
    equal = float((np.ptp(drawn("both roughly", True), axis=0) < 1e-12).mean())
    assert equal == pytest.approx(believed + rest, abs=4 * STANDARD_ERROR)


def test_how_likely_one_camera_is() -> None:
    """By Bayes' rule, of two normal densities of the difference of what is measured."""
    s = np.array([0.05, 0.1])
    for difference in (0.0, 0.1, 0.5):
        same, different = (
            math.exp(-(difference**2) / 2 / v) / math.sqrt(v) for v in (0.0125 + 0.01**2, 0.0125 + 0.5**2)
        )
        expected = 0.7 * same / (0.7 * same + 0.3 * different)
        assert same_camera_share(difference, s) == pytest.approx(expected, rel=1e-12)
    assert same_camera_share(0.0, np.array([0.0, math.inf])) == 0.7
