"""The three laws over the batched functions of geometry and metrics, and over their gradients."""

import functools
from collections import namedtuple
from collections.abc import Callable
from typing import Any, Self

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch import geometry, metrics
from fmtorch.geometry.pair_type import pair_evidence
from tests.geometry.scenes import scene

SLOTS = 40
PER_MATCH = ("x0", "x1", "weight", "noise", "mask")


class Pairs(namedtuple("Pairs", "x0 x1 weight noise mask F H K0 K1 R t key")):
    """Matches, models and cameras of B pairs: tensors."""

    def map(self, function: Callable[[Tensor], Tensor]) -> Self:
        return self._make(map(function, self))


@functools.cache
def pairs() -> Pairs:
    """Pairs of different numbers of matches, the last slots of which are masked."""
    many = [scene(SLOTS, seed, noise=0.5) for seed in range(5)]
    x0, x1, F, K0, K1, R, t = (torch.stack(list(values)) for values in zip(*many, strict=True))
    weight, noise = (torch.from_numpy(v) for v in np.random.default_rng(0).uniform(0.5, 1, (2, 5, SLOTS)))
    mask = torch.arange(SLOTS) < torch.tensor([[SLOTS], [25], [33], [12], [SLOTS]])
    H = geometry.homography(x0, x1, mask=mask)[0]
    return Pairs(x0, x1, weight, noise, mask, F, H, K0, K1, R, t, torch.arange(5))


def sizes(p: Pairs) -> dict[str, Tensor]:
    size = torch.tensor([[800, 1000]], device=p.F.device).expand(len(p.F), 2)
    return {"size0": size, "size1": size}


def fits(p: Pairs) -> Any:
    def weigh(F: Tensor | None, residual: Tensor | None) -> Tensor:
        return p.weight if residual is None else p.weight / (1 + residual.square())

    return tuple(value.movedim(0, 1) for value in geometry.reweighted_fits(p.x0, p.x1, weigh, 2, p.mask))


def covariance(p: Pairs) -> Any:
    focal, principal = torch.stack([p.K0[:, 0, 0], p.K1[:, 0, 0]], 1), (p.K0[:, :2, 2], p.K1[:, :2, 2])
    cutoff, precision = torch.full_like(focal[:, 0], 4.0), torch.diag_embed(0 * focal + 4)
    return geometry.two_view_covariance(
        p.x0, p.x1, p.R, p.t, focal, *principal, cutoff, p.weight, p.noise, p.mask, focal_precision=precision
    )


def evidence(p: Pairs) -> Any:
    precision = torch.diag_embed(torch.full_like(p.F[:, 0, :2], 2500.0))
    cameras = {"K0": p.K0, "K1": p.K1, "focal_precision": precision}
    return pair_evidence(p.F, p.H, p.x0, p.x1, p.mask, noise=p.noise, prior=p.weight, **sizes(p), **cameras)


def sampled(name: str) -> Callable[[Pairs], Any]:
    def distance(p: Pairs) -> Any:
        other = p.F + 1e-3 * p.F.detach().nan_to_num().flip(-1)
        return getattr(metrics, name)(p.F.detach(), other, **sizes(p), key=p.key, samples=50)

    return distance


def of_distances(name: str) -> Callable[[Pairs], Any]:
    model = "H" if name.startswith("homography") else "F"
    return lambda p: getattr(geometry, name)(getattr(p, model), p.x0, p.x1)


DISTANCES = (
    "algebraic", "epipolar_distances", "homography_sampson", "homography_transfer", "sampson", "sampson_squared",
    "symmetric_max", "symmetric_mean", "symmetric_squared",
)  # fmt: skip
FUNCTIONS: dict[str, Callable[[Pairs], Any]] = {
    **{name: of_distances(name) for name in DISTANCES},
    **{name: sampled(name) for name in ("nsgd", "nsgd_released", "sgd")},
    "attached_step": lambda p: geometry.attached_step(p.F, p.x0, p.x1, p.weight, p.mask, scale=2.0),
    "canonical": lambda p: geometry.canonical(p.F),
    "closest_pose_error": lambda p: metrics.closest_pose_error(p.F, p.K0, p.K1, p.R, p.t),
    "pair_evidence": evidence,
    "corner_error": lambda p: metrics.corner_error(p.H, p.H.detach() + 1e-6, sizes(p)["size0"]),
    "eight_point": lambda p: geometry.eight_point(p.x0, p.x1, p.weight, p.mask),
    "fundamental_from_calibration": lambda p: geometry.fundamental_from_calibration(p.K0, p.K1, p.R, p.t),
    "fundamental_pose_error": lambda p: metrics.fundamental_pose_error(p.F, p.K0, p.K1, p.x0, p.x1, p.R, p.t, p.mask),
    "homography": lambda p: geometry.homography(p.x0, p.x1, p.weight, p.mask),
    "inlier_rate": lambda p: metrics.inlier_rate(p.F, p.x0, p.x1, p.noise > 0.7, **sizes(p), mask=p.mask),
    "irls": lambda p: geometry.irls(p.x0, p.x1, p.F, p.weight, p.mask, scale=2.0, iterations=4),
    "nearest_rank2": lambda p: geometry.nearest_rank2(p.H),
    "normalize_points": lambda p: geometry.normalize_points(p.x0, p.mask, p.weight),
    "pose_error": lambda p: metrics.pose_error(p.R, p.t, p.R.detach().mT, p.t.detach().flip(-1)),
    "pose_from_fundamental": lambda p: geometry.pose_from_fundamental(p.F, p.K0, p.K1, p.x0, p.x1, p.mask, p.weight),
    "poses_from_homography": lambda p: geometry.poses_from_homography(p.H, p.K0, p.K1, p.x0, p.x1, p.mask),
    "refine": lambda p: geometry.refine(p.F, p.x0, p.x1, p.weight, p.mask, loss="cauchy", scale=2.0),
    "refine_homography": lambda p: geometry.refine_homography(p.H, p.x0, p.x1, p.weight, p.mask, scale=20.0),
    "reweighted_fits": fits,
    "right_of_homography": lambda p: metrics.right_of_homography(p.H, p.x0, p.x1, mask=p.mask),
    "seven_point": lambda p: geometry.seven_point(p.x0[:, 1:8], p.x1[:, 1:8]),
    "significance": lambda p: geometry.significance(p.F, p.x0, p.x1, p.mask, **sizes(p)),
    "two_view_covariance": covariance,
}


AS_THEY_ARE = (*DISTANCES, "normalize_points", "reweighted_fits")
"""Functions of which a gradient is NaN where points or weights are."""


def bad() -> dict[str, Pairs]:
    """Pairs with which nothing can be done, or only by luck."""
    p = pairs().map(lambda value: value[:1])
    line = torch.linspace(0, 600, SLOTS, dtype=torch.float64)[None, :, None] * torch.tensor([1.0, 0.5])
    third = torch.arange(SLOTS)[None, :] % 3 == 0
    return {
        "all points equal": p._replace(x0=0 * p.x0 + 100, x1=0 * p.x1 + 50),
        "equal in one image": p._replace(x0=0 * p.x0 + 100),
        "collinear": p._replace(x0=line, x1=line + 5),
        "one plane": p._replace(x1=p.x0 * 1.1 + 3),
        "identity": p._replace(x1=p.x0),
        "no matches": p._replace(mask=p.mask & False),
        "no weight": p._replace(weight=0 * p.weight),
        "a weight that is NaN": p._replace(weight=torch.where(third, torch.nan, p.weight)),
        "NaN": p._replace(x0=p.x0 * torch.nan),
        "some NaN": p._replace(x1=torch.where(third[..., None], torch.nan, p.x1)),
        "infinite": p._replace(x1=p.x1 * torch.inf),
        "huge": p._replace(x0=p.x0 * 1e9, x1=p.x1 * 1e9),
        "tiny": p._replace(x0=p.x0 * 1e-9, x1=p.x1 * 1e-9),
        "zero models": p._replace(F=0 * p.F, H=0 * p.H),
        "models that are NaN": p._replace(F=p.F * torch.nan, H=p.H * torch.nan),
        "models of rank one": p._replace(F=p.F[:, :1] * p.F[:, :1].mT, H=p.H[:, :1] * p.H[:, :1].mT),
        "zero cameras": p._replace(K0=0 * p.K0, t=0 * p.t),
        "cameras that are NaN": p._replace(K1=p.K1 * torch.nan, R=p.R * torch.nan),
    }


def differentiated(name: str, p: Pairs, rows: slice) -> tuple[list[Tensor], dict[str, Tensor]]:
    """The values of these rows, of matches only where they are not masked, and the gradients of their sum."""
    attached = p.map(lambda value: value.clone().requires_grad_() if value.is_floating_point() else value)
    result = FUNCTIONS[name](attached)
    values = [value[rows] for value in ([result] if isinstance(result, Tensor) else list(result))]
    slots = p.mask.shape[1]
    values = [v[p.mask[rows]] if v.dim() > 1 and v.shape[1] == slots else v for v in values]
    total = [v.sum() for v in values if v.requires_grad]
    leaves = {field: value for field, value in attached._asdict().items() if value.is_floating_point()}
    if not total:
        return values, {}
    gradients = torch.autograd.grad(sum(total), list(leaves.values()), allow_unused=True)
    pairs_of = dict(zip(leaves, gradients, strict=True))
    return [v.detach() for v in values], {field: g for field, g in pairs_of.items() if g is not None}


def assert_as_alone(name: str, p: Pairs, rows: slice, alone: Pairs) -> None:
    """The same bits; gradients, whose sums over paddings of other lengths are rounded otherwise, nearly."""
    values, gradients = differentiated(name, p, rows)
    expected, own = differentiated(name, alone, slice(None))
    for value, other in zip(values, expected, strict=True):
        torch.testing.assert_close(value, other, rtol=0, atol=0, equal_nan=True)
    for field, gradient in own.items():
        together = gradients[field][rows]
        if field in PER_MATCH:
            assert not bool(together[~p.mask[rows]].any()), field
            together, gradient = together[p.mask[rows]], gradient[alone.mask]
        atol = 1e-8 * float(gradient.abs().amax())
        torch.testing.assert_close(together, gradient, rtol=1e-7, atol=atol)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_padding_and_neighbours_are_invisible(name: str) -> None:
    """What is masked is NaN, and of any number."""
    p = pairs() if name not in DISTANCES else pairs()._replace(mask=torch.ones(5, SLOTS, dtype=torch.bool))
    counts = p.mask.sum(1).tolist()
    garbage = {f: torch.full_like(getattr(p, f)[:, :7], torch.nan) for f in PER_MATCH if f != "mask"}
    wide = {f: torch.cat([getattr(p, f), value], 1) for f, value in garbage.items()}
    wide["mask"] = torch.nn.functional.pad(p.mask, (0, 7))
    masked = {f: torch.where(wide["mask"].view(5, -1, *[1] * (v.dim() - 2)), v, torch.nan) for f, v in wide.items()}
    padded = p._replace(**masked | {"mask": wide["mask"]}) if name not in DISTANCES else p
    for i, n in enumerate(counts):
        row = p.map(lambda value, i=i: value[i : i + 1])  # type: ignore[misc]
        alone = row._replace(**{field: getattr(row, field)[:, :n] for field in PER_MATCH})
        assert_as_alone(name, padded, slice(i, i + 1), alone)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_no_pair_takes_its_batch_down(name: str) -> None:
    good, kinds = pairs().map(lambda value: value[:1]), bad()
    together = Pairs(*(torch.cat([*values, values[0]]) for values in zip(good, *kinds.values(), strict=True)))
    for row in (slice(0, 1), slice(len(kinds) + 1, None)):
        assert_as_alone(name, together, row, good)
    _, gradients = differentiated(name, together, slice(None))
    odd = ("models", "cameras", *(("NaN", "infinite") if name in AS_THEY_ARE else ()))
    rest = [0, *(k for k, kind in enumerate(kinds, 1) if not any(word in kind for word in odd))]
    for field, gradient in gradients.items():
        assert bool(gradient[rest].isfinite().all()), field
