"""Of which type each pair of an estimate is: what its fundamental matrix is worth."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core.types import PAIR_TYPES, WARNINGS, Correspondences, Estimate
from fmtorch.geometry import pair_type as kinds
from fmtorch.geometry.arithmetic import component_sum, sqrt
from fmtorch.geometry.epipolar import inverse_root
from fmtorch.geometry.homography_pose import PlanePoses, poses_from_homography
from fmtorch.geometry.pair_type import Evidence
from fmtorch.jit.kernel import compile_together
from fmtorch.jobs.execution import one_thread
from fmtorch.two_view.arguments import expect_values
from fmtorch.two_view.estimation import estimated, estimator_of
from fmtorch.two_view.known_cameras import calibration

FOCAL_DEVIATION = 0.02  # of the focal lengths of a calibration, relative: what zoom and focus change between two days
MIN_DEPTH = 0.1  # of points that a lens is said to bend beyond the horizon
STILL = 0.1  # px of the images as matched: a median motion below it is none
USUAL_FOCAL, USUAL_DEVIATION = 1.2, 0.4  # of photographs, in longer sides, and of its logarithm (the estimator's prior)
SAME_POSE = 1e-3  # radians: two poses of a plane that differ less in rotation are one
OTHER_CAMERA = 0.5  # deviation of the logarithm of the ratio of both focal lengths (likewise)


class PairTypes(NamedTuple):
    """Types of B pairs.
    kind: indices into `fmtorch.core.types.PAIR_TYPES`. evidence: for the kinds. homography: of plane or rotation."""

    kind: Int[Tensor, " b"]
    evidence: Evidence
    homography: Estimate

    @property
    def names(self) -> tuple[str, ...]:
        """The kinds in words: general, planar, rotation, identical or unrelated."""
        return tuple(PAIR_TYPES[i] for i in self.kind.tolist())

    @property
    def warnings(self) -> tuple[str, ...]:
        """What each kind leaves open, empty where nothing."""
        return tuple(WARNINGS[name] for name in self.names)

    @property
    def flat(self) -> Bool[Tensor, " b"]:
        """Whether a homography explains all matches: of planes, rotations and copies."""
        flat = (self.kind == kinds.PLANAR) | (self.kind == kinds.ROTATION) | (self.kind == kinds.IDENTICAL)
        return self.homography.ok & flat

    def of_pair(self, i: int) -> "PairTypes":
        """That of the i-th pair alone."""
        return PairTypes(self.kind[i : i + 1], Evidence(*(v[i : i + 1] for v in self.evidence)), self.homography[i])

    @property
    def determined(self) -> Bool[Tensor, " b"]:
        """Whether the matches determine F: of the general pairs alone."""
        return self.kind == kinds.GENERAL


def compile_with(stages: Iterable[object]) -> None:
    """Have the kernels of these stages and of `classify` ready; two processes compile those that are new."""
    stages = (estimator_of("homography", None, {}), *stages)
    compile_together([kinds.weigh, *(each for stage in stages for each in getattr(stage, "kernels", ()))])


def classify(
    c: Correspondences, estimate: Estimate, *, focal_deviation: float | int = FOCAL_DEVIATION, seed: int = 0,
    **options: Any,
) -> PairTypes:  # fmt: skip
    """The type of each pair, by the evidence of its F, of a homography, a rotation and a copy.

    No threshold is in pixels: likelihoods are compared at the noise that the pair itself shows. Calibrations
    and measured focal lengths decide on rotations, else image sizes, by the prior on usual focal lengths; without any a
    rotation is called planar.

    Args:
        c: all matches that were given to the estimator.
        estimate: their fundamental matrices; where there is none, that of `find_fundamental` is looked for.
        focal_deviation: relative deviation of the focal lengths of `c.K0` and `c.K1`; 0 where they are exact. Where
            `c.focal` has a larger one, that counts, and an infinite one is of an unknown focal length.
        seed: of the homography's random numbers.
        options: of `find_homography`.

    Returns:
        A `PairTypes`. A pair without F and without H is unrelated.

    Raises:
        ValueError: for an estimate of another model or of other pairs, or a negative deviation.

    Example:
        >>> import torch, fmtorch
        >>> from fmtorch.two_view.pair_type import classify
        >>> x0 = 600 * torch.rand(100, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> H = torch.tensor([[0.9, 0.1, 20], [-0.1, 1.0, 5], [1e-4, 2e-4, 1]], dtype=torch.float64)
        >>> x1 = fmtorch.geometry.homography_points(H, x0)                       # one plane
        >>> mask = torch.ones(1, 100, dtype=torch.bool)
        >>> c = fmtorch.Correspondences(x0[None], x1[None], mask)
        >>> classify(c, fmtorch.find_fundamental(x0, x1)).names
        ('planar',)
    """
    if estimate.model != "fundamental":
        raise ValueError(f"estimate is of {estimate.model} matrices; it must be of fundamental matrices")
    if len(estimate) != len(c):
        raise ValueError(f"estimate is of {len(estimate)} pairs and c of {len(c)}; they must be of the same pairs")
    if not focal_deviation >= 0:
        raise ValueError(f"focal_deviation is {focal_deviation}; it must not be negative")
    expect_values(c)
    compile_with(())
    c = straightened(c, estimate.lens)
    matches = c.detach().derived(K0=None, K1=None, focal=None, shared_focal=None)
    H = estimated(matches, "homography", "homography", None, seed, options)
    F, ok, failed = estimate.F.clone(), estimate.ok.clone(), ~estimate.ok
    if bool(failed.any()):  # which says nothing of their matches
        own = estimated(matches[failed], "fundamental", "fmtorch", None, seed, {})
        F[failed], ok[failed] = own.F.to(F), own.ok
    K0, K1, precision = _cameras(c, focal_deviation)
    with one_thread(c.mask.device):
        evidence = kinds.pair_evidence(
            F, H.H, c.x0, c.x1, c.mask, c.prior, c.noise, c.size0, c.size1, K0, K1, precision
        )
    exact = None if precision is None else precision.diagonal(dim1=-2, dim2=-1).isinf().all(-1)
    return PairTypes(torch.where(ok | H.ok, kinds.classified(evidence, exact), kinds.UNRELATED), evidence, H)


def straightened(c: Correspondences, lens: Tensor | None) -> Correspondences:
    """The matches as pinholes have them whose lenses (b, 2) are estimated, straight where these are not determined."""
    if lens is None:
        return c
    fields: dict[str, Any] = {"lens": None, "shared_lens": None}
    bends = lens.nan_to_num(0).to(c.x0).unbind(1)
    for i, (x, K, size, bend) in enumerate(zip((c.x0, c.x1), (c.K0, c.K1), (c.size0, c.size1), bends, strict=True)):
        assert size is not None
        half = sqrt(component_sum(size.to(torch.float64) ** 2, -1)) / 2
        A = calibration(half, size) if K is None else K / K[:, 2:, 2:]
        centre, f = (value[:, None].to(x) for value in (A[:, :2, 2], A.diagonal(dim1=1, dim2=2)[:, :2]))
        ray = (x - centre) / f * (sqrt(f[..., :1] * f[..., 1:]) / half[:, None, None].to(x))
        depth = 1 + bend[:, None] * component_sum(ray * ray, -1)
        fields[f"x{i}"] = centre + (x - centre) / depth.clamp_min(MIN_DEPTH)[..., None]
    return c.derived(**fields)


def _cameras(c: Correspondences, deviation: float | int) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """K0, K1 and the inverse covariance of the logarithms of their focal lengths; None where nothing is known."""
    calibrations, sizes = (c.K0, c.K1), (c.size0, c.size1)
    if any(K is None and size is None for K, size in zip(calibrations, sizes, strict=True)):
        return None, None, None
    device, b = c.mask.device, len(c)
    deviations = torch.full((b, 2), deviation, dtype=torch.float64, device=device)
    measured = torch.zeros(b, 2, 2, dtype=torch.float64, device=device) if c.focal is None else c.focal.double()
    deviations = torch.maximum(deviations, measured[..., 1])
    cameras = []
    for i, (K, size) in enumerate(zip(calibrations, sizes, strict=True)):
        if K is None and c.focal is None:
            deviations[:, i] = torch.inf
        cameras.append(_camera(K, size, measured[:, i, 0], deviations[:, i].isfinite()))
    known = torch.diag_embed(deviations**-2)
    mean = torch.full((2, 2), 1 / 4 / USUAL_DEVIATION**2, dtype=torch.float64, device=device)
    usual = mean + OTHER_CAMERA**-2 * mean.new_tensor([[1.0, -1.0], [-1.0, 1.0]])
    return cameras[0], cameras[1], known + torch.where(deviations.isinf().any(1)[:, None, None], usual, 0.0)


def _camera(K: Tensor | None, size: Tensor | None, focal: Tensor, known: Tensor) -> Tensor:
    """K (b, 3, 3), or that of an image of this size (b, 2) and focal length (b,), px, usual where it is not known."""
    if K is None:
        assert size is not None
        A = calibration(USUAL_FOCAL * size.to(torch.float64).amax(-1), size)
        scale = torch.where(known, focal / A[:, 0, 0], 1.0)
    else:
        A = K.to(torch.float64)
        A = A / A[:, 2:, 2:]
        longest = (2 * A[:, :2, 2] + 1 if size is None else size.to(A)).amax(1)
        scale = torch.where(known, 1.0, USUAL_FOCAL * longest / sqrt(A[:, 0, 0] * A[:, 1, 1]))
    return A * torch.stack([scale, scale, torch.ones_like(scale)], -1)[:, None]


def with_pair_type(estimate: Estimate, c: Correspondences, seed: int, **options: Any) -> Estimate:
    """The estimate with the fields `pair_type_index`, `homography`, `other_R`, `other_t`; c: all its matches."""
    judged = classify(c.detach(), estimate.detach(), seed=seed, **options)
    c = straightened(c, estimate.lens)
    H, kind, flat = judged.homography, judged.kind, judged.flat
    fields = {"pair_type_index": kind, "homography": torch.where(flat[:, None, None], H.H, 0)}
    if c.K0 is not None and c.K1 is not None and estimate.R is not None:
        with one_thread(c.mask.device):
            poses = poses_from_homography(H.H, c.K0, c.K1, c.x0, c.x1, H.inliers)
            fields |= _other_pose(estimate.R, poses, flat & (kind == kinds.PLANAR))
    return estimate.derived(**fields)


def warnings_of(estimate: Estimate, pair_type: PairTypes) -> tuple[str, ...]:
    """What each pair leaves open or contradicts, as `Estimate.warning` has it."""
    return estimate.derived(pair_type_index=pair_type.kind).warning


def _other_pose(R: Float[Tensor, "b 3 3"], poses: PlanePoses, flat: Tensor) -> dict[str, Tensor]:
    """The pose of a plane that is farther from R, as fields; NaN where both are one or the pair is not flat."""
    trace = component_sum((poses.R * R[:, None].to(poses.R)).flatten(2), -1)
    rows, other = torch.arange(len(R), device=R.device), trace.argmin(1)
    apart = 1 - (trace[rows, other] - 1) / 2 > SAME_POSE**2 / 2
    valid = flat & poses.valid.all(1) & apart
    t = poses.t[rows, other]
    t = t * inverse_root(component_sum(t * t, -1))[:, None]
    return {
        "other_R": torch.where(valid[:, None, None], poses.R[rows, other], torch.nan).to(R),
        "other_t": torch.where(valid[:, None], t, torch.nan).to(R),
    }


def still_warning(c: Correspondences, inliers: Tensor) -> str:
    """A warning where the inliers, or without any all matches, do not move between the images."""
    motion = (c.x1 - c.x0)[0].norm(dim=-1)
    motion = motion[inliers] if inliers.any() else motion
    if len(motion) == 0 or motion.median() > STILL:
        return ""
    return "the images show no motion, as if they were one: infinitely many F agree with all matches"
