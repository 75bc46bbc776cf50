"""Fit the constants with which pruners' evidence becomes P(inlier), and say how well it tells inliers from outliers.

python -m scripts.calibrate_priors --root DATA/Strecha_train --root DATA/TanksLike --rendered small

For each stage that supplies a prior and each scene: the area under the ROC curve and the log loss, in nats a match, as
its preset stands; then, with and without the distance ratio, the log loss with the constants of its `calibration`
fitted here (logistic regression, every pair with the same weight) and to the other scenes; and the constants.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from fmtorch import Correspondences, presets
from fmtorch.geometry import sampson
from fmtorch.scenes.dataset import FAMILIES
from scripts.benchmark import pairs
from scripts.benchmark.tables import Record, Sheet, chance_of_more, show

RATIO = 0.9  # below which matches take part
INLIER = 2.0  # px, Sampson distance
MIN_MATCHES = 20  # of a pair
STAGES = ("ratio_prior", "gms", "lpm", "position_consistency", "frame_consistency", "code")
Array = NDArray[Any]


class Pair(NamedTuple):
    """A matched pair of a scene, and which of its matches are right."""

    scene: str
    c: Correspondences
    right: Array


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    pairs.add_set_options(parser)
    parser.set_defaults(split="train")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    own = matched(arguments)
    print(f"{len(own)} pairs, {np.mean([len(p.right) for p in own]):.0f} matches each on average\n")
    for name in STAGES:
        soft = {"soft": True} if "soft" in presets.load("pruner", name) else {}
        report(name, presets.build("pruner", name, **soft), own)


def matched(arguments: argparse.Namespace) -> list[Pair]:
    """The pairs of the sets, with the matches of distinct locations below the ratio."""
    front = pairs.front_of("sift", [f"ratio:threshold={RATIO}", "one_to_one"])
    own = []
    for item in pairs.items(sorted(pairs.pairs_of(arguments), key=lambda pair: pair.identity), front):
        c = None if item.outcome is None else item.outcome.correspondences
        if c is not None and int(c.count()) >= MIN_MATCHES:
            distance = sampson(torch.from_numpy(item.pair.F)[None], c.x0.double(), c.x1.double())[0]
            rendered = item.pair.family in FAMILIES  # whose scenes have but a few pairs each
            own.append(Pair(item.pair.family if rendered else item.pair.scene, c, (distance < INLIER).numpy()))
    return own


def report(name: str, stage: Any, own: list[Pair]) -> None:
    """Print the stage's figures for each scene, and the constants where it has a `calibration`."""
    priors = [np.clip(stage(pair.c).prior[0].double().numpy(), 1e-6, 1 - 1e-6) for pair in own]
    areas = np.array([chance_of_more(p[pair.right], p[~pair.right]) for p, pair in zip(priors, own, strict=True)])
    losses = np.array([loss(np.log(p / (1 - p)), pair.right) for p, pair in zip(priors, own, strict=True)])
    kinds = ("with_ratio", "alone") if hasattr(stage, "evidence") else ()
    evidence = {kind: [features(stage, pair, kind) for pair in own] for kind in kinds}
    fitted = {kind: X for kind, X in evidence.items() if X[0].shape[1] > 1}
    constants = {kind: fit(X, own) for kind, X in fitted.items()}
    records: list[Record] = []
    for scene in dict.fromkeys(pair.scene for pair in own):
        inside = [i for i, pair in enumerate(own) if pair.scene == scene]
        others = [i for i in range(len(own)) if i not in inside] or inside
        line: Record = {"scene": scene, "pairs": len(inside), "AUC of preset": f"{np.nanmean(areas[inside]):.3f}"}
        line["its log loss"] = f"{np.mean(losses[inside]):.3f}"
        for kind, X in fitted.items():
            elsewhere = fit([X[i] for i in others], [own[i] for i in others])
            for title, w in (("fitted", constants[kind]), ("scene left out", elsewhere)):
                line[f"{kind}: {title}"] = f"{np.mean([loss(X[i] @ w, own[i].right) for i in inside]):.3f}"
        records.append(line)
    show([Sheet(name, name, records)])
    for kind, w in constants.items():
        named = dict(zip(("constant", "evidence", "ratio"), w, strict=False))
        print(f"  {kind}: {{{', '.join(f'{key}: {value:.3f}' for key, value in named.items())}}}\n")


def features(stage: Any, pair: Pair, kind: str) -> Array:
    """Columns: one, the evidence (which `ratio_prior` does not have: it is zero) and, unless alone, the ratio."""
    c = pair.c if kind == "with_ratio" else pair.c.replace(ratio=None)
    evidence = stage.evidence(c)[0].double().numpy()
    columns = [np.ones_like(evidence), *([evidence] if evidence.any() or kind == "with_ratio" else [])]
    return np.stack([*columns, *([c.ratio[0].double().numpy()] if c.ratio is not None else [])], 1)


def fit(columns: list[Array], own: list[Pair]) -> Array:
    start = np.zeros(columns[0].shape[1])
    return np.asarray(minimize(lambda w: sum(loss(X @ w, p.right) for X, p in zip(columns, own, strict=True)), start).x)


def loss(z: Array, right: Array) -> float:
    """Mean negative log likelihood, in nats, of log-odds z."""
    return float(np.mean(np.logaddexp(0, z) - right * z))


if __name__ == "__main__":
    main()
