"""The two-line replacements for `cv2.findFundamentalMat`, `cv2.findEssentialMat` and `cv2.findHomography`."""

import functools
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, cast

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.checks import box_of
from fmtorch.core.types import CONTRADICTED, Correspondences, Estimate, PoseEstimate, collate
from fmtorch.geometry.epipolar import unit_frobenius
from fmtorch.jobs.execution import one_thread
from fmtorch.two_view.arguments import Arrays, Focal, Lens, correspondences, is_calibrated
from fmtorch.two_view.estimation import Size, estimated, given_sizes
from fmtorch.two_view.pair_type import with_pair_type

if TYPE_CHECKING:
    from fmtorch.two_view.lenses import CalibratedLenses

PASSED = ("fmtorch", "contextlib", "torch", "jaxtyping")  # modules on the way from a user's line to a warning
P = ParamSpec("P")
R = TypeVar("R")


def eager(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which `torch.compile` calls instead of tracing it: gradients pass, the graph ends before it.
    `torch.compiler.disable` would import the compiler, for a second and more, into programs that have no use for it."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        dynamo = sys.modules.get("torch._dynamo")
        run = function if dynamo is None else cast(Callable[P, R], dynamo.disable(function))
        return run(*args, **kwargs)

    call._torchdynamo_disable = True  # type: ignore[attr-defined]
    return call


@eager
@one_thread("cpu")
def find_fundamental(
    x0: Arrays, x1: Arrays, *, estimator: str = "fmtorch", mask: Arrays | None = None, ratio: Arrays | None = None,
    score: Arrays | None = None, prior: Arrays | None = None, lafs0: Arrays | None = None, lafs1: Arrays | None = None,
    noise: Arrays | None = None, size0: Size = None, size1: Size = None, K0: Arrays | None = None,
    K1: Arrays | None = None, focal: Focal = None, lens: Lens = None, covariance: bool = False,
    pair_type: bool = False, key: Arrays | int | None = None, seed: int = 0, config_dir: Path | str | None = None,
    **options: Any,
) -> Estimate:  # fmt: skip
    """Robustly estimate fundamental matrices from matched points, ``x1^T F x0 = 0``.

    Args:
        x0, x1: matched points in pixels, NumPy or torch, on any device: (N, 2) for one pair, (B, N, 2) for a padded
            batch, or a list of (N, 2) for pairs of different lengths. Gradients reach them through the final fit.
        estimator: a preset of conf/estimator.
        mask: (B, N), True for real matches; all when not given. Like every argument for matches it may lack the
            leading B for one pair, and is a list where the points are.
        ratio: (B, N), the distance of the nearest descriptor over that of the second nearest, smaller is better.
        score: (B, N), the matcher's confidence in [0, 1], larger is better, NaN as 0; used where there is no ratio.
            The matches of each pair tell whether it is a probability, like LightGlue's; if not, `fmtorch` ignores it.
        prior: (B, N), P(inlier) in [0, 1], NaN as 0. Where an estimator uses a prior and none is given, it is derived
            from the frames and the ratio, if known, otherwise from the points and the ratio or score, if known.
        lafs0, lafs1: (B, N, 2, 3) local affine frames.
        noise: (B, N), each match's standard deviation relative to a usual one's (`fmtorch.pruning.MatchNoise` derives
            it from frames); or (B, N, 2, 2), its covariance in image 1, where points of image 0 are exact.
        size0, size1: image sizes (h, w), one for all pairs or (B, 2); assumed from the points' extent when not given,
            unless these are centred; "unknown" assumes nothing.
        K0, K1: calibration matrices, px, (3, 3) for all pairs or (B, 3, 3), of both images or of one. Gradients reach
            them.
        focal: what else is known of the focal lengths; without K, it implies square pixels and a central principal
            point, and needs `size0` and `size1`:

            ================================  ======================================================================
            None                              K0 and K1 are exact; without them usual focal lengths are likely
            "unknown"                         the same estimate, with its cameras and pose
            "shared"                          one unknown focal length for both images (in units of the longer side)
            (f, s)                            f px for both images, up to a relative standard deviation s
            ((f0, s0), (f1, s1))              the same for each image, None in place of what is unknown; (B, 2, 2)
            s, (s0, s1) or (B, 2), with K     how well the focal lengths of K0 and K1 are known; with "unknown" and
                                              "shared" K tells principal points and the shape of pixels alone
            ================================  ======================================================================

            A deviation of 0 is exact and an infinite one nothing; 0.05 suits EXIF. From 0.02 on measurements may be
            wrong altogether. A mapping says nothing of cameras: it holds options of the preset's stage of that name.
        lens: how much the lenses bend straight lines, ``x_u = x_d / (1 + lambda r_d^2)`` about the principal point, r_d
            in half diagonals of the image: -0.05 of a usual phone at its wide end, -0.3 of an action camera. None: not
            at all; "shared": one unknown lambda, "unknown": one for each image; lambda, exactly; (lambda, s) up to a
            standard deviation s; ((lambda0, s0), (lambda1, s1)) or (B, 2, 2) for each image, None in place of an
            unknown one. Points and inliers are in pixels of the photographs; F, E and pose, in undistorted ones. With
            K0 or K1 it needs the image sizes. Calibrated lenses are `fmtorch.Lens`, for both images, (lens0, lens1)
            with None for a pinhole, or a list of (lens0, lens1), one for each pair: matches are judged in pixels of the
            photographs, even over 90 degrees off the axis of a fish-eye; the K of a lens replaces K0 or K1.
            Gradients are zero where an estimated or exact lambda is not zero and no plausible cameras agree with the
            matches.
        covariance: whether to compute the covariance, which needs K0 and K1 or the image sizes. Where nothing is
            said of the cameras, ``focal="unknown"`` is assumed.
        pair_type: whether to determine the type of each pair: general, planar, rotation, identical, unrelated.
        key: (B,) int64, selects each pair's random numbers.
        seed: of the random numbers.
        config_dir: a folder with presets of your own, ``<config_dir>/estimator/<name>.yaml``, which come first.
        options: replace values of the preset (``threshold=0.5``).

    Returns:
        An `Estimate` of B pairs (of one pair for (N, 2) points, of none for an empty list), with F of unit Frobenius
        norm, inliers, ok, reason, significance. A pair that cannot be solved is ``ok=False``, never an exception. An F
        that is ok may be of images that show nothing in common: `related` tells. `sizes` are those that were assumed,
        and `warning` says where they are doubtful; `lens` (B, 2), lambdas where these are estimated. With K0, K1 or
        `focal` also focals, E, R and t, NaN where they are not determined; `deviation_degrees` says how far these may
        be off and `warning` what the pair type leaves open.

    Raises:
        ValueError: for points of another shape, points that are no pixels or outside images of these sizes, a prior
            outside [0, 1], a noise or an image size that is not positive, the size of one image only, an unknown preset
            or option, an estimator of another model, and K0 beside a lens of image 0; for a K that is no calibration
            matrix of the image, and a lens that is not finite or folds it, of a single pair (of a batch: ``ok=False``).
        TypeError: for what is no array of numbers.

    Example:
        >>> import torch, fmtorch
        >>> generator = torch.Generator().manual_seed(0)
        >>> X = torch.rand(80, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 2.0])
        >>> x0, x1 = (500 * Y[:, :2] / Y[:, 2:] for Y in (X, X + torch.tensor([-0.5, 0.0, 0.2])))
        >>> x1[:20] = x1[:20].flip(0)                            # twenty wrong matches
        >>> estimate = fmtorch.find_fundamental(x0, x1)
        >>> bool(estimate.ok[0]), int(estimate.inliers[0, 20:].sum())
        (True, 60)
    """
    lenses = None if lens is None else _lenses(lens, x0, K0, K1)
    if lenses is not None:
        (K0, K1), lens = lenses.K, None
    if covariance and K0 is None and K1 is None and focal is None:
        if size0 is None or isinstance(size0, str):
            raise ValueError("covariance needs K0 and K1, or the image sizes: give size0 and size1")
        focal = "unknown"
    if lens is not None and (isinstance(size0, str) or (size0 is None and (K0 is not None or K1 is not None))):
        raise ValueError("lens needs the image sizes, in whose half diagonals it is: give size0 and size1")
    h0w0, h1w1, assume_sizes = given_sizes(size0, size1)
    c = correspondences(
        x0, x1, mask=mask, ratio=ratio, score=score, prior=prior, lafs0=lafs0, lafs1=lafs1, noise=noise, size0=h0w0,
        size1=h1w1, K0=K0, K1=K1, focal=focal, lens=lens, key=key,
    )  # fmt: skip
    if isinstance(focal, Mapping):
        options["focal"] = focal
    seen = c if lenses is None else lenses.undistorted(c)
    estimate = estimated(seen, "fundamental", estimator, config_dir, seed, options, covariance, assume_sizes)
    if lenses is not None:
        estimate = lenses.completed(estimate, c, seen)
    if estimate.contradicted is not None and bool(estimate.contradicted.any()):
        pairs = estimate.contradicted.nonzero()[:, 0].tolist()
        _warn(f"pair {', '.join(map(str, pairs))}: {CONTRADICTED}")
    if not pair_type:
        return estimate
    return with_pair_type(estimate, seen if lenses is None else lenses.in_view(seen), seed)


def _warn(message: str) -> None:
    """Warn at the line of whoever calls this package, where Python's filter shows each message once."""
    frame: FrameType | None = sys._getframe()
    level = 0
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] in PASSED:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level + 1)


def _lenses(lens: Lens, x0: Arrays, K0: Arrays | None = None, K1: Arrays | None = None) -> "CalibratedLenses | None":
    """Calibrated lenses, and K of their images and others; None where lenses are estimated, or lambda is known."""
    if not is_calibrated(lens):
        return None
    from fmtorch.two_view.lenses import CalibratedLenses

    return CalibratedLenses(lens, x0, K0, K1)


@eager
def find_essential(
    x0: Arrays, x1: Arrays, K0: Arrays | None = None, K1: Arrays | None = None, *, focal: Focal = None,
    lens: Lens = None, estimator: str = "fmtorch", mask: Arrays | None = None, ratio: Arrays | None = None,
    score: Arrays | None = None, prior: Arrays | None = None, lafs0: Arrays | None = None, lafs1: Arrays | None = None,
    noise: Arrays | None = None, size0: Size = None, size1: Size = None, covariance: bool = False,
    pair_type: bool = False, key: Arrays | int | None = None, seed: int = 0, config_dir: Path | str | None = None,
    **options: Any,
) -> PoseEstimate:  # fmt: skip
    """Robustly estimate the relative pose of two calibrated cameras: ``X1 = R X0 + t`` and ``E = [t]_x R``.

    Args:
        x0, x1: matched points in pixels, as for `find_fundamental`; or normalised ones, with K the identity, for which
            thresholds are in pixels of a camera with a focal length of 1000 px.
        K0, K1: calibration matrices in the unit of the points, (3, 3) for all pairs or (B, 3, 3). Pixels need not be
            square nor principal points central. None where `lens` has a calibrated one of that image.
        focal: how well the focal lengths of K0 and K1 are known: None for exactly, or their relative standard
            deviation, one number, (s0, s1) or (B, 2); 0.05 suits EXIF; "shared" or "unknown" where K tells principal
            points and the shape of pixels alone. What is not exact is estimated.
        lens: as of `find_fundamental`.
        size0, size1: image sizes (h, w), one for all pairs or (B, 2). Twice the principal point when not given.
        estimator, mask, ratio, score, prior, lafs0, lafs1, noise, covariance, pair_type, key, seed, config_dir: as of
            `find_fundamental`.
        options: replace values of the preset (``inlier_threshold=1.0``).

    Returns:
        A `PoseEstimate` with R (B, 3, 3), t (B, 3) of unit length with the inliers in front of both cameras,
        E (B, 3, 3), focals (B, 2) and F. NaN where there is no pose. Gradients of all reach the points, prior, noise,
        K0 and K1. Six matches are enough where K0 and K1 are exact, otherwise seven.

    Raises:
        ValueError: as `find_fundamental`; for a K0 or K1 of a single pair that is singular or not in pixels. In a batch
            that pair is ``ok=False`` with a reason.
        TypeError: for what is no array of numbers.

    Example:
        >>> import torch, fmtorch
        >>> generator = torch.Generator().manual_seed(0)
        >>> X = torch.rand(80, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 2.0])
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
        >>> x0, x1 = (Y @ K.T for Y in (X, X + torch.tensor([-0.64, 0.48, 0.6])))
        >>> x0, x1 = x0[:, :2] / x0[:, 2:], x1[:, :2] / x1[:, 2:]
        >>> x1[:20] = x1[:20].flip(0)                            # twenty wrong matches
        >>> estimate = fmtorch.find_essential(x0, x1, K, K)
        >>> bool(estimate.ok[0]), [round(value, 3) for value in estimate.t[0].tolist()]
        (True, [-0.64, 0.48, 0.6])
    """
    lenses = _lenses(lens, x0, K0, K1)
    for name, K in zip(("K0", "K1"), (K0, K1) if lenses is None else lenses.K, strict=True):
        if K is None:
            raise ValueError(f"{name} is None; find_fundamental estimates pairs of which one camera or none is known")
    estimate = find_fundamental(
        x0, x1, estimator=estimator, mask=mask, ratio=ratio, score=score, prior=prior, lafs0=lafs0, lafs1=lafs1,
        noise=noise, size0=size0, size1=size1, K0=K0, K1=K1, focal=focal, lens=lens, covariance=covariance,
        pair_type=pair_type, key=key, seed=seed, config_dir=config_dir, **options,
    )  # fmt: skip
    return PoseEstimate.unchecked(**vars(estimate))


@eager
@one_thread("cpu")
def find_homography(
    x0: Arrays, x1: Arrays, *, estimator: str = "homography", mask: Arrays | None = None, ratio: Arrays | None = None,
    score: Arrays | None = None, prior: Arrays | None = None, lafs0: Arrays | None = None, lafs1: Arrays | None = None,
    noise: Arrays | None = None, size0: Arrays | None = None, size1: Arrays | None = None, lens: Lens = None,
    key: Arrays | int | None = None, seed: int = 0, config_dir: Path | str | None = None, **options: Any,
) -> Estimate:  # fmt: skip
    """Robustly estimate homographies from matched points, ``x1 ~ H x0``: of a plane, or of a camera that turns.

    Args:
        x0, x1: matched points in pixels, as for `find_fundamental`. x0 may be in the unit of a plane, with y up or
            down: if its extent differs much from that of x1, it is scaled to it; thresholds are in pixels of x1.
            Gradients reach the points through the final fit.
        estimator: a preset of conf/estimator whose solver is `four_point`.
        mask, ratio, score, prior, lafs0, lafs1, noise, key, seed, config_dir: as of `find_fundamental`.
        size0, size1: image sizes (h, w), one for all pairs or (B, 2), in whose half diagonals lambda is.
        lens: calibrated lenses, "shared", "unknown", or lambda, exactly, as of `find_fundamental`. H is of the pixels
            of pinholes. An unknown lambda is zero unless the matches favour a lens; then there are no
            gradients.
        options: replace values of the preset (``inlier_threshold=1.5``).

    Returns:
        An `Estimate` whose `H` (B, 3, 3) has unit Frobenius norm and maps points that are seen to positive third
        coordinates; inliers, ok, reason, significance; lens (B, 2), lambdas, where there are any. Mirrored planes and
        photographs have theirs, too. Where as many inliers are to be expected by chance, `ok` is False.

    Raises:
        ValueError, TypeError: as `find_fundamental`.

    Example:
        >>> import torch, fmtorch
        >>> generator = torch.Generator().manual_seed(0)
        >>> x0 = 600 * torch.rand(60, 2, generator=generator, dtype=torch.float64)
        >>> x1 = x0 @ torch.tensor([[0.9, 0.1], [-0.1, 0.9]], dtype=torch.float64) + 20
        >>> x1[:20] = x1[:20].flip(0)                            # twenty wrong matches
        >>> estimate = fmtorch.find_homography(x0, x1)
        >>> bool(estimate.ok[0]), int(estimate.inliers[0, 20:].sum()), tuple(estimate.H.shape)
        (True, 40, (1, 3, 3))
    """
    lenses = None if lens is None else _lenses(lens, x0)
    if lenses is None and lens is not None and size0 is None:
        raise ValueError("lens needs the image sizes, in whose half diagonals it is: give size0 and size1")
    plane = lens is None if lenses is None else all(pair[0] is None for pair in lenses.pairs)
    c = correspondences(
        x0, x1, plane=plane, mask=mask, ratio=ratio, score=score, prior=prior, lafs0=lafs0, lafs1=lafs1, noise=noise,
        size0=size0, size1=size1, lens=None if lenses is not None else lens, key=key,
    )  # fmt: skip

    def find(c: Correspondences) -> Estimate:
        return homographies(c, lambda c: estimated(c, "homography", estimator, config_dir, seed, options))

    if c.lens is not None:
        from fmtorch.two_view.lenses import homographies_with_lenses

        return homographies_with_lenses(c, find)
    seen = (c if lenses is None else lenses.undistorted(c)).derived(size0=None, size1=None)
    if lenses is None:
        return find(seen)
    return lenses.completed(find(seen), c, seen)


# Homographies of planes in any unit, seen from either side, and whether their support is beyond chance

COMPARABLE = 3.0  # factor between the extents of both images' points, beyond which x0 is in the unit of a plane
FAR = 10.0  # extents from the origin, as of maps, beyond which points are taken from their middle
SAMPLE = 4  # matches that any homography agrees with


def homographies(c: Correspondences, find: Callable[[Correspondences], Estimate]) -> Estimate:
    """Homographies by an estimator that keeps orientations, of either orientation: the better supported one.
    A plane whose y points up, and a mirrored photograph, turn over where they are seen. That is searched for where most
    matches disagree with the first estimate. x0 in the unit of a plane is scaled to the extent of x1, since thresholds
    are in its pixels. An estimate whose support is that of chance is not ok."""
    scale, middle = _unit_of_plane(c)
    changed = (scale != 1) | (middle != 0).any(1)
    seen = _moved(c, scale, middle) if bool(changed.any()) else c
    estimate = find(seen)
    rows = (2 * estimate.inliers.sum(1) <= seen.count()).nonzero()[:, 0]
    if len(rows):
        part, up = seen[rows], seen.x0.new_tensor([1.0, -1.0])  # with y of image 0 turned over
        lafs = None if part.lafs0 is None else part.lafs0 * up.to(part.lafs0)[:, None]
        estimate = _better(estimate, find(part.derived(x0=part.x0 * up, lafs0=lafs)), rows)
    estimate = _beyond_chance(estimate, c)
    if not bool(changed.any()):
        return estimate
    s, (x, y) = scale.to(estimate.H)[:, None], middle.to(estimate.H).unbind(1)
    a, b, d = estimate.H.unbind(2)
    H = unit_frobenius(torch.stack([a * s, b * s, d - s * (a * x[:, None] + b * y[:, None])], 2))
    return estimate.derived(matrix=torch.where(changed[:, None, None], H, estimate.H))


def _unit_of_plane(c: Correspondences) -> tuple[Float[Tensor, " b"], Float[Tensor, "b 2"]]:
    """What x0 is multiplied by, after its middle is the origin; 1 and zero where both are as of two images."""
    boxes = box_of(c.x0, c.mask), box_of(c.x1, c.mask)
    extents = [(box.high - box.low).amax(1) for box in boxes]
    ratio = extents[1] / extents[0]
    sound = ratio.isfinite() & (ratio > 0)
    plane = sound & ((ratio > COMPARABLE) | (ratio < 1 / COMPARABLE))
    middle = (boxes[0].low + boxes[0].high) / 2
    far = sound & (middle.abs().amax(1) > FAR * extents[0])
    return torch.where(plane, ratio, 1.0), torch.where((plane | far)[:, None], middle, 0.0)


def _moved(c: Correspondences, scale: Tensor, middle: Tensor) -> Correspondences:
    x0 = (c.x0 - middle[:, None]) * scale[:, None, None]
    if (lafs := c.lafs0) is not None:
        shift = torch.nn.functional.pad(middle[:, None, :, None], (2, 0))  # of centres alone
        lafs = ((lafs - shift) * scale[:, None, None, None]).to(lafs)
    return c.derived(x0=x0, lafs0=lafs)


def _better(estimate: Estimate, mirrored: Estimate, rows: Tensor) -> Estimate:
    """The estimates, of these rows the mirrored one where that has more inliers."""
    better = mirrored.inliers.sum(1) > estimate.inliers[rows].sum(1)
    both = collate([estimate, mirrored.derived(matrix=mirrored.H * mirrored.H.new_tensor([1.0, -1.0, 1.0]))])
    place = torch.arange(len(estimate), device=rows.device)
    place[rows[better]] = len(estimate) + better.nonzero()[:, 0]
    return both[place].derived(samples=estimate.samples.index_add(0, rows, mirrored.samples))


def _beyond_chance(estimate: Estimate, c: Correspondences) -> Estimate:
    """The estimates, not ok where one with as many inliers is to be expected of matches of nothing in common."""
    assert estimate.significance is not None
    chance = estimate.ok & (estimate.significance < 0) & (c.count() > SAMPLE)
    if not bool(chance.any()):
        return estimate
    reasons = list(estimate.reason)
    for i in chance.nonzero()[:, 0].tolist():
        agree, matches = int(estimate.inliers[i].sum()), int(c.mask[i].sum())
        reasons[i] = f"{agree} of {matches} matches agree with a homography, no more than by chance"
    H, value = torch.where(chance[:, None, None], 0, estimate.H), torch.where(chance, -torch.inf, estimate.significance)
    fields = {"inliers": estimate.inliers & ~chance[:, None], "ok": estimate.ok & ~chance, "reason": tuple(reasons)}
    return estimate.derived(matrix=H, significance=value, **fields)
