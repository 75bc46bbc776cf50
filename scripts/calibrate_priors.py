"""Fit the constants with which pruners' evidence becomes P(inlier), and say how well it tells inliers from outliers.

python scripts/calibrate_priors.py --root DATA/Strecha_train --root DATA/TanksLike --rendered small

For each stage that supplies a prior and each scene: the area under the ROC curve and the log loss, in nats a match, as
its preset stands. Then, with and without the distance ratio, the log loss with the constants of its `calibration`
fitted here (logistic regression, every pair with the same weight), and with constants fitted to the other scenes; and
the constants. Inliers are the matches within --threshold px (Sampson) of the true geometry.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from fmtorch import Correspondences, Pipeline, data, presets
from fmtorch.geometry import sampson

STAGES = ("ratio_prior", "gms", "lpm", "position_consistency", "frame_consistency", "code")
NEWTON_STEPS = 30
Array = NDArray[Any]
console = Console(width=None if sys.stdout.isatty() else 140)


class Pair(NamedTuple):
    """A matched pair of a scene, and which of its matches are right."""

    scene: str
    c: Correspondences
    right: Array


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", action="append", default=[], help="a set in the FM-Bench layout; may be repeated")
    parser.add_argument("--rendered", choices=["small", "full"], help="also the embedded training data, of this size")
    parser.add_argument("--stages", nargs="*", default=list(STAGES))
    parser.add_argument("--ratio", type=float, default=0.9, help="matches below this distance ratio take part")
    parser.add_argument("--threshold", type=float, default=2.0, help="px, Sampson distance of an inlier")
    parser.add_argument("--least", type=int, default=20, help="pairs with fewer matches are left out")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    pairs = matched(arguments)
    console.print(f"{len(pairs)} pairs, {np.mean([len(p.right) for p in pairs]):.0f} matches each on average")
    for name in arguments.stages:
        soft = {"soft": True} if "soft" in presets.load("pruner", name) else {}
        report(name, presets.build("pruner", name, **soft), pairs)


def matched(arguments: argparse.Namespace) -> list[Pair]:
    """The pairs of the sets, with the matches of distinct locations below the ratio."""
    sets = [data.load("fmbench", root=root) for root in arguments.root]
    families = {pair.family for dataset in sets for pair in dataset}
    if arguments.rendered:
        sets.append(data.load("rendered", "train", size=arguments.rendered))
    pruners = {"ratio": presets.build("pruner", "ratio", threshold=arguments.ratio)}
    pruners["one_to_one"] = presets.build("pruner", "one_to_one")
    stages = presets.build("features", "sift"), presets.build("matcher", "nearest"), pruners
    front = Pipeline(*stages, lambda c, seed=0: None)
    pairs = []
    for pair in track(sorted((p for s in sets for p in s), key=lambda p: p.identity), "matching", console=console):
        c = front.correspondences([pair])[0].correspondences
        if c is not None and int(c.count()) >= arguments.least:
            distance = sampson(torch.from_numpy(pair.F)[None], c.x0.double(), c.x1.double())[0]
            scene = pair.scene if pair.family in families else pair.family  # a rendered scene has but a few pairs
            pairs.append(Pair(scene, c, (distance < arguments.threshold).numpy()))
    return pairs


def report(name: str, stage: Any, pairs: list[Pair]) -> None:
    """Print the stage's figures for each scene, and the constants where it has a `calibration`."""
    scenes = list(dict.fromkeys(pair.scene for pair in pairs))
    members = [[i for i, pair in enumerate(pairs) if pair.scene == scene] for scene in scenes]
    priors = [np.clip(stage(pair.c).prior[0].double().numpy(), 1e-6, 1 - 1e-6) for pair in pairs]
    areas = [auc(p, pair.right) for p, pair in zip(priors, pairs, strict=True)]
    losses = [loss(np.log(p / (1 - p)), pair.right) for p, pair in zip(priors, pairs, strict=True)]
    columns = {
        "scene": scenes, "pairs": [str(len(inside)) for inside in members],
        "AUC of preset": [f"{np.nanmean([areas[i] for i in inside]):.3f}" for inside in members],
        "its log loss": [f"{np.mean([losses[i] for i in inside]):.3f}" for inside in members],
    }  # fmt: skip
    constants = {}
    for kind in ("with_ratio", "alone") if hasattr(stage, "evidence") else ():
        X = [features(stage, pair, kind) for pair in pairs]
        if X[0].shape[1] > 1:
            constants[kind] = fit(X, pairs)
            fitted = [(constants[kind], inside) for inside in members]
            others = [[i for i in range(len(pairs)) if i not in inside] or inside for inside in members]
            elsewhere = [fit([X[i] for i in kept], [pairs[i] for i in kept]) for kept in others]
            cases = fitted, list(zip(elsewhere, members, strict=True))
            for title, case in zip((f"{kind}: fitted", f"{kind}: scene left out"), cases, strict=True):
                columns[title] = [f"{np.mean([loss(X[i] @ w, pairs[i].right) for i in at]):.3f}" for w, at in case]
    table = Table(title=name, title_justify="left")
    for column in columns:
        table.add_column(column, justify="left" if column == "scene" else "right")
    for row in zip(*columns.values(), strict=True):
        table.add_row(*row)
    console.print(table)
    for kind, w in constants.items():
        named = dict(zip(("constant", "evidence", "ratio"), w, strict=False))
        console.print(f"  {kind}: {{{', '.join(f'{key}: {value:.3f}' for key, value in named.items())}}}")


def features(stage: Any, pair: Pair, kind: str) -> Array:
    """Columns: one, the evidence (which `ratio_prior` does not have: it is zero) and, unless alone, the ratio."""
    c = pair.c if kind == "with_ratio" else pair.c.replace(ratio=None)
    evidence = stage.evidence(c)[0].double().numpy()
    columns = [np.ones_like(evidence), *([evidence] if evidence.any() or kind == "with_ratio" else [])]
    return np.stack([*columns, *([c.ratio[0].double().numpy()] if c.ratio is not None else [])], 1)


def fit(columns: list[Array], pairs: list[Pair]) -> Array:
    """Logistic regression by Newton's method; each pair has weight 1."""
    X = np.concatenate(columns)
    y = np.concatenate([pair.right for pair in pairs]).astype(np.float64)
    weight = np.concatenate([np.full(len(pair.right), 1 / len(pair.right)) for pair in pairs])
    w = np.zeros(X.shape[1])
    for _ in range(NEWTON_STEPS):
        p = 1 / (1 + np.exp(-X @ w))
        curvature = (X * (weight * p * (1 - p))[:, None]).T @ X + 1e-9 * np.eye(len(w))
        step = np.linalg.solve(curvature, X.T @ (weight * (y - p)))
        w = w + step * min(1.0, 2.0 / max(float(np.abs(step).max()), 1e-12))
    return np.asarray(w)


def loss(z: Array, right: Array) -> float:
    """Mean negative log likelihood, in nats, of log-odds z."""
    return float(np.mean(np.logaddexp(0, z) - right * z))


def auc(score: Array, right: Array) -> float:
    """Area under the ROC curve, ties counted half; NaN where all matches are right or all wrong."""
    _, rank, count = np.unique(score, return_inverse=True, return_counts=True)
    middle = np.cumsum(count) - (count - 1) / 2
    positive = int(right.sum())
    negative = len(right) - positive
    if positive == 0 or negative == 0:
        return float("nan")
    return float((middle[rank][right].sum() - positive * (positive + 1) / 2) / (positive * negative))


if __name__ == "__main__":
    main()
