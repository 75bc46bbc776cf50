"""The two-line replacements for `cv2.findFundamentalMat` and `cv2.findHomography`."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch import presets
from fmtorch.compiling import switch
from fmtorch.compiling.together import compile_together
from fmtorch.core.arguments import Arrays, correspondences, number
from fmtorch.core.checks import expect_values
from fmtorch.core.stages import Estimator, Pruner, model_of
from fmtorch.core.threads import one_thread
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.geometry.verdict import judged


def find_fundamental(
    x0: Arrays,
    x1: Arrays,
    *,
    estimator: str = "fmtorch",
    mask: Arrays | None = None,
    quality: Arrays | None = None,
    prior: Arrays | None = None,
    lafs0: Arrays | None = None,
    lafs1: Arrays | None = None,
    noise: Arrays | None = None,
    size0: Arrays | None = None,
    size1: Arrays | None = None,
    key: Arrays | int | None = None,
    seed: int = 0,
    config_dir: Path | str | None = None,
    **options: Any,
) -> Estimate:
    """Robustly estimate fundamental matrices from matched points, ``x1^T F x0 = 0``.

    Args:
        x0, x1: matched points in pixels, NumPy or torch, on any device: (N, 2) for one pair, (B, N, 2) for a padded
            batch, or a list of (N, 2) for pairs of different lengths. Gradients reach them through the final fit.
        estimator: a preset of conf/estimator.
        mask: (B, N), True for real matches; all when not given. Like all that is told of matches it may come without
            the leading B for one pair, and comes as a list where the points do.
        quality: (B, N), the matcher's figure, smaller is better (a distance ratio).
        prior: (B, N), P(inlier) in [0, 1]. Where an estimator uses a prior and none is given, it is derived from the
            frames and the quality, if both are given, otherwise from the points and, if given, the quality.
        lafs0, lafs1: (B, N, 2, 3) local affine frames.
        noise: (B, N), each match's standard deviation relative to a usual one's (`fmtorch.pruning.MatchNoise` derives
            it from frames).
        size0, size1: image sizes (h, w), one for all pairs or (B, 2).
        key: (B,) int64, selects each pair's random numbers.
        seed: of the random numbers.
        config_dir: a folder with presets of your own, ``<config_dir>/estimator/<name>.yaml``, which come first.
        options: replace values of the preset (``threshold=0.5``).

    Returns:
        An `Estimate` of B pairs (of one pair for (N, 2) points, of none for an empty list), with F of unit Frobenius
        norm, inliers, ok, reason, significance. A pair that cannot be solved is ``ok=False``, never an exception. An F
        that is ok may be of images that show nothing in common: `related` tells.

    Raises:
        ValueError: for points of another shape, a prior outside [0, 1], a noise or an image size that is not positive,
            the size of one image only, an unknown preset or an unknown option, and an estimator of another model.
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
    c = correspondences(
        x0, x1, mask=mask, quality=quality, prior=prior, lafs0=lafs0, lafs1=lafs1, noise=noise, size0=size0,
        size1=size1, key=key,
    )  # fmt: skip
    return _estimated(c, "fundamental", estimator, config_dir, seed, options)


def find_homography(
    x0: Arrays,
    x1: Arrays,
    *,
    estimator: str = "homography",
    mask: Arrays | None = None,
    quality: Arrays | None = None,
    prior: Arrays | None = None,
    lafs0: Arrays | None = None,
    lafs1: Arrays | None = None,
    noise: Arrays | None = None,
    key: Arrays | int | None = None,
    seed: int = 0,
    config_dir: Path | str | None = None,
    **options: Any,
) -> Estimate:
    """Robustly estimate homographies from matched points, ``x1 ~ H x0``: of a plane, or of a camera that turns.

    Args:
        x0, x1: matched points in pixels, as of `find_fundamental`. Gradients reach them through the final fit.
        estimator: a preset of conf/estimator whose solver is `four_point`.
        mask, quality, prior, lafs0, lafs1, noise, key, seed, config_dir: as of `find_fundamental`.
        options: replace values of the preset (``inlier_threshold=1.5``).

    Returns:
        An `Estimate` whose `H` (B, 3, 3) has unit Frobenius norm and maps points that are seen to positive third
        coordinates; inliers, ok, reason. Its significance is NaN where `ok`: that is a test of fundamental matrices.

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
    c = correspondences(x0, x1, mask=mask, quality=quality, prior=prior, lafs0=lafs0, lafs1=lafs1, noise=noise, key=key)
    return _estimated(c, "homography", estimator, config_dir, seed, options)


def _estimated(
    c: Correspondences, model: str, name: str, config_dir: Path | str | None, seed: int, options: Mapping[str, Any]
) -> Estimate:
    """The estimate of matches by a preset, with a prior of their consistency where it uses one and none is given."""
    expect_values(c)
    seed = int(number("seed", seed, whole=True))
    estimator = _estimator(name, config_dir, options)
    if (gives := model_of(estimator)) != model:
        raise ValueError(f"estimator={name} gives {gives} matrices; find_{model} needs one that gives {model} matrices")
    if c.prior is None and getattr(estimator, "uses_prior", False):
        framed = c.lafs0 is not None and c.lafs1 is not None and c.quality is not None
        pruner = _consistency("frame_consistency" if framed else "position_consistency")
        if switch.available():
            compile_together([*getattr(pruner, "kernels", ()), *getattr(estimator, "kernels", ())])
        with one_thread(c.mask.device):
            c = pruner(c)
    return judged(estimator(c, seed), c)


def _estimator(name: str, config_dir: Path | str | None, options: Mapping[str, Any]) -> Estimator:
    """The estimator of a preset, built but once where its options are plain values and its file is not a user's."""
    plain = _plain(options)
    if config_dir is None:
        try:
            return _built(name, json.dumps(plain, sort_keys=True))
        except TypeError:  # an option is an object of some kind
            pass
    built: Estimator = presets.build("estimator", name, config_dir, **plain)
    return built


@functools.lru_cache(maxsize=64)
def _built(name: str, options: str) -> Estimator:
    built: Estimator = presets.build("estimator", name, **json.loads(options))
    return built


def _plain(value: Any) -> Any:
    """The value with numbers of NumPy as Python's, at any depth."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value


@functools.lru_cache(maxsize=2)
def _consistency(name: str) -> Pruner:
    built: Pruner = presets.build("pruner", name)
    return built
