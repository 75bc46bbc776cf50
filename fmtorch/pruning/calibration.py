"""From evidence to P(inlier) of each match, and to the noise of its position."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import gradient_wanted, sqrt
from fmtorch.jit.kernel import Array, B1x1, F4x1, F4x3, F8x1, F8x3, for_each_pair, inner, kernel

_SQUARINGS = 10
SCORE_POWER = 0.75  # of the odds of a score, by square roots
_MIN_SCORE = 1e-3  # and its distance from 1
MIN_CORRELATION = 0.1  # of scores that say something, with the evidence; LightGlue's mostly have 0.2 to 0.5
_LARGEST = 12.0  # log-odds beyond which P(inlier) is as good as 0 or 1; the logistic function here is 6e-6 off 1 there


@inner
def logistic(z: Any) -> Any:
    """``o / (1 + o)`` with ``o = (1 + z / 1024)^1024``, the logistic function but for 0.001 at most. Of tensors, too.
    Made of arithmetic alone, whose last bits, unlike those of exp, do not depend on where in memory a number stands. z:
    float64, since the power multiplies a rounding error by 1024; between -1024 and 1024."""
    odds = odds_of(z)
    return odds / (odds + 1)


@inner
def odds_of(z: Any) -> Any:
    """The odds of `logistic`, exp(z) but for what is written there."""
    odds = 1 + z / 2**_SQUARINGS
    for _ in range(_SQUARINGS):
        odds = odds * odds
    return odds


@kernel
def calibrated(evidence: F4x1, ratio: F4x1, mask: B1x1, numbers: F4x1, out: F4x1) -> None:
    """P(inlier) of `Calibration` from evidence and ratio (n,) -> out (n,); zero where masked.
    ratio: empty where unknown. numbers: constant, weights of evidence and ratio."""
    for i in range(len(mask)):
        z = numbers[0] + numbers[1] * evidence[i]
        if len(ratio):
            z += numbers[2] * (np.float32(1) if np.isnan(ratio[i]) else ratio[i])
        out[i] = logistic(min(max(np.float64(z), -_LARGEST), _LARGEST)) if mask[i] else 0.0


@kernel
def calibrated_by_score(evidence: F4x1, score: F4x1, mask: B1x1, numbers: F8x1, out: F4x1) -> None:
    """P(inlier) of `Calibration` from evidence and a matcher's score (n,) -> out (n + 1,), zero where masked; the last
    is 1 where scores are taken for probabilities. numbers: the two of `alone`; constant, tolerance of `with_score`."""
    n, count, expected, agreed, factor = len(mask), 0, 0.0, 0.0, odds_of(numbers[2])
    alone, scored = np.empty(n), np.empty(n)
    for i in range(n):
        if mask[i]:
            s = min(max(np.float64(score[i]), _MIN_SCORE), 1 - _MIN_SCORE)
            root = math.sqrt(s / (1 - s))
            odds = factor * root * math.sqrt(root)  # s / (1 - s) to the power of SCORE_POWER
            alone[i] = logistic(min(max(numbers[0] + numbers[1] * evidence[i], -_LARGEST), _LARGEST))
            scored[i] = odds / (odds + 1)
            expected, agreed, count = expected + scored[i], agreed + alone[i], count + 1
    covariance, scores, evidences = 0.0, 0.0, 0.0
    for i in range(n):
        if mask[i]:
            s, e = scored[i] - expected / count, alone[i] - agreed / count
            covariance, scores, evidences = covariance + s * e, scores + s * s, evidences + e * e
    correlated = covariance > MIN_CORRELATION * math.sqrt(scores * evidences) + 1e-9 * count
    probable = correlated and abs(expected - agreed) < numbers[3] * count
    for i in range(n):
        out[i] = (scored[i] if probable else alone[i]) if mask[i] else 0.0
    out[n] = 1.0 if probable else 0.0


@dataclasses.dataclass(frozen=True)
class Calibration:
    """``P(inlier) = logistic(constant + evidence e + ratio q)`` of the evidence e and the distance ratio q.
    with_ratio: {constant, evidence, ratio}, where matches have a `ratio`. alone: {constant, evidence}, where they have
    none; without it their prior stays as it is. with_score: {constant, tolerance}, where they have a matcher's score s
    and no ratio: ``logistic(constant + SCORE_POWER log(s / (1 - s)))``. That holds of scores that are probabilities, as
    LightGlue's, which has seen all matches. Others are ignored: a pair's scores are taken for such only if the mean of
    that is within the tolerance of the mean P(inlier) by `alone`, and the two are correlated.
    `scripts/calibrate_priors.py` fits the numbers of `with_ratio` and `alone`."""

    with_ratio: Mapping[str, float]
    alone: Mapping[str, float] | None = None
    with_score: Mapping[str, float] | None = None

    def __call__(self, c: Correspondences, evidence: Float[Tensor, "b n"]) -> Correspondences:
        """The same matches with ``prior``, zero where masked. A ratio that is NaN counts as 1. Computed in float32."""
        if c.ratio is None and c.score is not None and self.with_score is not None and self.alone is not None:
            return self._by_score(c, evidence, c.score, self.alone, self.with_score)
        ratio = c.ambiguity
        fitted = self.alone if ratio is None else self.with_ratio
        if fitted is None:
            return c
        numbers = np.array([fitted["constant"], fitted["evidence"], fitted.get("ratio", 0.0)], np.float32)
        out = torch.empty(c.mask.shape, dtype=torch.float32)
        prior = for_each_pair(calibrated, (evidence, ratio, c.mask), numbers, out=out)
        if gradient_wanted(evidence, ratio):
            z = fitted["constant"] + fitted["evidence"] * torch.where(c.mask, evidence, 0)
            if ratio is not None:
                z = z + fitted["ratio"] * torch.where(c.mask, ratio, 0).nan_to_num(nan=1.0)
            prior = _with_gradient(prior, z.clamp(-_LARGEST, _LARGEST))
        return c.derived(prior=prior.to(c.x0.dtype))

    @staticmethod
    def _by_score(
        c: Correspondences, evidence: Float[Tensor, "b n"], score: Float[Tensor, "b n"],
        alone: Mapping[str, float], scored: Mapping[str, float],
    ) -> Correspondences:  # fmt: skip
        numbers = np.array([alone["constant"], alone["evidence"], scored["constant"], scored["tolerance"]])
        out = torch.empty(len(c), c.mask.shape[1] + 1, dtype=torch.float32)
        out = for_each_pair(calibrated_by_score, (evidence, score, c.mask), numbers, out=out)
        prior, probable = out[:, :-1], out[:, -1:]
        if gradient_wanted(evidence, score):
            e, s = torch.where(c.mask, evidence, 0), torch.where(c.mask, score, 0.5).clamp(_MIN_SCORE, 1 - _MIN_SCORE)
            z = scored["constant"] + SCORE_POWER * torch.logit(s)
            prior = _with_gradient(prior, torch.where(probable > 0, z, alone["constant"] + alone["evidence"] * e))
        return c.derived(prior=prior.to(c.x0.dtype))


def _with_gradient(prior: Float[Tensor, "b n"], z: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
    """The prior, attached to its log-odds: adds zeros."""
    slope: Tensor = prior * (1 - prior) / (1 + z.detach() / 2**_SQUARINGS)
    return prior + slope * (z - z.detach())


def calibration_of(
    pruner: str, soft: bool, calibration: Mapping[str, Mapping[str, float]] | None
) -> Calibration | None:
    """The calibration of a stage that is `soft`; None of one that prunes. Raises ValueError where it is missing."""
    if not soft:
        return None
    if calibration is None:
        raise ValueError(f"{pruner} with soft=true needs `calibration`, to supply a prior; it would do nothing")
    return Calibration(**calibration)


class RatioPrior:
    """Supplies ``prior``: P(inlier) from the distance ratio alone. Without `ratio` the prior stays as it is."""

    def __init__(self, *, calibration: Mapping[str, Mapping[str, float]]) -> None:
        self.calibration = Calibration(**calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        return self.calibration(c, self.evidence(c))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """None but the ratio."""
        return torch.zeros_like(c.x0[..., 0])


@dataclasses.dataclass(frozen=True)
class Likely:
    """Keeps the matches whose ``prior``, P(inlier), is at least `min_probability`.
    It makes a filter of any stage that supplies a prior. Raises ValueError for correspondences without a prior."""

    min_probability: float = 0.5

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only likely ones survive; a prior that is NaN fails."""
        if c.prior is None:
            raise ValueError("`likely` needs `prior`: put a stage that supplies it before, e.g. frame_consistency")
        return c.keep(c.prior >= self.min_probability)


# How exact is each match? Noise from the keypoint's size, the distance ratio and the prior

MIN_AREA = 1e-12  # square pixels: keeps the gradient of the scale finite
MIN_PRIOR = 0.02  # matches less likely than that are not taken for noisier


def match_noise(
    lafs0: Float[Tensor, "b n 2 3"], lafs1: Float[Tensor, "b n 2 3"], ratio: Float[Tensor, "b n"] | None = None,
    prior: Float[Tensor, "b n"] | None = None, mask: Bool[Tensor, "b n"] | None = None,
    *, usual: float, radius: float, slope: float,
) -> Float[Tensor, "b n"]:  # fmt: skip
    """Standard deviation of each match's distance to its epipolar line, in units of a usual match's.
    ``(1 + s / radius) (1 + slope ratio)^2 P^(-1/4) / usual`` with s the larger of the two frames' scales in pixels: a
    keypoint is located to a share of its size, and matches that are hard to tell apart, or that their neighbours
    contradict somewhat, are less exact. One where masked, and where a number is not finite. On the CPU."""
    single = lafs0.dtype == torch.float32
    numbers = np.array((usual, radius, slope, MIN_AREA, MIN_PRIOR), np.float32 if single else np.float64)
    tensors, out = (lafs0, lafs1, ratio, prior), torch.empty(lafs0.shape[:2], dtype=lafs0.dtype)
    noise = for_each_pair(_match_noise32 if single else _match_noise64, tensors, numbers, out=out, kind=out.dtype)
    if mask is not None:
        noise = torch.where(mask, noise, 1)
    if not gradient_wanted(lafs0, lafs1, ratio, prior):
        return noise
    mask = torch.ones_like(noise, dtype=torch.bool) if mask is None else mask
    for x in (lafs0, lafs1, ratio, prior):
        mask = mask if x is None else mask & torch.isfinite(x.reshape(*mask.shape, -1)).all(-1)
    (a, b, _, c, d, _), (e, f, _, g, h, _) = (
        torch.where(mask[..., None], lafs.flatten(2), 0).unbind(-1) for lafs in (lafs0, lafs1)
    )
    area = torch.maximum((a * d - b * c).abs(), (e * h - f * g).abs()).clamp_min(MIN_AREA)
    size = sqrt(area.detach())
    logarithm = area / (2 * size * (radius + size))  # its derivative, as those that follow: of the noise's logarithm
    if ratio is not None:
        ratio = torch.where(mask, ratio, 1)
        logarithm = logarithm + 2 * ratio * (slope / (1 + slope * ratio)).detach()
    if prior is not None:
        P = torch.where(mask, prior, 1).clamp_min(MIN_PRIOR)
        logarithm = logarithm - P / (4 * P.detach())
    return noise + torch.where(mask, noise, 0) * (logarithm - logarithm.detach())  # adds zeros


@kernel
def _match_noise32(lafs0: F4x3, lafs1: F4x3, ratio: F4x1, prior: F4x1, numbers: F4x1, out: F4x1) -> None:
    _noise_of_each(lafs0, lafs1, ratio, prior, numbers, out)


@kernel
def _match_noise64(lafs0: F8x3, lafs1: F8x3, ratio: F8x1, prior: F8x1, numbers: F8x1, out: F8x1) -> None:
    _noise_of_each(lafs0, lafs1, ratio, prior, numbers, out)


@inner
def _noise_of_each(lafs0: Array, lafs1: Array, ratio: Array, prior: Array, numbers: Array, out: Array) -> None:
    """`match_noise` of n matches -> out (n,). ratio, prior: (n,), empty where unknown.
    numbers: usual, radius in pixels, slope, least area in square pixels, least prior."""
    usual, radius, slope, min_area, min_prior = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    whole = out.dtype.type(1)
    for i in range(len(out)):
        size = max(_scale(lafs0, i, min_area), _scale(lafs1, i, min_area))
        noise = (whole + size / radius) / usual
        valid = _finite(lafs0, i) and _finite(lafs1, i)
        if len(ratio):
            valid = valid and math.isfinite(ratio[i])
            factor = whole + slope * ratio[i]
            noise *= factor * factor
        if len(prior):
            valid = valid and math.isfinite(prior[i])
            noise /= math.sqrt(math.sqrt(max(prior[i], min_prior)))
        out[i] = noise if valid else whole


@inner
def _scale(lafs: Array, i: int, min_area: Any) -> Any:
    """The square root of the area that frame i maps the unit square to, pixels."""
    return math.sqrt(max(abs(lafs[i, 0, 0] * lafs[i, 1, 1] - lafs[i, 0, 1] * lafs[i, 1, 0]), min_area))


@inner
def _finite(lafs: Array, i: int) -> bool:
    finite = True
    for row in range(2):
        for column in range(3):
            finite = finite and math.isfinite(lafs[i, row, column])
    return finite


@dataclasses.dataclass(frozen=True)
class MatchNoise:
    """Supplies ``noise`` by `match_noise`; matches without frames are left as they are.
    `Ransac` divides each match's residual by it, in its scores (but not that of the median) and in its non-linear fits;
    the 8-point algorithm, the `irls_*` estimators and other libraries do not look at it. Inliers are reported by their
    distance in pixels all the same. usual, radius, slope: see `match_noise`."""

    usual: float
    radius: float
    slope: float

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches with their noise; one where masked or where it cannot be told."""
        lafs0, lafs1 = c.lafs0, c.lafs1
        if lafs0 is None or lafs1 is None:
            return c
        numbers = {"usual": self.usual, "radius": self.radius, "slope": self.slope}
        return c.derived(noise=match_noise(lafs0, lafs1, c.ambiguity, c.prior, c.mask, **numbers))
