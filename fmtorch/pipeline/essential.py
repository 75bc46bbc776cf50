"""The two-line replacement for `cv2.findEssentialMat` and `cv2.recoverPose`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fmtorch.core.arguments import Arrays
from fmtorch.core.types import Estimate
from fmtorch.pipeline.camera_arguments import Focal
from fmtorch.pipeline.fundamental import find_fundamental


def find_essential(
    x0: Arrays,
    x1: Arrays,
    K0: Arrays,
    K1: Arrays,
    *,
    focal: Focal = None,
    estimator: str = "fmtorch",
    mask: Arrays | None = None,
    quality: Arrays | None = None,
    prior: Arrays | None = None,
    lafs0: Arrays | None = None,
    lafs1: Arrays | None = None,
    noise: Arrays | None = None,
    size0: Arrays | None = None,
    size1: Arrays | None = None,
    covariance: bool = False,
    configuration: bool = False,
    key: Arrays | int | None = None,
    seed: int = 0,
    config_dir: Path | str | None = None,
    **options: Any,
) -> Estimate:
    """Robustly estimate the relative pose of two calibrated cameras: ``X1 = R X0 + t`` and ``E = [t]_x R``.

    Args:
        x0, x1: matched points in pixels, as of `find_fundamental`; or normalised ones, with K the identity, of which
            thresholds count as pixels of a camera with a focal length of 1000 px.
        K0, K1: calibration matrices in the unit of the points, (3, 3) for all pairs or (B, 3, 3). Pixels need not be
            square nor principal points central; lenses must not distort.
        focal: how well the focal lengths of K0 and K1 are known: None for exactly, or their relative standard
            deviation, one number, (s0, s1) or (B, 2); 0.05 suits EXIF; "shared" or "unknown" where K tells principal
            points and the shape of pixels alone. What is not exact is estimated.
        size0, size1: image sizes (h, w), one for all pairs or (B, 2). Twice the principal point when not given.
        estimator, mask, quality, prior, lafs0, lafs1, noise, covariance, configuration, key, seed, config_dir: as of
            `find_fundamental`.
        options: replace values of the preset (``inlier_threshold=1.0``).

    Returns:
        An `Estimate` with R (B, 3, 3), t (B, 3) of unit length with the inliers in front of both cameras, E (B, 3, 3),
        focals (B, 2) and F. NaN where there is no pose. Gradients of all reach the points, prior, noise, K0 and K1.
        Six matches are enough where K0 and K1 are exact, otherwise seven.

    Raises:
        ValueError: as `find_fundamental`; for a K0 or K1 of a single pair that is singular, not in pixels, or whose
            principal point lies outside an image of known size. In a batch that pair is ``ok=False`` with a reason.
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
    for name, K in (("K0", K0), ("K1", K1)):
        if K is None:
            raise ValueError(f"{name} is None; find_fundamental estimates pairs of which one camera or none is known")
    return find_fundamental(
        x0, x1, estimator=estimator, mask=mask, quality=quality, prior=prior, lafs0=lafs0, lafs1=lafs1, noise=noise,
        size0=size0, size1=size1, K0=K0, K1=K1, focal=focal, covariance=covariance, configuration=configuration,
        key=key, seed=seed, config_dir=config_dir, **options,
    )  # fmt: skip
