"""One estimator call as the public functions make it: preset, prior, cameras, verdict."""

import functools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from jaxtyping import Bool, Float

from fmtorch.core.checks import box_of, number
from fmtorch.core.stages import Estimator, Pruner, calling, model_of, output_of
from fmtorch.core.types import Correspondences, Estimate, collate
from fmtorch.estimators.ransac import Ransac
from fmtorch.geometry.significance import judged
from fmtorch.jit.kernel import compile_together
from fmtorch.jobs.execution import one_thread
from fmtorch.presets.files import construct, instantiate, load, merged
from fmtorch.pruning.consistency import FrameConsistency, PositionConsistency
from fmtorch.two_view.arguments import MIN_PIXELS, Arrays, expect_lenses
from fmtorch.two_view.known_cameras import KnownCameras

RANSAC = f"fmtorch.estimators.{Ransac.__name__}"  # the `_target_` of presets of this project's own engine


def estimated(
    c: Correspondences, model: str, name: str, config_dir: Path | str | None, seed: int, options: Mapping[str, Any],
    covariance: bool = False, assume_sizes: bool = False,
) -> Estimate:  # fmt: skip
    """The estimate of matches by a preset, with a prior of their consistency where it uses one and none is given.
    model: what the preset must estimate. What is known of cameras counts where `focal` or `shared_focal` is given; then
    the estimate may have a covariance. assume_sizes: whether sizes that are not given may be taken from the points."""
    seed = int(number("seed", seed, integer=True))
    if not isinstance(name, str):
        raise TypeError(f"estimator is of type {type(name).__name__}; it must be the name of a preset")
    estimator = estimator_of(name, config_dir, options)
    _expect_gradients(c, estimator, name)
    if (gives := model_of(estimator)) != model:
        option = f" (here by model={model})" if "model" in load("estimator", name, config_dir) else ""
        needed = f"find_{model} needs one that gives {model} matrices{option}"
        raise ValueError(f"estimator={name} gives {gives} matrices; {needed}")
    if c.lens is not None:
        expect_lenses(estimator, f"estimator={name}")
    return estimated_by(estimator, c, seed, covariance, assume_sizes)


def estimated_by(
    estimator: Estimator, c: Correspondences, seed: int, covariance: bool = False, assume_sizes: bool = False
) -> Estimate:
    """The same of an estimator that is built, and of values that are known to be right."""
    if not c.asks_for_cameras:
        c = _with_prior(c, estimator)
        if assume_sizes and c.size0 is None and getattr(estimator, "assumes_cameras", False):
            return with_assumed_sizes(c, lambda sized: _judged(estimator, sized, seed))
        return _judged(estimator, c, seed)
    return KnownCameras(estimator, functools.partial(_with_prior, estimator=estimator), covariance)(c, seed)


def _judged(estimator: Estimator, c: Correspondences, seed: int) -> Estimate:
    """The estimate of an estimator, which may be anybody's, with its significance."""
    with calling("c, seed=0", estimator, c, seed):
        estimate = estimator(c, seed)
    return judged(output_of(estimator, estimate, Estimate, c), c)


def _expect_gradients(c: Correspondences, estimator: Estimator, name: str) -> None:
    """Raise ValueError naming a field that requires a gradient which the estimator does not give."""
    reached = getattr(estimator, "gradients_reach", None)
    if reached is None or not (torch.is_grad_enabled() and c.requires_grad):
        return
    derived = "prior" in reached and getattr(estimator, "uses_prior", False)  # a prior, of ratio or score
    for field in ("x0", "x1", "noise", *(("prior",) if c.prior is not None or derived else ("ratio", "score"))):
        value = getattr(c, field)
        if value is not None and value.requires_grad and field not in reached:
            raise ValueError(
                f"{field} requires a gradient, and the final fit of estimator={name} passes none to it: "
                f"give {field}.detach(), or take another (estimator=fmtorch, or the option final=gauss_newton)"
            )


def _with_prior(c: Correspondences, estimator: Estimator) -> Correspondences:
    """The matches with a prior of their consistency where the estimator uses one and none is given."""
    if c.prior is None and getattr(estimator, "uses_prior", False):
        pruner = _consistency(c.lafs0 is not None and c.lafs1 is not None and c.ratio is not None)
        compile_together([*getattr(pruner, "kernels", ()), *getattr(estimator, "kernels", ())])
        with one_thread(c.mask.device):
            return pruner(c)
    return c


def estimator_of(name: str, config_dir: Path | str | None, options: Mapping[str, Any]) -> Estimator:
    """The estimator of a preset, built but once where its options are plain values and its file is not a user's."""
    plain = _plain(options)
    if config_dir is None:
        try:
            return _kept(name, json.dumps(plain, sort_keys=True))
        except TypeError:  # an option is an object of some kind
            pass
    return _built(name, config_dir, plain)


@functools.lru_cache(maxsize=64)
def _kept(name: str, options: str) -> Estimator:
    return _built(name, None, json.loads(options))


def _built(name: str, config_dir: Path | str | None, options: Mapping[str, Any]) -> Estimator:
    config, where = merged(load("estimator", name, config_dir), options), f"estimator={name}"
    if config.get("_target_") == RANSAC:
        return construct(Ransac, config, where)
    built: Estimator = instantiate(config, where)
    return built


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value


@functools.cache
def _consistency(framed: bool) -> Pruner:
    """The prior of matches with frames and ratios, or of points alone, with the constants of its preset."""
    if framed:
        return construct(FrameConsistency, load("pruner", "frame_consistency"), "pruner=frame_consistency")
    return construct(PositionConsistency, load("pruner", "position_consistency"), "pruner=position_consistency")


# Sizes of images that nobody gave, assumed from the extent of their matched points

Size = Arrays | Literal["unknown"] | None
MIN_MATCHES = 20  # fewer say little of where an image ends
BORDER = -1.0  # px: coordinates below are not those of a photograph
MARGIN = 1.5  # of the extent over the number of points, by which the last point of evenly spread ones is off the border
SAME_SIZE = 1.1  # ratio of extents up to which images have one size
SQUARE = 1.2  # ratio of the sides of one size for both images, below which one of them is rather upright
TWO_SIZES_GAIN = 3.0  # of significance, from which on images have two


def given_sizes(size0: Size, size1: Size) -> tuple[Arrays | None, Arrays | None, bool]:
    """Sizes as `Correspondences` has them, and whether they may be assumed: they are neither given nor "unknown"."""
    for name, size in (("size0", size0), ("size1", size1)):
        if isinstance(size, str) and size != "unknown":
            raise ValueError(f"{name} is {size!r}; it must be (h, w), 'unknown' or None")
    if (size0 == "unknown") if isinstance(size0, str) else isinstance(size1, str):
        known = [name for name, size in (("size0", size0), ("size1", size1)) if not isinstance(size, str | None)]
        if known:
            wanted = "give the sizes of both images, or neither"
            raise ValueError(f"{known[0]} is given and the other is 'unknown'; {wanted}")
        return None, None, False
    assert not isinstance(size0, str)
    assert not isinstance(size1, str)
    return size0, size1, size0 is None and size1 is None


def extents(c: Correspondences) -> tuple[Float[torch.Tensor, "b 2 2"], Bool[torch.Tensor, " b"]]:
    """Sizes (h, w) of images whose points spread evenly up to the border, and of which pairs these tell any: of those
    whose points look like a photograph's. Centred, normalised and undistorted points have negative coordinates."""
    both = c.mask & c.x0.isfinite().all(-1) & c.x1.isfinite().all(-1)
    boxes = box_of(c.x0, both), box_of(c.x1, both)
    first, last = (torch.cat(ends, 1).double() for ends in zip(*(box[1:] for box in boxes), strict=True))
    count = both.sum(1, keepdim=True).to(last)
    known = (count >= MIN_MATCHES)[:, 0] & (first > BORDER).all(1) & (last > MIN_PIXELS).all(1)
    sizes = last * (1 + MARGIN / count.clamp_min(1)) + 0.5
    return torch.where(known[:, None], sizes, torch.nan).reshape(-1, 2, 2).flip(-1), known


def with_assumed_sizes(c: Correspondences, estimate: Callable[[Correspondences], Estimate]) -> Estimate:
    """The better estimate of each pair, with `sizes` and `sizes_doubtful`. estimate: of a batch, with significance.

    Keypoints reach near the border. Two images mostly come from one camera, so that the farther point of both tells the
    size of either; if one image is upright, that of their long and short sides. Where their extents differ by more than
    that, two sizes are tried as well, and the estimate that is more significant is taken. Pairs whose points tell no
    sizes are estimated without."""
    own, known = extents(c)
    square = own.amax(1).amax(1) < SQUARE * own.amax(1).amin(1)
    turned = (square & (own[..., 0] > own[..., 1]).sum(1).eq(1))[:, None]
    first = torch.maximum(own[:, 0], torch.where(turned, own[:, 1].flip(-1), own[:, 1]))
    same = torch.stack([first, torch.where(turned, first.flip(-1), first)], 1)
    doubtful = known & (same > SAME_SIZE * own).flatten(1).any(1)
    kinds = [(known, same), (~known, own), (doubtful, own)]
    tried = [(rows, sizes) for rows, sizes in kinds if bool(rows.any())] or kinds[1:2]
    together = collate([estimate(_sized(c, rows, sizes)) for rows, sizes in tried])
    row = torch.cat([rows.nonzero()[:, 0] for rows, _ in tried])
    place = torch.argsort(row[: len(c)])
    second = torch.arange(len(c), len(row), device=row.device)  # of the doubtful ones, of two sizes
    significance = cast(torch.Tensor, together.significance)
    better = together.ok[second] & ~(significance[second] - significance[place[doubtful]] <= TWO_SIZES_GAIN)
    place = place.masked_scatter(doubtful, torch.where(better, second, place[doubtful]))
    sizes, estimates = torch.cat([sizes[rows] for rows, sizes in tried]), together[place]
    lens = estimates.lens_suggested  # one is not told from wrong sizes
    lens = None if lens is None else lens.masked_fill(doubtful, torch.nan)
    return estimates.derived(sizes=sizes[place], sizes_doubtful=doubtful, lens_suggested=lens)


def _sized(c: Correspondences, rows: torch.Tensor, sizes: torch.Tensor) -> Correspondences:
    """Some pairs of a batch with their sizes, as they are where there are none."""
    c, sizes = (c, sizes) if bool(rows.all()) else (c[rows], sizes[rows])
    return c.derived(size0=sizes[:, 0], size1=sizes[:, 1]) if bool(sizes.isfinite().all()) else c
