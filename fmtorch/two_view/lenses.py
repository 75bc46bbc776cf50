"""Matches of photographs whose lenses are calibrated, as pinholes would have them."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.lenses import MODELS, Lens, Matrix, division, division_lens, folded, lines_of_sight, undistortion
from fmtorch.core.types import MAX_LENS, MIN_LENS, Correspondences, Estimate
from fmtorch.estimators.lens_search import STARTS, TAIL_DEVIATION, TAIL_MEAN
from fmtorch.geometry.arithmetic import component_sum, matmul3, sqrt
from fmtorch.geometry.cameras import calibration_problems, cross_matrix
from fmtorch.geometry.epipolar import mean_stretch
from fmtorch.geometry.pose import pose_from_fundamental

Lenses = tuple[Lens | None, Lens | None]  # of both images of a pair; None of a pinhole
FORMS = "a lens for both images, (lens0, lens1) with None for a pinhole, or a list of (lens0, lens1), one for each pair"
GRID = 9  # points along each side of an image that tell whether a lens folds it
MAX_STRETCH = 100.0  # of a match in both images: 3 degrees from across the axes of fish-eyes


class CalibratedLenses:
    """The lenses of a batch. lens: as of `find_fundamental`. x0: its points. K: of the cameras, None without; of images
    without a lens these may be given. Raises ValueError for other forms, for lenses of another number of pairs, and for
    the parameters of a lens for all pairs."""

    def __init__(self, lens: Any, x0: Any, K0: Any = None, K1: Any = None) -> None:
        pairs = lens if isinstance(lens, list) and isinstance(lens[0], list | tuple) else [lens]
        self.pairs: list[Lenses] = [tuple(pair) if isinstance(pair, list | tuple) else (pair, pair) for pair in pairs]
        entries = [entry for pair in self.pairs for entry in pair]
        if {len(pair) for pair in self.pairs} != {2} or not all(isinstance(each, Lens | None) for each in entries):
            raise ValueError(f"lens holds a calibrated lens, so it must be {FORMS}")
        count = len(x0) if isinstance(x0, list) or getattr(x0, "ndim", 2) == 3 else 1
        if len(self.pairs) not in (1, count):
            raise ValueError(f"lens has lenses for {len(self.pairs)} pairs of {count}; it must be {FORMS}")
        self.K = self._calibration(0, K0), self._calibration(1, K1)
        self.problems = [self._problem(pair) for pair in self.pairs]
        self._expect_valid()

    def _expect_valid(self) -> None:
        if len(self.pairs) == 1 and self.problems[0]:
            raise ValueError(self.problems[0])

    def _calibration(self, k: int, K: Any) -> Any:
        lenses = [pair[k] for pair in self.pairs]
        known = [lens.K for lens in lenses if lens is not None]
        if not known:
            return K
        if K is not None:
            raise ValueError(f"K{k} and a lens of image {k} are given, and the lens has its own K: leave K{k} out")
        if len(known) < len(lenses):
            raise ValueError(f"lens has None for image {k} of some pairs; a pinhole is fmtorch.Lens(fx, fy, cx, cy)")
        return np.stack(known) if len(known) > 1 else known[0]

    @staticmethod
    def _problem(pair: Lenses) -> str:
        """Why a lens of a pair is none; empty where both may be."""
        problems: list[str] = []
        for k, lens in enumerate(pair):
            if lens is not None:
                problems += calibration_problems(torch.from_numpy(lens.K)[None], None, f"K of the lens of image {k}")
                finite = np.isfinite(lens.coefficients).all()
                problems += [] if finite else [f"the lens of image {k} has coefficients that are not finite"]
        return next(filter(None, problems), "")

    def undistorted(self, c: Correspondences) -> Correspondences:
        """The matches as pinholes would have them; none of a pair whose lens is none."""
        of = range(len(self.pairs)) if len(self.pairs) == len(c) else [0] * len(c)
        for k, sizes in enumerate((c.size0, c.size1)):
            for i, (h, w) in zip(of, [] if sizes is None else sizes.tolist(), strict=False):
                self.problems[i] = self.problems[i] or _folded(self.pairs[i][k], k, h, w)
        self._expect_valid()
        valid = torch.tensor([not self.problems[i] for i in of], dtype=torch.bool, device=c.mask.device)
        seen, self.behind = matches_in_sight(c.keep(valid[:, None] & c.mask), [self.pairs[i] for i in of])
        return seen

    def in_view(self, seen: Correspondences) -> Correspondences:
        """The undistorted matches that tell the type of a pair: those that are not far off in pinholes' images."""
        return seen if seen.stretch is None else seen.keep(mean_stretch(seen.stretch.detach(), sqrt) < MAX_STRETCH)

    def completed(self, estimate: Estimate, c: Correspondences, seen: Correspondences) -> Estimate:
        """The estimate of undistorted matches `seen`, with the pose of what was seen beyond 90 degrees of an axis, too,
        and with the reasons why it has none of c."""
        turned = (self.behind.any(-1) & estimate.inliers).any(1)
        if estimate.R is not None and all(K is not None for K in self.K) and bool(turned.any()):
            estimate = self._in_front(estimate, seen, turned)
        reasons, counts = list(estimate.reason), zip(c.count().tolist(), seen.count().tolist(), strict=True)
        for i, (before, after) in enumerate(counts):
            if 2 * after < before and not estimate.ok[i]:
                unseen = f"pinholes see {after} of {before} matches: the lens folds there"
                reasons[i] = self.problems[i if len(self.pairs) > 1 else 0] or unseen
        return estimate.derived(reason=tuple(reasons))

    def _in_front(self, estimate: Estimate, seen: Correspondences, turned: Bool[Tensor, " b"]) -> Estimate:
        """With the poses in front of which the inliers of these pairs lie; without a covariance of other rotations."""
        R, t = cast(Tensor, estimate.R), cast(Tensor, estimate.t)
        K0, K1 = (torch.as_tensor(K).to(estimate.F).expand(len(R), 3, 3) for K in self.K)
        pose = pose_from_fundamental(estimate.F, K0, K1, seen.x0, seen.x1, estimate.inliers, behind=self.behind)
        other = (component_sum((R * pose.R).flatten(1), 1) < 3 - 1e-6) & pose.valid & turned  # by 0.06 degrees
        opposite = (component_sum(t * pose.t, 1) < 0) & pose.valid & turned
        R, t = torch.where(other[:, None, None], pose.R, R), torch.where((other | opposite)[:, None], pose.t, t)
        fields = {}
        if estimate.covariance is not None and estimate.tangents is not None:
            fields["covariance"] = torch.where(other[:, None, None], torch.nan, estimate.covariance)
            fields["tangents"] = torch.where(opposite[:, None, None], -1, 1) * estimate.tangents
        return estimate.derived(R=R, t=t, E=matmul3(cross_matrix(t), R), **fields)


@functools.lru_cache(maxsize=256)
def _folded(lens: Lens | None, k: int, h: float, w: float) -> str:
    """What is wrong with a lens of image k, of size (h, w), other than a fish-eye, which may see less than it."""
    if lens is None or not lens.bends or MODELS[lens.model].fisheye or MODELS[lens.model].rays is not None:
        return ""
    cells = (np.arange(GRID) + 0.5) / GRID
    pixels = np.stack(np.meshgrid(cells * w - 0.5, cells * h - 0.5), -1)
    said = folded(lens, pixels.reshape(-1, 2))
    return said and f"image {k}: {said}"


def undistorted_matches(c: Correspondences, lenses: Sequence[Lenses]) -> Correspondences:
    """The matches of a batch as pinholes of the same K would have them; one that a pinhole does not see is masked."""
    seen, behind = matches_in_sight(c, lenses)
    return seen.derived(mask=seen.mask & ~behind.any(-1))


def matches_in_sight(c: Correspondences, lenses: Sequence[Lenses]) -> tuple[Correspondences, Bool[Tensor, "b n 2"]]:
    """The same with what is beyond 90 degrees of an axis, where the line of sight meets a pinhole's image behind the
    camera; and whether a match is there, for both images.

    lenses: of each pair. A match's noise grows as its points are stretched, so that its distances count in pixels of
    the photographs: by the root of the determinant of the derivatives of its points, in the geometric mean over both
    images, until F tells in which direction (`stretch`). Gradients reach the photographs' points."""
    fields, seen = dict[str, Tensor](), np.ones(c.mask.shape, np.bool_)
    behind = np.zeros((*c.mask.shape, 2), np.bool_)
    stretch = np.broadcast_to(np.eye(2), (*c.mask.shape, 2, 2, 2)).copy()
    for k, (points, lafs) in enumerate(((c.x0, c.lafs0), (c.x1, c.lafs1))):
        x = points.detach().cpu().numpy().astype(np.float64)  # a copy
        J, bends = stretch[:, :, k], False
        for i, pair in enumerate(lenses):
            if (lens := pair[k]) is not None and lens.bends:
                with np.errstate(all="ignore"):
                    x[i], behind[i, :, k] = lines_of_sight(lens, x[i])
                    J[i], bends = undistortion(lens, x[i], behind[i, :, k]), True
                valid = np.isfinite(x[i]).all(-1) & np.isfinite(J[i]).all((-2, -1))
                x[i, ~valid], J[i, ~valid], seen[i] = 0, 0, seen[i] & valid
        if not bends:
            continue
        there, slope = torch.from_numpy(x).to(points), torch.from_numpy(J).to(points)
        if points.requires_grad:
            step = torch.where((slope != 0).any(-1).any(-1)[..., None], points - points.detach(), 0)
            there = there + (slope @ step[..., None])[..., 0]
        fields[f"x{k}"] = there
        if lafs is not None:
            fields[f"lafs{k}"] = torch.cat([slope.to(lafs) @ lafs[..., :2], there.detach().to(lafs)[..., None]], -1)
    turned = torch.from_numpy(behind).to(c.mask.device)
    if not fields:
        return c, turned
    return with_stretch(c.derived(**fields), stretch, seen), turned


def with_stretch(c: Correspondences, stretch: Matrix, seen: NDArray[np.bool_]) -> Correspondences:
    """Matches of undistorted points with their derivatives (b, n, 2, 2, 2) by the photographs', and their noise. seen:
    (b, n), whether a pinhole sees a match."""
    mean, derivatives = mean_stretch(stretch), torch.from_numpy(stretch).to(c.x0)
    noise = torch.from_numpy(np.where(seen & (mean > 0), mean, 1)).to(c.x0)
    if c.stretch is not None:  # of noise with a direction
        derivatives = derivatives @ c.stretch.to(c.x0)
        noise = mean_stretch(derivatives, sqrt) / mean_stretch(c.stretch.to(c.x0), sqrt)
    return c.derived(
        mask=c.mask & torch.from_numpy(seen).to(c.mask.device), stretch=derivatives,
        noise=noise if c.noise is None else c.noise * noise,
    )  # fmt: skip


# Homographies of photographs whose lenses are of the division model, with known or unknown lambdas

MIN_FIT = 12  # inliers; a lens with fewer stays straight
CAUCHY: dict[str, Any] = {"loss": "cauchy", "f_scale": 2**0.5, "x_scale": "jac", "max_nfev": 30}
EXACT = 1e-9  # half diagonals: noise of matches without any
UNKNOWN = "of find_homography it must be a calibrated lens, lambda (exactly known), 'shared' or 'unknown'"


def homographies_with_lenses(c: Correspondences, find: Callable[[Correspondences], Estimate]) -> Estimate:
    """Homographies of pinholes, with `lens`. c: with sizes and lens. find: homographies of matches without lenses.
    Unknown lambdas are those of a fit to the inliers of a few estimates, and zero unless that has greater evidence."""
    assert c.lens is not None
    mean, deviation = c.lens.detach().double().unbind(-1)
    if bool((deviation == 0).all()):
        return find(_straight(c, mean)).derived(lens=mean)
    if not bool(deviation.isinf().all()):
        raise ValueError(f"lens is {c.lens.tolist()}; {UNKNOWN}")
    if c.requires_grad:
        raise ValueError("lens is given, and its estimates have no gradients: give points, prior, noise detached")
    starts, lens = [mean.new_tensor(start).expand_as(mean) for start in STARTS], torch.zeros_like(mean)
    estimates = [find(_straight(c, start)) for start in starts]
    inliers = torch.stack([each.inliers for each in estimates]).any(0)
    for i in (inliers.sum(1) >= MIN_FIT).nonzero()[:, 0].tolist():
        tried = zip(estimates, starts, strict=True)
        models = [torch.cat([e.matrix[i].flatten(), start[i].to(e.matrix)]) for e, start in tried if e.ok[i]]
        matches = c[i].derived(mask=inliers[i : i + 1])
        lens[i] = torch.from_numpy(_fitted_lenses(matches, torch.stack(models).double().cpu().numpy()))
    estimate = find(_straight(c, lens))
    return estimate.derived(lens=torch.where(estimate.ok[:, None], lens, torch.nan))


def _straight(c: Correspondences, lens: Tensor) -> Correspondences:
    """The matches, with nothing else, without lenses of these lambdas (b, 2)."""
    rows = zip(lens.tolist(), *(cast(Tensor, size).tolist() for size in (c.size0, c.size1)), strict=True)
    pairs = [(division_lens(values[0], size0), division_lens(values[1], size1)) for values, size0, size1 in rows]
    return undistorted_matches(c.derived(lens=None, shared_lens=None, size0=None, size1=None), pairs)


def _fitted_lenses(c: Correspondences, models: Matrix) -> Matrix:
    """The lambdas (2,) of a pair (a batch of one) with matches of a plane. models: (k, 11), homographies of pinholes,
    px, with lambdas. Parameters of a fit are eight entries of a homography whose last is one, between points in half
    diagonals from the centres, and lambdas: none, of both images, or of each."""
    import scipy.optimize  # which takes longer to import than the rest of this file

    K0, K1 = (division_lens(0.0, cast(Tensor, size)[0].tolist()).K for size in (c.size0, c.size1))
    pixels = (x[c.mask].double().cpu().numpy() for x in (c.x0, c.x1))
    x0, x1 = ((x - K[:2, 2]) / K[0, 0] for x, K in zip(pixels, (K0, K1), strict=True))
    count = 1 if c.shared_lens is not None and bool(c.shared_lens[0]) else 2

    def residuals(parameters: Matrix) -> Any:  # in image 1, (2 n,), at most one
        lens0, lens1 = np.broadcast_to(parameters[8:] if len(parameters) > 8 else 0.0, 2).clip(MIN_LENS, MAX_LENS)
        with np.errstate(all="ignore"):
            h = np.c_[x0, 1 + lens0 * (x0**2).sum(1)] @ np.append(parameters[:8], 1.0).reshape(3, 3).T
            u, v, w = h.T / h[:, 2]
            there = np.stack(division(u, v, w, lens1), -1)
        return np.nan_to_num(there - x1, nan=1.0).clip(-1, 1).ravel()

    def noise(parameters: Matrix) -> float:  # of a fit
        r = residuals(parameters)
        return float(1.4826 * np.median(np.abs(r)) * (len(r) / (len(r) - len(parameters))) ** 0.5) + EXACT

    def fit(start: Matrix, noise: float) -> Any:  # its cost: negative logarithm of the likelihood; J^T J: its Hessian
        return scipy.optimize.least_squares(lambda x: residuals(x) / noise, start, **CAUCHY)

    starts = []
    for model in models:
        H = np.linalg.inv(K1) @ model[:9].reshape(3, 3) @ K0
        starts.append(np.append(H.ravel()[:8] / (H[2, 2] or EXACT), model[9 : 9 + count]))
    start = min(starts, key=noise)
    start = fit(start, noise(start)).x
    bent = fit(start, noise(start))
    straight = min((fit(each[:8], noise(start)) for each in (starts[0], start)), key=lambda fit: fit.cost)
    A, lens = bent.jac.T @ bent.jac + np.diag([0.0] * 8 + [TAIL_DEVIATION**-2] * count), bent.x[8:]
    volume = np.linalg.slogdet(A)[1] - np.linalg.slogdet(A[:8, :8])[1] + 2 * count * np.log(TAIL_DEVIATION)
    evidence = straight.cost - bent.cost - ((lens - TAIL_MEAN) ** 2).sum() / TAIL_DEVIATION**2 / 2 - volume / 2
    return np.broadcast_to(lens.clip(MIN_LENS, MAX_LENS) if evidence > 0 else 0.0, 2).copy()
