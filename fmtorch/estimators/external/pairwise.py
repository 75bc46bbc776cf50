"""Any function of one pair's matches as an estimator of batches, and what the functions of this folder share."""

import dataclasses
import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core import Correspondences, Estimate, Within, lazy
from fmtorch.estimators.batch import Batch, relative_rounding
from fmtorch.estimators.preselection import degenerate_support
from fmtorch.geometry.epipolar import sampson
from fmtorch.geometry.significance import judged

Points = NDArray[np.float64]
Builder = TypeVar("Builder", bound=Callable[..., Any])

MIN_MATCHES = 8
MINIMAL_SAMPLES = {"fundamental": 7, "homography": 4}  # inliers below which a model is none
FAILURES = (cv2.error, RuntimeError, ValueError, TypeError)  # how these libraries say that they cannot solve a pair


class Solution(NamedTuple):
    """What a library says of a pair: a model F (3, 3), px, None where there is none, and its inliers (n,).
    Of pairs whose cameras are asked for also focals (2,), px, NaN where unknown, and R, t: X1 = R X0 + t, None where
    the pose is to be taken from F."""

    F: Points | None
    inliers: NDArray[np.bool_]
    focals: Points | None = None
    R: Points | None = None
    t: Points | None = None


@dataclasses.dataclass(frozen=True)
class PixelPair:
    """A pair's matches as these libraries take them: x0, x1 (N, 2) in pixels, likelihood (N,), sizes (h, w).
    likelihood: the prior where there is one, else 1 - ambiguity, else 1; matches are in its descending order if asked.
    calibrations: where cameras are asked for, K0 and K1 (3, 3), None for an unknown focal length; calibrated: whether
    both are exact; shared_focal: whether both unknown focal lengths are one."""

    x0: Points
    x1: Points
    likelihood: NDArray[np.float64]
    size0: tuple[int, int]
    size1: tuple[int, int]
    seed: int
    calibrations: tuple[Points | None, Points | None] | None = None
    calibrated: bool = False
    shared_focal: bool = False

    @property
    def exact(self) -> tuple[Points, Points] | None:
        """K0 and K1 where both are exactly known."""
        K0, K1 = self.calibrations or (None, None)
        return (K0, K1) if self.calibrated and K0 is not None and K1 is not None else None

    @property
    def joined(self) -> Points:
        """x0, y0, x1, y1 a row."""
        return np.ascontiguousarray(np.hstack([self.x0, self.x1]))


class PairwiseEstimator:
    """Runs a function of a `PixelPair` -> (F or None, inliers) on each pair's matches, best first if asked.

    Args:
        name: what it is called in reasons.
        solve: the function; what it raises of `FAILURES` becomes the pair's reason.
        best_first: order the matches by likelihood.
        model: of what the matrices are, fundamental or homography.
    """

    def __init__(
        self,
        name: str,
        solve: Callable[[PixelPair], tuple[Any, ...]],
        best_first: bool = False,
        model: str = "fundamental",
    ) -> None:
        self.name, self.model, self._solve, self._best_first = name, model, solve, best_first

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate each pair in turn; a pair without a solution is `ok=False` with a reason.
        Raises ValueError where somebody asks for gradients, which no other library gives."""
        if c.requires_grad:
            raise ValueError(
                f"{self.name} passes no gradient on: give it matches that need none (`x0.detach()`), or take an "
                "estimator of this project"
            )
        b, n = c.mask.shape
        batch = Batch.of(c.to("cpu"))
        solved = [self._solved(c, batch, i, seed) for i in range(b)]
        reasons = tuple(each if isinstance(each, str) else "" for each in solved)
        solutions = [None if isinstance(each, str) else each for each in solved]
        F, inliers = torch.zeros(b, 3, 3, dtype=torch.float64), torch.zeros(b, n, dtype=torch.bool)
        for i, solution in enumerate(solutions):
            if solution is not None and solution.F is not None:
                F[i] = torch.from_numpy(solution.F / np.linalg.norm(solution.F))
                inliers[i] = torch.from_numpy(solution.inliers)
        ok = torch.tensor([not reason for reason in reasons], dtype=torch.bool)
        draws = torch.zeros(b, dtype=torch.int64)  # not reported by these libraries
        estimate = Estimate(F, inliers, ok, reasons, draws, model=self.model, **_estimated_cameras(solutions))
        return judged(estimate.to(c.mask.device), c)

    def _solved(self, c: Correspondences, batch: Batch, i: int, seed: int) -> Solution | str:
        """The solution of pair i with the inliers of all its slots, or why it has none."""
        matches = batch.pair(i)
        normalized = batch.normalized(matches, i, seed, MIN_MATCHES)
        if isinstance(normalized, str):
            return normalized
        pair, slot = normalized
        value = torch.ones(c.mask.shape[1]) if c.ambiguity is None else 1 - c.ambiguity[i]
        likelihood = (value if c.prior is None else c.prior[i]).detach().cpu().double()[slot].numpy()
        order = np.argsort(-likelihood, kind="stable") if self._best_first else np.arange(len(slot))
        x0, x1 = matches.x0[slot[order]], matches.x1[slot[order]]
        sizes = _size(c.size0, x0, i), _size(c.size1, x1, i)
        given = _with_cameras(PixelPair(x0, x1, likelihood[order], *sizes, seed), batch, i)
        inside, inliers = np.zeros(len(slot), np.bool_), np.zeros(c.mask.shape[1], np.bool_)
        try:
            solution = Solution(*self._solve(given))
            inside[order] = solution.inliers
        except FAILURES as failure:  # OpenCV's USAC asserts what some matches do not fulfil
            return f"{self.name} failed: {_said(failure)}"
        F = solution.F
        if F is None or F.shape != (3, 3) or not np.isfinite(F).all() or not np.any(F):
            return f"{self.name} found no {self.model}{' matrix' * (self.model == 'fundamental')}"
        inliers[slot[inside]] = True
        reason = degenerate_support(pair, inside, MINIMAL_SAMPLES[self.model], relative_rounding(c))
        return reason or solution._replace(inliers=inliers)


def _with_cameras(pair: PixelPair, batch: Batch, i: int) -> PixelPair:
    """The pair with what is known of its cameras, where they are asked for."""
    if batch.focal is None or batch.sizes.shape[1] == 0:
        return pair
    ends = zip(batch.focal[i], batch.sizes[i].reshape(2, 2), strict=True)
    K0, K1 = (
        np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]]) if deviation < np.inf else None
        for (f, deviation), (h, w) in ends
    )
    shared, exact = bool(batch.shared[i]), batch.calibrated(i)
    return dataclasses.replace(pair, calibrations=(K0, K1), calibrated=exact, shared_focal=shared)


def _estimated_cameras(solutions: list[Solution | None]) -> dict[str, torch.Tensor]:
    """Focal lengths and poses where some were estimated, NaN for those of other pairs; t of unit length."""
    fields = {}
    for name, shape in (("focals", (2,)), ("R", (3, 3)), ("t", (3,))):
        own = [None if each is None else getattr(each, name) for each in solutions]
        if any(value is not None for value in own):
            fields[name] = torch.from_numpy(np.stack([np.full(shape, np.nan) if v is None else v for v in own]))
    if "t" in fields:
        fields["t"] = fields["t"] / fields["t"].norm(dim=-1, keepdim=True)
    return fields


def _said(failure: Exception) -> str:
    """What a library says, in one line; of arguments that a binding cannot convert it lists pages."""
    if isinstance(failure, TypeError):
        return "its binding takes no such sizes or options; whole numbers must be below 2^31"
    return " ".join(str(failure).split())


Iterations = Annotated[int, Within(1, 2**31 - 1)]
Confidence = Annotated[float, Within(0, 1)]


def computed_by(package: str) -> Callable[[Builder], Builder]:
    """A decorator: the function builds estimators whose results depend on the version of `package`, not here alone."""

    def named(builder: Builder) -> Builder:
        builder.peer_package = package  # type: ignore[attr-defined]  # which identities of results read
        return builder

    return named


def peer(module: str, name: str, extra: str = "peers") -> Any:
    """The module of a library of an extra. Raises ImportError with a hint where it is not installed."""
    return lazy.imported(module, f"{name} ({module}) is not installed: pip install 'fmtorch[{extra}]'")


def solution(F: Any, inliers: Any) -> Solution:
    """What a binding returns, as arrays."""
    F = None if F is None else np.asarray(F, dtype=np.float64)
    return Solution(F, np.asarray(inliers, dtype=np.bool_).ravel())


def without(pair: PixelPair) -> Solution:
    """No model, and no inliers."""
    return Solution(None, np.zeros(len(pair.x0), np.bool_))


def posed(
    K: tuple[Points, Points], R: Any, t: Any, inliers: Any, E: Any = None, focals: Points | None = None
) -> Solution:
    """A relative pose with F of its cameras, by E where a library gives another one than that of the pose."""
    R, t = np.asarray(R, np.float64), np.ravel(t).astype(np.float64)
    F = fundamental_of_pose(*K, R, t) if E is None else np.linalg.inv(K[1]).T @ np.asarray(E) @ np.linalg.inv(K[0])
    return Solution(F, np.asarray(inliers, np.bool_).ravel(), focals, R, t)


def within(F: Any, pair: PixelPair, threshold: float) -> NDArray[np.bool_]:
    """Which matches lie within a Sampson distance of F, in pixels, (N,)."""
    matrix, x0, x1 = (torch.from_numpy(np.asarray(value, np.float64)) for value in (F, pair.x0, pair.x1))
    return (sampson(matrix, x0, x1) <= threshold).numpy()


def fundamental_of_pose(K0: Points, K1: Points, R: Points, t: Points) -> Points:
    """F of two calibrated cameras, K1^-T [t]x R K0^-1."""
    return np.linalg.inv(K1).T @ np.cross(t, np.eye(3)).T @ R @ np.linalg.inv(K0)


def _size(sizes: torch.Tensor | None, x: Points, i: int) -> tuple[int, int]:
    """The image's (h, w); where it is not known, that of the box of the points from the origin."""
    if sizes is not None:
        h, w = (math.ceil(v) for v in sizes[i].tolist())
        return h, w
    w, h = (int(v) + 1 for v in np.ceil(x.max(0, initial=0.0)))
    return h, w
