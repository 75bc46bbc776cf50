"""The three laws as checks over anything that maps correspondences to a result. A new part joins by being registered.

1. Padding is invisible: garbage or NaN in masked slots changes nothing.
2. Neighbours are invisible: a pair's result does not depend on the batch it is in (bit-equal).
3. No pair can take its batch down: degenerate pairs are told apart and leave the others alone."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fmtorch import presets
from fmtorch.core import Correspondences, Estimator, ImagePruner, PairImages, Pruner, collate
from fmtorch.core.stages import grey_pyramid
from tests.variants import built, loaded, variants

NEEDED = {name: presets.files.peer_packages(loaded("estimator", name)) for name in variants("estimator")}
PEERS = {name: package for name, packages in NEEDED.items() for package in packages}
"""The packages of the extra `peers` that presets of estimators need, by the presets' names."""
SMALL_KINDS = ("collinear", "collinear in image 1", "planar", "coincident", "half coincident")

FEW_OF_PEERS = {"iterations": 1000, "min_iterations": 100, "rounds": 2}
Result = dict[str, Tensor]  # every value has the batch as its first dimension; masks (B, N) may be padded on the right
KNOWLEDGE: dict[str, Any] = {"exact": (0.0, 0.0), "rough": (0.05, 0.05), "one": (0.0, float("inf")), "shared": None}
"""Deviations of the two focal lengths, as parts of them; None: unknown and equal."""
SMALL_NETWORKS = {
    "fmtorch.pruning.networks.LC": {"channels": 16, "blocks": 2},
    "fmtorch.pruning.networks.DFE": {"widths": [16, 8], "iterations": 3},
    "fmtorch.pruning.networks.OANet": {"channels": 16, "blocks": 8, "clusters": 10},
    "fmtorch.pruning.networks.CLNet": {"channels": 16},
    "fmtorch.pruning.networks.NCMNet": {"channels": 16, "clusters": 10},
    "fmtorch.pruning.networks.ConvMatch": {"channels": 16, "layers": 2, "grid": 4},
}


@dataclasses.dataclass(frozen=True)
class Subject:
    """Something that keeps the laws: a function of correspondences with a result per pair."""

    name: str
    run: Callable[[Correspondences], Result]


def few(config: Mapping[str, Any], hypotheses: int = 200, round: int = 100) -> dict[str, Any]:
    """Options with which an estimator's preset does little in each of its stages."""
    if config["_target_"] == "fmtorch.estimators.Ransac":
        options = {"hypotheses": hypotheses, "round": round, "pool": min(config.get("pool", 1), 8)}
        if (config.get("refine") or {}).get("matches"):
            options["refine"] = {"matches": 64}  # fewer than a scene has
        return options | ({"focal": {"samples": 60, "rounds": 2, "min_rounds": 1}} if config.get("focal") else {})
    if config["_target_"] == "fmtorch.estimators.IterativelyReweighted":
        return {"starts": [0, 2], "iterations": 5, "refine_iterations": 5}
    own = {name: most for name, most in FEW_OF_PEERS.items() if name in config}
    return own | {key: few(value, hypotheses, round) for key, value in config.items() if isinstance(value, dict)}


def quick(name: str, hypotheses: int = 200, round: int = 100) -> Estimator:
    """An estimator preset that does little in each of its stages: the laws do not depend on how much."""
    estimator: Estimator = built("estimator", name, **few(loaded("estimator", name), hypotheses, round))
    return estimator


def quick_pruner(name: str) -> Pruner:
    """A pruner preset; a learned one with a small untrained network, on which the laws do not depend."""
    network = loaded("pruner", name).get("network")
    torch.manual_seed(7)  # with which about half of the matches have P > 0.5
    small: dict[str, Any] = {} if network is None else {"file": None, "network": SMALL_NETWORKS[network["_target_"]]}
    if name == "refine_matches":
        small = {"min_correlation": -1.0, "max_deviation": 100.0}  # scenes' points are anywhere in the images
    pruner: Pruner = built("pruner", name, **small)
    return shown(pruner)


def shown(pruner: Pruner) -> Pruner:
    """A pruner that gets two images of random grey levels where it looks at them, of the size of a `scene`."""
    return (lambda c: pruner.with_images(c, lambda pair: _images())) if isinstance(pruner, ImagePruner) else pruner


@functools.cache
def _images() -> PairImages:
    first, second = np.random.default_rng(0).integers(0, 256, (2, 160, 240)).astype(np.uint8).repeat(4, 1).repeat(4, 2)
    return grey_pyramid(first), grey_pyramid(second)


def calibrated(c: Correspondences) -> Correspondences:
    """The same pairs with the calibration matrices of `scene`, which some learned pruners need."""
    K = torch.tensor([[800.0, 0, 480], [0, 800, 320], [0, 0, 1]], device=c.mask.device).expand(len(c), 3, 3)
    return c.replace(K0=K, K1=K)


def with_knowledge(c: Correspondences, known: str) -> Correspondences:
    """The same pairs with the calibration of `scene` as far as it is known."""
    if known == "shared":
        return c.replace(shared_focal=torch.ones_like(c.mask[:, 0]))
    focal = torch.tensor([[[1.0, s] for s in KNOWLEDGE[known]]], device=c.mask.device).expand(len(c), 2, 2)
    c = calibrated(c).replace(focal=focal)
    return c.replace(K1=None) if known == "one" else c


@functools.cache
def scene(index: int, count: int = 150, outliers: float = 0.4, noise: float = 0.3) -> Correspondences:
    """One synthetic pair: a cloud of points before two cameras, with noise, outliers, ratios, frames and a key."""
    rng = np.random.default_rng(index)
    X = np.concatenate([rng.uniform(-2, 2, (count, 2)), rng.uniform(4, 9, (count, 1))], 1)
    angle = rng.uniform(-0.3, 0.3)
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    K = np.array([[800, 0, 480], [0, 800, 320], [0, 0, 1.0]])

    def project(points: np.ndarray) -> np.ndarray:
        pixel = points @ K.T
        return pixel[:, :2] / pixel[:, 2:]

    x0 = project(X) + rng.normal(0, noise, (count, 2))
    x1 = project(X @ R.T + rng.uniform(-1, 1, 3)) + rng.normal(0, noise, (count, 2))
    wrong = rng.random(count) < outliers
    x1[wrong] = rng.uniform([0, 0], [960, 640], (int(wrong.sum()), 2))
    ratio = np.where(wrong, rng.uniform(0.5, 0.95, count), rng.uniform(0.2, 0.8, count))
    frames = rng.normal(size=(2, count, 2, 3))
    frames[0, :, :, 2], frames[1, :, :, 2] = x0, x1

    def tensor(value: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(value, dtype=np.float32))[None]

    size = torch.tensor([[640, 960]])
    return Correspondences(
        tensor(x0), tensor(x1), torch.ones(1, count, dtype=torch.bool), ratio=tensor(ratio),
        prior=tensor(np.clip(1.2 - ratio, 0, 1)), lafs0=tensor(frames[0]), lafs1=tensor(frames[1]),
        size0=size, size1=size, key=torch.tensor([index + 1]), mutual=tensor(ratio) < 0.7,
    )  # fmt: skip


@functools.cache
def scenes() -> Correspondences:
    return collate([scene(i, count) for i, count in enumerate((150, 40, 333, 90, 150))])


def with_padding(c: Correspondences, rng: np.random.Generator, garbage: float) -> Correspondences:
    """The same matches in the same order, with garbage slots strewn in between."""
    b, n = c.mask.shape
    total = n + 61
    where = torch.stack([torch.from_numpy(np.sort(rng.choice(total, n, replace=False))) for _ in range(b)])

    def spread(value: Tensor) -> Tensor:
        filler = False if value.dtype == torch.bool else garbage
        out = torch.full((b, total, *value.shape[2:]), filler, dtype=value.dtype)
        index = where.reshape(b, n, *[1] * (value.dim() - 2)).expand(b, n, *value.shape[2:])
        return out.scatter(1, index, value)

    fields = ("x0", "x1", "mask", "ratio", "prior", "lafs0", "lafs1", "mutual", "noise")
    return c.replace(**{f: spread(getattr(c, f)) for f in fields if getattr(c, f) is not None})


def live_values(result: Result, c: Correspondences) -> Result:
    """Per-match values reduced to the live matches, in order, so that results under different paddings compare."""
    n = c.mask.shape[1]
    per_match = {k: v for k, v in result.items() if v.dim() >= 2 and v.shape[1] == n and k != "F"}
    rest = {k: v for k, v in result.items() if k not in per_match}
    return {**rest, **{k: v[c.mask] for k, v in per_match.items()}}


@functools.cache
def degenerate() -> dict[str, Correspondences]:
    good = scene(3)
    ratio = good.ratio
    assert ratio is not None
    n = good.x0.shape[1]
    line = torch.linspace(0, 600, n)
    collinear = torch.stack([line, 0.5 * line + 20], -1)[None]
    return {
        "empty": good.replace(mask=torch.zeros_like(good.mask)),
        "one match": good.replace(mask=torch.arange(n)[None] < 1),
        "seven matches": good.replace(mask=torch.arange(n)[None] < 7),
        "all points equal": good.replace(x0=torch.full_like(good.x0, 100), x1=torch.full_like(good.x1, 50)),
        "equal in one image": good.replace(x0=torch.full_like(good.x0, 100)),
        "collinear": good.replace(x0=collinear, x1=collinear + 5),
        "one plane": good.replace(x1=good.x0 * 1.1 + 3),
        "identity": good.replace(x1=good.x0),
        "all outliers": scene(4, outliers=1.0),
        "NaN": good.replace(x0=torch.full_like(good.x0, torch.nan)),
        "some NaN": good.replace(x1=torch.where(torch.arange(n)[None, :, None] % 3 == 0, torch.nan, good.x1)),
        "NaN ratio": good.replace(ratio=torch.where(torch.arange(n)[None] % 3 == 0, torch.nan, ratio)),
        "infinite": good.replace(x1=torch.full_like(good.x1, torch.inf)),
        "huge": good.replace(x0=good.x0 * 1e6, x1=good.x1 * 1e6),
        "tiny": good.replace(x0=good.x0 * 1e-6, x1=good.x1 * 1e-6),
    }


@functools.cache
def small() -> dict[str, Correspondences]:
    """Pairs of few matches, from a minimal sample to 20: random ones, and those that determine no model."""

    def pair(kind: str, count: int) -> Correspondences:
        rng = np.random.default_rng([count, len(kind)])
        x0, x1 = rng.uniform([0, 0], [960, 640], (2, count, 2))
        along = rng.integers(0, 600, count)[:, None] * [1, 0.5] + [0, 20]  # exact in float32
        if kind.startswith("collinear"):
            x0, x1 = along if kind != "collinear in image 1" else x0, along + 5 if kind == "collinear" else along[::-1]
        if kind == "planar":
            plane = np.c_[x0, np.ones(count)] @ np.array([[1.1, -0.03, 1e-5], [0.02, 0.95, 2e-5], [5, 9, 1]])
            x1 = plane[:, :2] / plane[:, 2:]
        if kind == "coincident":
            x0, x1 = np.full_like(x0, 7), np.full_like(x1, 9)
        if kind == "half coincident":
            x0[count // 2 :], x1[count // 2 :] = x0[0], x1[0]
        known = scene(count, count)
        assert known.lafs0 is not None
        assert known.lafs1 is not None
        lafs0, lafs1 = known.lafs0.clone(), known.lafs1.clone()
        points = [torch.from_numpy(x.astype(np.float32))[None] for x in (x0, x1)]
        lafs0[..., 2], lafs1[..., 2] = points
        return known.replace(x0=points[0], x1=points[1], lafs0=lafs0, lafs1=lafs1)

    counts = {"random": (7, 8, 9, 12, 16, 20), **dict.fromkeys(SMALL_KINDS, (8, 20))}
    return {f"{count} {kind}": pair(kind, count) for kind, sizes in counts.items() for count in sizes}


def assert_same(a: Result, b: Result, what: str) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].shape == b[name].shape, f"{what}: {name} has shapes {a[name].shape} and {b[name].shape}"
        same = (a[name] == b[name]) | ((a[name] != a[name]) & (b[name] != b[name]))
        assert bool(same.all()), f"{what}: {name} differs"
