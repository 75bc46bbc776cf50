"""Estimates of pairs whose cameras are known, exactly or roughly, by any estimator of fundamental matrices."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.checks import box_of
from fmtorch.core.records import ungraphed
from fmtorch.core.stages import Estimator, Pruner, called, output_of
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.estimators.lens_search import TAIL_DEVIATION
from fmtorch.geometry.arithmetic import component_sum, matmul3, sqrt
from fmtorch.geometry.cameras import MIN_SIDE_PX, calibration_problems, cross_matrix, mapped, square_pixels
from fmtorch.geometry.covariance import LensesInPixels, two_view_covariance
from fmtorch.geometry.epipolar import inverse_root, mean_stretch, stretch_across
from fmtorch.geometry.normalize import canonical
from fmtorch.geometry.pose import inverse, pose, pose_from_fundamental
from fmtorch.geometry.significance import judged
from fmtorch.jit.kernel import for_each_pair
from fmtorch.jobs.execution import one_thread
from fmtorch.two_view.arguments import camera_problems

OFF_CENTRE = 0.1  # of a principal point, in units of the side, or beyond twice it a point: K may be of another image
PROMISED = 1.25  # right matches that the prior expects, times the inliers, from which on K is doubted; mostly 1
MORE, BEYOND = 1.1, 8.0  # significance without K, times that with it and beyond, from which on it is contradicted


class KnownCameras:
    """An estimator that takes `K0`, `K1`, `focal` and `shared_focal` of its correspondences into account.

    Points are mapped by K to square pixels about the image centre before the estimator, and F back; E, R, t and the
    focal lengths follow from the focal lengths that the estimator finds, or from the measured ones where it finds none.
    The focal length of K stands for that in `focal`, with the deviation there, or 0 where `focal` is not given.

    Where one K is missing and the images have one size, which mostly come from one camera, that image has the principal
    point and the shape of pixels of the other."""

    model = "fundamental"

    def __init__(self, estimator: Estimator, pruner: Pruner | None = None, covariance: bool = False) -> None:
        """estimator: of fundamental matrices. pruner: before it. covariance: whether to compute it."""
        self.estimator, self.pruner, self.covariance = estimator, pruner, covariance

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate the cameras of a batch of pairs; one whose K is wrong is `ok=False` with a reason."""
        return ungraphed(c, lambda: self._estimated(c, seed))

    def _estimated(self, c: Correspondences, seed: int) -> Estimate:
        with one_thread(c.mask.device):
            images = _images(_completed(c))
            square = _square(c, images)
        square = square if self.pruner is None else self.pruner(square)
        estimate = called("c, seed=0", self.estimator, square, seed)
        estimate = judged(output_of(self.estimator, estimate, Estimate, square), square)
        with one_thread(c.mask.device):
            known = _with_cameras(estimate, square, images, self.covariance)
        anything = bool(images.measured.isfinite().any()) or c.shared_focal is not None
        return self._compared(c, square, known, seed) if anything else known

    @torch.no_grad()
    def _compared(self, c: Correspondences, square: Correspondences, known: Estimate, seed: int) -> Estimate:
        """The estimate with the calibrations that are contradicted: of those off centre, that suggest a lens or have
        fewer inliers than the prior promises, the ones far less significant than none, with and without that lens."""
        rows, wrong, suggested = _off_centre(c), torch.zeros_like(known.ok), known.lens_suggested
        if suggested is not None:
            rows |= suggested.isfinite()
        if square.prior is not None:
            promised = torch.where(square.mask, square.prior.detach(), 0).sum(1)
            rows |= promised > PROMISED * known.inliers.sum(1)
        if not bool(rows.any()):
            return known.derived(contradicted=wrong)
        alone = c.detach()[rows].derived(K0=None, K1=None, focal=None, shared_focal=None)
        alone = alone if self.pruner is None else self.pruner(alone)
        without = torch.as_tensor(judged(self.estimator(alone, seed), alone).significance)
        most = torch.as_tensor(known.significance)[rows]
        if suggested is not None:
            bend = suggested[rows].double().nan_to_num(0)
            lens = torch.stack([bend, torch.zeros_like(bend)], -1)[:, None].expand(-1, 2, 2)
            bent = square.detach()[rows].derived(lens=lens)
            most = torch.maximum(most, torch.as_tensor(judged(self.estimator(bent, seed), bent).significance))
        wrong[rows] = without > MORE * most + BEYOND
        suggested = None if suggested is None else torch.where(wrong, torch.nan, suggested)
        return known.derived(contradicted=wrong, lens_suggested=suggested)


class Images(NamedTuple):
    """What is known of both images of each pair, after their points are mapped to square pixels.
    map: None where the points are as they were. measured: focal lengths, px, and their relative deviations. size:
    (h, w), None where unknown. unit: pixels as they were in one of the square ones; None as `map`. problems: of K."""

    map: Float[Tensor, "b 2 3 3"] | None
    measured: Float[Tensor, "b 2 2"]
    size: Float[Tensor, "b 2 2"] | None
    unit: Float[Tensor, "b 2"] | None
    problems: tuple[str, ...]


def _images(c: Correspondences) -> Images:
    device, sizes = c.mask.device, None
    if c.size0 is not None and c.size1 is not None:
        sizes = torch.stack([c.size0, c.size1], 1).double()
    if c.K0 is None or c.K1 is None:
        unknown = torch.full((len(c), 2, 2), torch.inf, dtype=torch.float64, device=device)
        return Images(None, unknown if c.focal is None else c.focal.detach().double(), sizes, None, ("",) * len(c))
    problems = camera_problems(c)
    valid = torch.tensor([not problem for problem in problems], dtype=torch.bool, device=device)
    K = torch.stack([c.K0.double(), c.K1.double()], 1).reshape(-1, 3, 3)
    square = square_pixels(K, None if sizes is None else sizes.reshape(-1, 2), valid.repeat_interleave(2))
    A, focal, size, unit = (each.reshape(len(c), 2, *each.shape[1:]) for each in square)
    deviation = torch.zeros_like(focal) if c.focal is None else c.focal[..., 1].detach().double()
    return Images(A, torch.stack([focal, deviation], -1), size, unit, problems)


def _off_centre(c: Correspondences) -> Bool[Tensor, " b"]:
    """Whether a principal point of a pair is far from its image's centre, or without a size from its points."""
    off = torch.zeros(len(c), dtype=torch.bool, device=c.mask.device)
    for K, x, size in ((c.K0, c.x0, c.size0), (c.K1, c.x1, c.size1)):
        if K is None or not len(off) or not x.shape[1]:
            continue
        centre = (K[:, :2, 2] / K[:, 2:, 2]).detach().double()
        if size is not None:
            off |= (((centre + 0.5) / size.flip(-1) - 0.5).abs() > OFF_CENTRE).any(1)
            continue
        _, low, high = box_of(x, c.mask)
        beyond = (centre < low) | (centre > high) | (high > (1 + OFF_CENTRE) * (2 * centre + 1))
        off |= beyond.any(1) & (K[:, 0, 0].detach() >= MIN_SIDE_PX * K[:, 2, 2].detach())
    return off


def _completed(c: Correspondences) -> Correspondences:
    """The same with a K of unknown focal length in place of one that is missing beside the other."""
    if (c.K0 is None) == (c.K1 is None) or c.size0 is None or c.size1 is None:
        return c
    known, missing = (0, 1) if c.K1 is None else (1, 0)
    K, sizes = (c.K1 if c.K0 is None else c.K0), (c.size0, c.size1)
    assert K is not None
    focal = c.focal
    if focal is None:
        focal = torch.ones(len(c), 2, 2, dtype=torch.float64, device=K.device)
        focal[:, known, 1], focal[:, missing, 1] = 0, torch.inf
    problems = calibration_problems(K, sizes[known])
    valid = torch.tensor([not problem for problem in problems], dtype=torch.bool, device=K.device)
    similar = valid & (c.size0 == c.size1).all(1)
    K = torch.where(similar[:, None, None], K.double(), calibration(sizes[missing].amax(1).double(), sizes[missing]))
    length, deviation = focal[:, missing].detach().double().unbind(-1)
    scale = torch.where(deviation < torch.inf, length * K[:, 2, 2] / sqrt(K[:, 0, 0] * K[:, 1, 1]), 1)
    K = K * torch.stack([scale, scale, torch.ones_like(scale)], -1)[:, None]  # columns of the focal lengths
    return c.derived(focal=focal, **{f"K{missing}": K})


def _square(c: Correspondences, images: Images) -> Correspondences:
    """The same pairs in images of square pixels; those of a wrong K without matches."""
    fields: dict[str, Tensor | None] = {"K0": None, "K1": None, "focal": images.measured}
    if images.size is not None:
        fields["size0"], fields["size1"] = images.size.unbind(1)
    if images.map is not None:
        valid = torch.tensor([not problem for problem in images.problems], dtype=torch.bool, device=c.mask.device)
        x = torch.stack([c.x0, c.x1], 1)
        fields["mask"] = mask = c.mask & x.isfinite().all(-1).all(1) & valid[:, None]
        fields["x0"], fields["x1"] = mapped(torch.where(mask[:, None, :, None], x, 0), images.map).unbind(1)
        for i, lafs in enumerate((c.lafs0, c.lafs1)):
            if lafs is not None:
                A = images.map[:, i, None, :2]
                columns = (A[..., 0, None] * lafs[..., :1, :] + A[..., 1, None] * lafs[..., 1:, :]).unbind(-1)
                fields[f"lafs{i}"] = torch.stack([*columns[:2], columns[2] + A[..., 2]], -1).to(lafs.dtype)
        if c.stretch is not None:
            A = images.map[..., :2, :2]
            unit = sqrt(A[..., 0, 0] * A[..., 1, 1])  # of square pixels in those of the photograph
            by = (A / unit[..., None, None])[:, None].to(c.stretch)
            fields["stretch"] = component_sum(by[..., :, :, None] * c.stretch[..., None, :, :], -2)
    return c.derived(**fields)


def _with_cameras(estimate: Estimate, square: Correspondences, images: Images, covariance: bool) -> Estimate:
    """The estimate for the points as they were, with the pose of its cameras."""
    F, ok, focals = estimate.F, estimate.ok, estimate.focals
    measured = torch.where(images.measured[..., 1] < torch.inf, images.measured[..., 0], torch.nan)
    focals = measured if focals is None else torch.where(focals.isnan(), measured, focals)
    known = ok[:, None] & focals.isfinite()
    focals = torch.where(known, focals, 1.0)  # so that no gradient is NaN
    square_focals = focals
    R, t = _pose(estimate, square, focals, known.all(1))
    if estimate.R is not None and estimate.t is not None:  # another library's own
        own = known.all(1) & estimate.R.isfinite().all(-1).all(-1) & estimate.t.isfinite().all(-1)
        R, t = torch.where(own[:, None, None], estimate.R.to(R), R), torch.where(own[:, None], estimate.t.to(t), t)
    if images.map is not None and images.unit is not None:
        A = images.map.to(F)
        F = torch.where(ok[:, None, None], canonical(matmul3(matmul3(A[:, 1].mT, F), A[:, 0])), 0)
        focals = focals * images.unit
    lens, unit = estimate.lens, images.unit  # half diagonals are of the images as they were
    fields = {} if lens is None or unit is None else {"lens": lens * (unit.detach() / unit) ** 2}
    if covariance:
        at, square = estimate.derived(matrix=F, R=R, t=t).detach(), _with_noise_across(square, estimate.F.detach())
        fields |= covariance_fields(at, square, images.map, torch.where(known, square_focals, torch.nan).detach())
    reasons = tuple(problem or reason for problem, reason in zip(images.problems, estimate.reason, strict=True))
    focals = torch.where(known, focals, torch.nan)
    return estimate.derived(matrix=F, E=matmul3(cross_matrix(t), R), R=R, t=t, focals=focals, reason=reasons, **fields)


def _with_noise_across(c: Correspondences, F: Tensor) -> Correspondences:
    """The matches with their noise across the epipolar lines of F (b, 3, 3)."""
    if c.stretch is None or c.noise is None:
        return c
    points = torch.cat([c.x0, c.x1], -1).detach().double().movedim(-1, 0)
    across = sqrt(stretch_across(F.double().flatten(1).T[..., None], points, c.stretch.double()))
    mean = mean_stretch(c.stretch.double(), sqrt)
    return c.derived(noise=torch.where(mean > 0, c.noise * across / mean, c.noise))


def _pose(estimate: Estimate, square: Correspondences, focals: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """R (B, 3, 3) and t (B, 3) by the focal lengths (B, 2) of known ones (B,); NaN where there is no pose."""
    F, sizes = estimate.F.double(), (square.size0, square.size1)
    if sizes[0] is None or sizes[1] is None:
        return F.new_full((len(F), 3, 3), torch.nan), F.new_full((len(F), 3), torch.nan)
    K0, K1 = calibration(focals[:, 0], sizes[0]), calibration(focals[:, 1], sizes[1])
    prior = torch.ones_like(square.x0[..., 0]) if square.prior is None else square.prior.nan_to_num(0)
    weight = torch.where(estimate.inliers & known[:, None], prior, 0).detach()
    cameras = torch.cat([K[:, [0, 0, 1], [0, 2, 2]] for K in (K0, K1)], 1)
    out = torch.empty(len(F), 13, dtype=torch.float64)
    out = for_each_pair(pose, (F, cameras, square.x0, square.x1, weight), out=out, kind=torch.float64)
    R, t, valid = out[:, :9].reshape(-1, 3, 3), out[:, 9:12], (out[:, 12] == 1) & known
    if torch.is_grad_enabled() and (F.requires_grad or focals.requires_grad):
        graphed = pose_from_fundamental(F, K0, K1, square.x0.detach(), square.x1.detach(), estimate.inliers, weight)
        R, t = R + (graphed.R - graphed.R.detach()), t + (graphed.t - graphed.t.detach())
    return torch.where(valid[:, None, None], R, torch.nan), torch.where(valid[:, None], t, torch.nan)


def calibration(focal: Tensor, size: Tensor) -> Tensor:
    """K (B, 3, 3) of square pixels and central principal points."""
    zero, ones = torch.zeros_like(focal), torch.ones_like(focal)
    x, y = (size[:, 1].to(focal) - 1) / 2, (size[:, 0].to(focal) - 1) / 2
    return torch.stack([focal, zero, x, zero, focal, y, zero, zero, ones], -1).reshape(-1, 3, 3)


@torch.no_grad()
def covariance_fields(
    estimate: Estimate, c: Correspondences, maps: Float[Tensor, "b 2 3 3"] | None, focals: Float[Tensor, "b 2"]
) -> dict[str, Tensor]:
    """The fields `covariance`, `tangents`, `covariance_F` of an estimate with a pose; NaN where there is none.
    c: its matches, in images of square pixels and central principal points. maps: from the coordinates that F is of to
    those of c, None where these are the same. focals: of c."""
    R, t, scale = estimate.R, estimate.t, estimate.fit_scale
    if R is None or t is None or scale is None or c.size0 is None or c.size1 is None:
        shapes = {"covariance": (7, 7), "tangents": (3, 2), "covariance_F": (9, 9)}
        return {name: focals.new_full((len(c), *shape), torch.nan) for name, shape in shapes.items()}
    centre0, centre1 = ((size.to(focals).flip(-1) - 1) / 2 for size in (c.size0, c.size1))
    computed = two_view_covariance(
        c.x0, c.x1, R, t, focals, centre0, centre1, scale, c.prior, c.noise, c.mask & estimate.ok[:, None],
        estimate.focal_precision, c.shared_focal, _lenses(c, estimate.lens),
    )  # fmt: skip
    of_F = computed.fundamental
    if maps is not None:
        of_F = _covariance_of(of_F, estimate.F.to(focals), *maps.to(focals).unbind(1))
    fields = {"covariance": computed.covariance, "tangents": computed.tangent, "covariance_F": of_F}
    valid = (estimate.ok & computed.valid)[:, None, None]
    return {name: torch.where(valid, value, torch.nan) for name, value in fields.items()}


def _lenses(c: Correspondences, lens: Tensor | None) -> LensesInPixels | None:
    """Estimated lenses (b, 2) and what was known of them; unknown ones that came out straight are so."""
    if lens is None or c.lens is None:
        return None
    deviation = c.lens[..., 1].double()
    straight = (deviation.isinf() & (lens == 0)).all(1, keepdim=True)
    precision = torch.where(straight, torch.inf, deviation.clamp_max(TAIL_DEVIATION) ** -2)
    sizes = torch.stack([size for size in (c.size0, c.size1) if size is not None], 1).double()
    shared = torch.zeros_like(straight[:, 0]) if c.shared_lens is None else c.shared_lens
    return LensesInPixels(lens.double(), sqrt(component_sum(sizes * sizes, -1)) / 2, precision, shared)


def _covariance_of(
    C: Float[Tensor, "b 9 9"], F: Float[Tensor, "b 3 3"], A0: Tensor, A1: Tensor
) -> Float[Tensor, "b 9 9"]:
    """The covariance of F, which is A1^T G A0 at unit norm, from that of G at unit norm."""
    G = matmul3(matmul3(_inverse(A1).mT, F), _inverse(A0)).flatten(1)
    M = (A1.mT[:, :, None, :, None] * A0.mT[:, None, :, None, :]).flatten(3).flatten(1, 2)
    M = M / inverse_root(component_sum(G * G, -1))[:, None, None]
    f = F.flatten(1)
    J = M - f[:, :, None] * component_sum(f[:, :, None] * M, 1)[:, None]
    return _product(_product(J, C), J.mT)


def _inverse(A: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 3"]:
    return inverse(A.movedim((-2, -1), (0, 1)))[0].movedim((0, 1), (-2, -1))


def _product(A: Float[Tensor, "b k m"], B: Float[Tensor, "b m n"]) -> Float[Tensor, "b k n"]:
    """``A B``, the same bits in any batch."""
    return component_sum(A[..., None] * B[:, None], 2)
