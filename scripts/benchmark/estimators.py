"""Robust estimators on the same matches, one thread each: recall, AUC@0.05, milliseconds, paired intervals.

An estimator is named as PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]; the pruners after @ count into its time. The preset
`truth` is none: it is the fit that starts from the true matrix, and so what the matches allow. The pruner `ngransac` is
the network of --ngransac; without it, estimators that name it are left out.

python -m scripts.benchmark estimators --root DATA/Strecha --root DATA/PhotoTourism --seeds 5 \\
    --estimators fmtorch@frame_consistency opencv_usac_magsac:threshold=1.0 poselib:threshold=0.5,prosac=true
python -m scripts.benchmark estimators --rendered full --specs scripts/benchmark/estimators.txt --json figures.json
"""

from __future__ import annotations

import argparse
import functools
import json
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from fmtorch import metrics, presets
from fmtorch.data import ImagePair
from fmtorch.evaluation.statistics import MERITS, PERCENT, SHARES, described, difference, unit
from fmtorch.geometry import refine
from fmtorch.stages import Estimator
from fmtorch.types import Correspondences, Estimate
from scripts.benchmark import estimators_table as table
from scripts.benchmark import matched
from scripts.benchmark.matched import Item, console, groups, options

Result = dict[str, NDArray[np.float64]]  # nsgd, ms: (seeds, pairs)
Stage = Callable[[Correspondences], Correspondences]
NGRANSAC = "ngransac"
NONE: Mapping[str, Stage] = {}


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("estimators", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    matched.add_arguments(parser)
    parser.add_argument("--estimators", nargs="+", default=[], help="PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]")
    parser.add_argument("--specs", type=Path, help="a file with one estimator a line; # starts a comment")
    parser.add_argument("--ngransac", type=Path, help="NG-RANSAC's published weights (scripts/convert_ngransac.py)")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--baseline", type=Path, help="a file written by --json, to compare recall and time with")
    parser.add_argument("--update", type=Path, help="write the tables into this Markdown file, between its markers")
    parser.add_argument(
        "--marker", default="estimators",
        help="recall goes between <!-- NAME --> and <!-- end NAME -->, differences between those of NAME differences",
    )  # fmt: skip
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    items = matched.load(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    specs = [*arguments.estimators, *(read_specs(arguments.specs) if arguments.specs else [])]
    extra = {NGRANSAC: ngransac(arguments.ngransac)} if arguments.ngransac else {}
    if not extra:
        specs = [spec for spec in specs if NGRANSAC not in stages_of(spec)]
    if not specs:
        raise SystemExit("name at least one estimator: --estimators or --specs")
    results = measure(specs, items, arguments.seeds, extra)
    pairs = [pair for pair, _ in items]
    figures = {group: summaries(results, pairs, inside) for group, inside in groups(pairs).items()}
    for group, inside in groups(pairs).items():
        place = described([scene for scene, one in zip(matched.scenes(pairs), inside, strict=True) if one])
        table.report(f"{group}: {place}; {arguments.seeds} seeds", figures[group])
    if arguments.baseline:
        table.compare(figures, baseline(arguments.baseline))
    if arguments.json:
        machine = {"processor": platform.processor() or platform.machine(), "torch": torch.__version__}
        content = {"machine": machine, "pairs": len(pairs), "seeds": arguments.seeds, "figures": figures}
        arguments.json.write_text(json.dumps(content, indent=1) + "\n")
    if arguments.update:
        table.write(arguments.update, arguments.marker, figures, pairs, arguments.seeds)


def baseline(path: Path) -> table.Groups:
    """The figures of a file written by --json. Raises SystemExit for one from before AUC@0.05 had this name."""
    figures: table.Groups = json.loads(path.read_text())["figures"]
    if any("auc_05" not in row for group in figures.values() for row in group.values()):
        raise SystemExit(f"{path} has no auc_05 (earlier versions wrote mean_recall); measure it again")
    return figures


def read_specs(path: Path) -> list[str]:
    """One estimator a line, without comments."""
    return [text for line in path.read_text().splitlines() if (text := line.partition("#")[0].strip())]


def stages_of(spec: str) -> list[str]:
    """The pruners of `PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]`."""
    return [stage for stage in spec.partition("@")[2].split("+") if stage]


def build(spec: str, extra: Mapping[str, Stage] = NONE) -> Estimator:
    """The function of `PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]`: pruners in order, then the estimator.

    extra: pruners that are no presets.
    """
    name, _, rest = spec.partition("@")[0].partition(":")
    estimator, prune = presets.build("estimator", name, **options(rest)), pruning(spec, extra)

    def call(c: Correspondences, seed: int = 0) -> Estimate:
        estimate: Estimate = estimator(prune(c), seed)
        return estimate

    return call


def pruning(spec: str, extra: Mapping[str, Stage] = NONE) -> Stage:
    """The pruners of a spec, in order; of nothing, the matches as they are."""
    pruners = [extra[stage] if stage in extra else presets.build("pruner", stage) for stage in stages_of(spec)]
    return lambda c: functools.reduce(lambda kept, pruner: pruner(kept), pruners, c)


def ngransac(file: Path) -> Stage:
    """The network of neural-guided RANSAC (Brachmann & Rother, ICCV 2019) as prior: its weights of samples."""
    if not file.is_file():
        raise SystemExit(f"--ngransac {file}: no such file; scripts/convert_ngransac.py makes it")
    network = {"_target_": "fmtorch.pruning.networks.LC", "side": ["ratio"]}
    stage: Stage = presets.build("pruner", "lc_soft", network=network, file=str(file))
    return stage


def informed(spec: str, extra: Mapping[str, Stage] = NONE) -> Callable[[ImagePair, Correspondences, int], Estimate]:
    """As `build`, of methods that are told the pair: only `truth` looks at it."""
    if spec.partition("@")[0] == "truth":
        prune = pruning(spec, extra)
        return lambda pair, c, seed: from_truth(pair, prune(c))
    method = build(spec, extra)
    return lambda pair, c, seed: method(c, seed)


def from_truth(pair: ImagePair, c: Correspondences) -> Estimate:
    """The robust fit to the matches, weighted by their prior, that starts from the true matrix."""
    F = torch.from_numpy(pair.F)[None]
    for scale in (1.5, 0.7):  # px
        F = refine(F, c.x0, c.x1, c.prior, c.mask, kernel="geman_mcclure", scale=scale, iterations=20)
    ok = torch.isfinite(F).all(-1).all(-1)
    return Estimate(F, c.mask, ok, ("",), torch.zeros(1, dtype=torch.int64))


def measure(specs: list[str], items: list[Item], seeds: int, extra: Mapping[str, Stage] = NONE) -> dict[str, Result]:
    """NSGD (seeds, pairs) and milliseconds of processor time (seeds, pairs) of each estimator, one pair a call.

    The estimators take turns at each pair, so that what else the machine does slows them down alike.
    """
    methods = {spec: informed(spec, extra) for spec in specs}
    results = {spec: {"nsgd": np.ones((seeds, len(items))), "ms": np.zeros((seeds, len(items)))} for spec in specs}
    for method in methods.values():
        method(*items[0], 0)  # not counted: lazy initialisation
    calls = [(seed, i) for seed in range(seeds) for i in range(len(items))]
    for seed, i in track(calls, "estimating", console=console, transient=True):
        pair, c = items[i]
        for spec, method in methods.items():
            start = time.process_time()
            estimate = method(pair, c, seed)
            results[spec]["ms"][seed, i] = 1e3 * (time.process_time() - start)
            if bool(estimate.ok[0]):
                F = torch.from_numpy(pair.F)[None]
                assert c.size0 is not None
                assert c.size1 is not None
                results[spec]["nsgd"][seed, i] = float(metrics.nsgd(F, estimate.F, c.size0, c.size1, key=c.keys))
    return results


def summaries(results: dict[str, Result], pairs: list[ImagePair], inside: NDArray[np.bool_]) -> table.Figures:
    """The figures of each estimator over some pairs, in percent; ahead_*: what the first has more, with its interval.

    None where the pairs are too few for one. interval_over: its units, scenes or, of fewer than five scenes, pairs.
    """
    first = {key: value[:, inside] for key, value in next(iter(results.values())).items()}
    scenes = [scene for scene, one in zip(matched.scenes(pairs), inside, strict=True) if one]
    found: table.Figures = {}
    for spec, result in results.items():
        nsgd, ms = result["nsgd"][:, inside], result["ms"][:, inside]
        found[spec] = {name: PERCENT * float(values(nsgd).mean()) for name, values in MERITS.items()}
        for name in ("recall_01", "auc_05"):
            own, other = MERITS[name](first["nsgd"]), MERITS[name](nsgd)
            ahead = difference(own, other, scenes, PERCENT, share=name in SHARES)
            found[spec][f"ahead_{name}"] = None if ahead is None else [ahead.value, ahead.low, ahead.high]
        found[spec]["interval_over"] = unit(scenes)
        found[spec] |= {
            "ms_median": float(np.median(ms)),
            "ms_mean": float(ms.mean()),
            "ms_ratio": float(np.median(ms.mean(0) / first["ms"].mean(0))),
        }
    return found
