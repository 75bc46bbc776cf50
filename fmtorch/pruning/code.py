"""CODE, coherence-based decision boundaries (Lin et al., TPAMI 2018): two robust regressions over the match domain.

The domain is where a match is, where it goes and how its frame changes."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.geometry.levenberg_marquardt import huber_weight
from fmtorch.pruning.consistency import frame_map

Frames = Float[Tensor, "n 2 3"]
BLOCK = 4096  # matches whose basis functions exist at a time
LARGEST_CHANGE = 100.0  # of a frame's size between images of a common scale: what is beyond is no match


class MatchDomain(NamedTuple):
    """The N matches of one pair, in coordinates of zero mean and unit mean square in each image.
    S is the linear map from frame 0 to frame 1; shape its entries scaled to Frobenius norm sqrt(2), which for a
    similarity are the cosine and the sine of its rotation, and the logarithm of the factor taken out."""

    p0: Float[Tensor, "n 2"]
    p1: Float[Tensor, "n 2"]
    S: Float[Tensor, "n 2 2"]
    shape: Float[Tensor, "n 5"]

    def take(self, index: Int[Tensor, " m"]) -> "MatchDomain":
        """The matches at `index`."""
        return MatchDomain(*(value[index] for value in self))

    def blocks(self) -> "list[MatchDomain]":
        """The matches in their order, at most BLOCK at a time."""
        return [MatchDomain(*part) for part in zip(*(torch.split(value, BLOCK) for value in self), strict=True)]


def match_domain(
    x0: Float[Tensor, "n 2"], x1: Float[Tensor, "n 2"], lafs0: Frames | None, lafs1: Frames | None
) -> MatchDomain:
    """The domain of the matches, float32; without frames S is the identity."""
    p0, spread0 = _normalized(x0)
    p1, spread1 = _normalized(x1)
    if lafs0 is None or lafs1 is None:
        S = torch.eye(2, dtype=torch.float64, device=x0.device).expand(len(x0), 2, 2)
    else:
        S = frame_map(lafs0[None].double(), lafs1[None].double())[0] * (spread0 / spread1)
    size = S.square().sum((1, 2)).sqrt().clamp_min(torch.finfo(torch.float32).tiny) / math.sqrt(2)
    entries = S / size[:, None, None]
    bounded = S * (size.clamp(1 / LARGEST_CHANGE, LARGEST_CHANGE) / size)[:, None, None]
    shape = torch.cat([entries.flatten(1), torch.log(size)[:, None]], 1)
    return MatchDomain(p0.float(), p1.float(), bounded.float(), shape.float())


def finite_matches(*values: Tensor | None) -> Bool[Tensor, "b n"]:
    """True where every value of a match, (B, N, ...), is finite and no frame (B, N, 2, 3) is degenerate."""
    given = [value for value in values if value is not None]
    mask = torch.stack([torch.isfinite(v.flatten(2)).all(-1) for v in given]).all(0)
    for frame in (v for v in given if v.dim() == 4):
        (a, b), (c, d) = (row.unbind(-1) for row in frame[..., :2].double().unbind(-2))
        mask = mask & ((a * d - b * c) != 0)
    return mask


def _normalized(x: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, ""]]:
    """Points with zero mean and unit mean square, and the root mean square taken out, 1 where all points are equal."""
    centred = x.double() - x.double().mean(0)
    spread = centred.square().mean().sqrt()
    spread = torch.where(spread > 0, spread, 1.0)
    return centred / spread, spread


def gaussians(z: Float[Tensor, "n d"], centres: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """``exp(-|z_j - c_m|^2 / 2)``."""
    return _exponent(z, centres).clamp_(max=0).exp_()


def predictive_gaussians(
    matches: MatchDomain, centres: MatchDomain, *, position: float, displacement: float, rotation: float, scale: float
) -> Float[Tensor, "n m"]:
    """Gaussians over position, displacement and shape, where each centre's frame predicts the displacement.
    With differences from centre m to match j, ``exp(-(|dp0|^2 / position^2 + |dp1 - S_m dp0|^2 / displacement^2 + |d
    entries|^2 / rotation^2 + |d log size|^2 / scale^2) / 2)``: the widths, in units of the normalised coordinates."""
    width = torch.tensor([position] * 2 + [rotation] * 4 + [scale], device=matches.p0.device)
    z, c = (torch.cat([part.p0, part.shape], 1) / width for part in (matches, centres))
    exponent = _exponent(z, c)
    x, y = centres.p0.unbind(1)
    homogeneous = torch.cat([matches.p0, torch.ones_like(matches.p0[:, :1])], 1)
    for axis in (0, 1):  # p1_j - p1_m - S_m (p0_j - p0_m) is linear in (p0_j, 1) for each centre
        to_x, to_y = centres.S[:, axis].unbind(1)
        predicted = homogeneous @ torch.stack([to_x, to_y, centres.p1[:, axis] - to_x * x - to_y * y])
        exponent -= (predicted - matches.p1[:, axis : axis + 1]).div_(displacement).square_().div_(2)
    return exponent.clamp_(max=0).exp_()


def _exponent(z: Float[Tensor, "n d"], centres: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """``-|z_j - c_m|^2 / 2``, up to rounding."""
    exponent = z @ centres.T
    exponent -= z.square().sum(1, keepdim=True) / 2
    exponent -= centres.square().sum(1) / 2
    return exponent


def spread_centres(kernel: Float[Tensor, "n n"], count: int) -> Int[Tensor, " m"]:
    """Indices of at most `count` of the points, crowded places first, none near another; the first of equals.
    kernel (i, j): what the Gaussian at j gives at i. Each centre is the point with the largest uncovered support: the
    sum of its Gaussian over all points, times one minus the largest Gaussian of earlier centres at it."""
    support = kernel.sum(0)
    uncovered = torch.ones_like(support)
    by_centre = kernel.T.contiguous()
    chosen: list[Tensor] = []
    for _ in range(min(count, len(kernel))):
        chosen.append(best := (support * uncovered).argmax())
        uncovered = torch.minimum(uncovered, 1 - by_centre[best])
    return torch.stack(chosen) if chosen else torch.zeros(0, dtype=torch.int64, device=kernel.device)


def evenly(index: Int[Tensor, " n"], count: int) -> Int[Tensor, " m"]:
    """At most `count` of the indices, evenly along their order."""
    return index if len(index) <= count else index[torch.arange(count, device=index.device) * len(index) // count]


def huber_regression(
    basis: Float[Tensor, "n m"], target: Float[Tensor, "n k"], ridge: Float[Tensor, "m m"], *, scale: float,
    iterations: int,
) -> Float[Tensor, "m k"]:  # fmt: skip
    """The coefficients C (m, k) that minimise ``sum_j huber(|target_j - basis_j C|) + tr(C^T ridge C)``.
    Huber's loss is quadratic up to `scale` and linear beyond; a row of the target counts by its length. Starts from C =
    0. Each iteration weights the rows by their residuals and solves the normal equations, which are summed in the type
    of the basis and solved in float64 by Cholesky's decomposition; `ridge` (positive definite) keeps them regular."""
    coefficients = basis.new_zeros(basis.shape[1], target.shape[1])
    scale2 = basis.new_tensor(scale * scale)
    for _ in range(iterations):
        residual = target - basis @ coefficients
        weighted = (basis * huber_weight(residual.square().sum(1), scale2)[:, None]).T
        factor = torch.linalg.cholesky_ex((weighted @ basis).double() + ridge.double()).L
        coefficients = torch.cholesky_solve((weighted @ target).double(), factor).to(basis.dtype)
    return coefficients


@dataclasses.dataclass(frozen=True)
class LikelihoodField:
    """A function of the match domain that is near 1 where distinctive matches are coherent and near 0 elsewhere.

    ``f = sum_m w_m g(., c_m)`` minimises ``mean_j huber(1 - f(z_j)) + ridge |w|^2`` over the distinctive matches j: all
    are asked to have likelihood 1, but beyond `huber` each pulls with a bounded force, so one alone lifts f by little
    (huber / ridge / their number) while many that agree saturate it at 1.

    ratio, least_seeds, most_seeds: matches below the distance ratio are distinctive; where those are fewer than
    least_seeds, so many of the lowest ratio; where they are more than most_seeds, so many of them, evenly.
    candidates, centres: at most so many seeds are looked at for centres, and so many centres are chosen.
    position, displacement, rotation, scale: widths of the Gaussians, see `predictive_gaussians`; unframed_displacement
    replaces the second where matches have no frames to predict it by."""

    ratio: float = 0.8
    least_seeds: int = 200
    most_seeds: int = 4000
    candidates: int = 1500
    centres: int = 300
    position: float = 0.5
    displacement: float = 0.07
    unframed_displacement: float = 0.2
    rotation: float = 0.8
    scale: float = 0.5
    ridge: float = 0.0075
    huber: float = 0.1
    iterations: int = 6

    def __call__(
        self, matches: MatchDomain, ratio: Float[Tensor, " n"] | None, *, framed: bool = True
    ) -> Float[Tensor, " n"]:
        """The likelihood of every match; without `ratio` every match is distinctive. framed: S is known."""
        seeds = evenly(self.distinctive(matches, ratio), self.most_seeds)
        candidates = matches.take(evenly(seeds, self.candidates))
        centres = candidates.take(spread_centres(self._basis(candidates, candidates, framed), self.centres))
        basis = self._basis(matches.take(seeds), centres, framed)
        ridge = self.ridge * len(seeds) * torch.eye(basis.shape[1], device=basis.device)
        target = torch.ones_like(basis[:, :1])
        weights = huber_regression(basis, target, ridge, scale=self.huber, iterations=self.iterations)
        return torch.cat([self._basis(block, centres, framed) @ weights for block in matches.blocks()])[:, 0]

    def distinctive(self, matches: MatchDomain, ratio: Float[Tensor, " n"] | None) -> Int[Tensor, " s"]:
        """Indices of the distinctive matches, in order; NaN is not distinctive unless nothing is."""
        if ratio is None:
            return torch.arange(len(matches.p0), device=matches.p0.device)
        seeds = (ratio < self.ratio).nonzero()[:, 0]
        if len(seeds) >= self.least_seeds:
            return seeds
        return ratio.argsort(stable=True)[: self.least_seeds].sort().values

    def _basis(self, matches: MatchDomain, centres: MatchDomain, framed: bool) -> Float[Tensor, "n m"]:
        displacement = self.displacement if framed else self.unframed_displacement
        widths = {"position": self.position, "rotation": self.rotation, "scale": self.scale}
        return predictive_gaussians(matches, centres, displacement=displacement, **widths)


_FREE = 1e-3  # the common affine motion's share of the ridge
MIN_MATCHES = 8  # likely matches without which there is no motion


@dataclasses.dataclass(frozen=True)
class SmoothMotion:
    """The displacement as one affine motion plus, around each of some centres, an affine motion that fades away.
    ``d(z) = A [p0, 1] + sum_m g(z, c_m) A_m [(p0 - c_m) / position, 1]`` minimises ``sum_j huber(|d_j - d(z_j)|) +
    ridge sum |A_m|^2`` over the likely matches j. The Gaussians g are over position and, widely, over displacement, so
    that neighbouring surfaces may move differently.
    most_matches: so many likely matches take part, evenly. candidates, centres: as in the likelihood. position,
    displacement: widths; huber: in the same units, those of the normalised coordinates."""

    most_matches: int = 4000
    candidates: int = 1000
    centres: int = 64
    position: float = 0.5
    displacement: float = 0.7
    ridge: float = 0.5
    huber: float = 0.02
    iterations: int = 5

    def __call__(self, matches: MatchDomain, likely: Bool[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Distance of every match's partner from where the motion puts it; infinite where too few are likely."""
        members = likely.nonzero()[:, 0]
        if len(members) < MIN_MATCHES:
            return torch.full_like(matches.p0[:, 0], math.inf)
        fitted = matches.take(evenly(members, self.most_matches))
        candidates = evenly(torch.arange(len(fitted.p0), device=fitted.p0.device), self.candidates)
        z = self._domain(fitted)[candidates]
        centres = fitted.take(candidates[spread_centres(gaussians(z, z), self.centres)])
        basis = self._basis(fitted, centres)
        penalty = torch.full_like(basis[0], self.ridge)
        penalty[:3] *= _FREE
        motion = huber_regression(
            basis, fitted.p1 - fitted.p0, torch.diag(penalty), scale=self.huber, iterations=self.iterations
        )
        residuals = [
            (block.p1 - block.p0 - self._basis(block, centres) @ motion).square().sum(1).sqrt()
            for block in matches.blocks()
        ]
        return torch.cat(residuals)

    def _domain(self, matches: MatchDomain) -> Float[Tensor, "n 4"]:
        return torch.cat([matches.p0 / self.position, (matches.p1 - matches.p0) / self.displacement], 1)

    def _basis(self, matches: MatchDomain, centres: MatchDomain) -> Float[Tensor, "n k"]:
        g = gaussians(self._domain(matches), self._domain(centres))
        dx, dy = ((matches.p0[:, None, i] - centres.p0[None, :, i]) / self.position for i in (0, 1))
        return torch.cat([torch.ones_like(g[:, :1]), matches.p0, g, g * dx, g * dy], 1)


MIN_LIKELIHOOD, LARGEST_RESIDUAL = 0.5, 0.06


class Coherence(NamedTuple):
    """How coherent each match is.
    likelihood: near 1 for a match that agrees with many distinctive ones, near 0 or below otherwise. residual: distance
    of its partner from the smooth motion of the likely matches, in units of the root mean square coordinate in image 1;
    infinite where there is no motion. Zero and infinite for what is no match."""

    likelihood: Float[Tensor, "b n"]
    residual: Float[Tensor, "b n"]


@torch.no_grad()
def coherence(
    x0: Float[Tensor, "b n 2"], x1: Float[Tensor, "b n 2"],
    *, mask: Bool[Tensor, "b n"] | None = None, ratio: Float[Tensor, "b n"] | None = None,
    lafs0: Float[Tensor, "b n 2 3"] | None = None, lafs1: Float[Tensor, "b n 2 3"] | None = None,
    least_likelihood: float = MIN_LIKELIHOOD, likelihood: LikelihoodField | None = None,
    motion: SmoothMotion | None = None,
) -> Coherence:  # fmt: skip
    """The likelihood of each match and its distance from the smooth motion of those above `least_likelihood`.
    Two robust regressions on radial basis functions, as in CODE; our form differs from the authors' in that the centres
    are chosen where distinctive matches crowd, and that each predicts its neighbours' displacement by its frame. Points
    in pixels or any unit; `ratio` is the distance ratio. Matches that are not finite or have a degenerate frame are
    none. Every pair is computed from its own matches alone; memory is linear in their number. Not differentiable."""
    finite = finite_matches(x0, x1, lafs0, lafs1)
    mask = finite if mask is None else finite & mask
    likelihood, motion = likelihood or LikelihoodField(), motion or SmoothMotion()
    result = Coherence(torch.zeros(mask.shape, device=x0.device), torch.full(mask.shape, math.inf, device=x0.device))
    for pair, here in enumerate(mask):
        if not bool(here.any()):
            continue
        ratios, frames0, frames1 = (None if v is None else v[pair][here] for v in (ratio, lafs0, lafs1))
        matches = match_domain(x0[pair][here], x1[pair][here], frames0, frames1)
        framed = frames0 is not None and frames1 is not None
        result.likelihood[pair, here] = f = likelihood(matches, ratios, framed=framed)
        result.residual[pair, here] = motion(matches, f > least_likelihood)
    return result


class CODE:
    """Keeps matches that are likely and follow the smooth motion of the likely ones, and supplies ``prior``: P(inlier).
    See `coherence`. The odds are ``odds (max(likelihood, 0) + floor)^3 / (1 + (residual / reach)^2)``. soft: True keeps
    every match and gives the prior only. likelihood, motion: options of `LikelihoodField` and `SmoothMotion`."""

    def __init__(
        self, *, odds: float, floor: float, reach: float, least_likelihood: float = MIN_LIKELIHOOD,
        largest_residual: float = LARGEST_RESIDUAL, soft: bool = False, likelihood: Mapping[str, Any] | None = None,
        motion: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        self.odds, self.floor, self.reach, self.soft = odds, floor, reach, soft
        self.least_likelihood, self.largest_residual = least_likelihood, largest_residual
        self.likelihood, self.motion = LikelihoodField(**(likelihood or {})), SmoothMotion(**(motion or {}))

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only the coherent ones survive, with a prior."""
        result = coherence(
            c.x0, c.x1, mask=c.mask, ratio=c.ambiguity, lafs0=c.lafs0, lafs1=c.lafs1,
            least_likelihood=self.least_likelihood, likelihood=self.likelihood, motion=self.motion,
        )  # fmt: skip
        evidence = result.likelihood.clamp_min(0) + self.floor
        odds = self.odds * evidence * evidence * evidence / (1 + (result.residual / self.reach).square())
        c = c.replace(prior=(odds / (1 + odds)).to(c.x0.dtype))
        if self.soft:
            return c
        return c.keep((result.likelihood > self.least_likelihood) & (result.residual < self.largest_residual))
