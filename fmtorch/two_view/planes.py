"""Homographies of planes in any unit, seen from either side, and whether their support is beyond chance."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate
from fmtorch.geometry.epipolar import unit_frobenius

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
    s, (x, y) = scale.to(estimate.F)[:, None], middle.to(estimate.F).unbind(1)
    a, b, d = estimate.F.unbind(2)
    H = unit_frobenius(torch.stack([a * s, b * s, d - s * (a * x[:, None] + b * y[:, None])], 2))
    return estimate.derived(F=torch.where(changed[:, None, None], H, estimate.F))


def _unit_of_plane(c: Correspondences) -> tuple[Float[Tensor, " b"], Float[Tensor, "b 2"]]:
    """What x0 is multiplied by, after its middle is the origin; 1 and zero where both are as of two images."""
    boxes = []
    for x in (c.x0.detach(), c.x1.detach()):
        real = (c.mask & x.isfinite().all(-1))[..., None] & torch.ones_like(x, dtype=torch.bool)
        if not x.shape[1]:
            return x.new_ones(len(x)), x.new_zeros(len(x), 2)
        boxes.append((torch.where(real, x, torch.inf).amin(1), torch.where(real, x, -torch.inf).amax(1)))
    extents = [(high - low).amax(1) for low, high in boxes]
    ratio = extents[1] / extents[0]
    sound = ratio.isfinite() & (ratio > 0)
    plane = sound & ((ratio > COMPARABLE) | (ratio < 1 / COMPARABLE))
    middle = (boxes[0][0] + boxes[0][1]) / 2
    far = sound & (middle.abs().amax(1) > FAR * extents[0])
    return torch.where(plane, ratio, 1.0), torch.where((plane | far)[:, None], middle, 0.0)


def _moved(c: Correspondences, scale: Tensor, middle: Tensor) -> Correspondences:
    """The matches with x0 from its middle, scaled."""
    x0 = (c.x0 - middle[:, None]) * scale[:, None, None]
    lafs = c.lafs0
    if lafs is not None:
        shift = torch.stack([torch.zeros_like(middle), torch.zeros_like(middle), middle], -1)
        lafs = ((lafs - shift[:, None]) * scale[:, None, None, None]).to(lafs)
    return c.derived(x0=x0, lafs0=lafs)


def _better(estimate: Estimate, mirrored: Estimate, rows: Tensor) -> Estimate:
    """The estimates, of these rows the mirrored one where that has more inliers."""
    better = mirrored.inliers.sum(1) > estimate.inliers[rows].sum(1)
    taken, of = rows[better], mirrored[better]
    fields = {"samples": estimate.samples.index_add(0, rows, mirrored.samples)}
    for name in ("inliers", "ok", "significance"):
        fields[name] = getattr(estimate, name).index_copy(0, taken, getattr(of, name))
    turned = of.F * of.F.new_tensor([1.0, -1.0, 1.0])
    reasons = list(estimate.reason)
    for i, reason in zip(taken.tolist(), of.reason, strict=True):
        reasons[i] = reason
    return estimate.derived(F=estimate.F.index_copy(0, taken, turned), reason=tuple(reasons), **fields)


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
    F, inliers = torch.where(chance[:, None, None], 0, estimate.F), estimate.inliers & ~chance[:, None]
    value = torch.where(chance, -torch.inf, estimate.significance)
    return estimate.derived(F=F, inliers=inliers, ok=estimate.ok & ~chance, significance=value, reason=tuple(reasons))
