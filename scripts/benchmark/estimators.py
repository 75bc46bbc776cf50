"""Robust estimators on the same matches, one thread each: recall, AUC@0.05, milliseconds, paired intervals.

An estimator is named as PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]; the pruners after @ count into its time. The preset
`truth` is none: it is the fit that starts from the true matrix, and so what the matches allow. The pruner `ngransac` is
the network of --ngransac; without it, estimators that name it are left out.

python -m scripts.benchmark estimators --root DATA/Strecha --root DATA/PhotoTourism --seeds 5 \\
    --estimators fmtorch@frame_consistency opencv:method=usac_magsac,threshold=1.0 poselib:threshold=0.5,prosac=true
python -m scripts.benchmark estimators --rendered full --specs scripts/benchmark/estimators.txt --json figures.json \\
    --rows rows.jsonl

--rows is appended to pair by pair: started again, the command goes on where it was interrupted, and measures what other
seeds, pairs and estimators need. A row counts only for the code, options and learned files that it was made with.
Estimators that were not measured in one run did not take turns, which their times may show.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from fmtorch import metrics
from fmtorch.data import ImagePair
from fmtorch.evaluation.statistics import MERITS, PERCENT, SHARES, described, difference, unit
from scripts.benchmark import estimators_table as table
from scripts.benchmark import matched
from scripts.benchmark.kept import Kept, Row
from scripts.benchmark.matched import Item, console, groups
from scripts.benchmark.specs import NGRANSAC, NONE, Method, Stage, identity, informed, ngransac, read_specs, stages_of

Result = dict[str, NDArray[np.float64]]  # nsgd, ms: (seeds, pairs)


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("estimators", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    matched.add_arguments(parser)
    parser.add_argument("--estimators", nargs="+", default=[], help="PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]")
    parser.add_argument("--specs", type=Path, help="a file with one estimator a line; # starts a comment")
    parser.add_argument("--ngransac", type=Path, help="NG-RANSAC's published weights (scripts/make_models.py ngransac)")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rows", type=Path, help="keep what each estimator makes of each pair here, one line each")
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--baseline", type=Path, help="a file written by --json, to compare recall and time with")
    parser.add_argument("--update", type=Path, help="write the tables into this Markdown file, between its markers")
    parser.add_argument(
        "--marker", default="estimators",
        help="recall goes between <!-- NAME --> and <!-- end NAME -->, differences between those of NAME differences",
    )  # fmt: skip
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    kept = Kept(arguments.rows)
    items = matched.load(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    specs = [*arguments.estimators, *(read_specs(arguments.specs) if arguments.specs else [])]
    extra = {NGRANSAC: ngransac(arguments.ngransac)} if arguments.ngransac else {}
    if not extra:
        specs = [spec for spec in specs if NGRANSAC not in stages_of(spec)]
    if not specs:
        raise SystemExit("name at least one estimator: --estimators or --specs")
    results = measure(specs, items, arguments.seeds, extra, kept, matched.identity(arguments))
    pairs = [pair for pair, _ in items]
    figures = {group: summaries(results, pairs, inside) for group, inside in groups(pairs).items()}
    for group, inside in groups(pairs).items():
        place = described([scene for scene, member in zip(matched.scenes(pairs), inside, strict=True) if member])
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


def measure(
    specs: list[str],
    items: list[Item],
    seeds: int,
    extra: Mapping[str, Stage] = NONE,
    kept: Kept | None = None,
    matches: str = "",
) -> dict[str, Result]:
    """NSGD (seeds, pairs) and milliseconds of processor time (seeds, pairs) of each estimator, one pair a call.

    The estimators take turns at each pair, so that what else the machine does slows them down alike.

    Args:
        specs: the estimators.
        items: pairs with their matches.
        seeds: how many, from 0.
        extra: pruners that are no presets.
        kept: takes a row for each estimator, pair and seed; those that it has are not measured again.
        matches: the digest of what the matches were made with.
    """
    kept = Kept(None) if kept is None else kept
    known = kept.by("pair", "seed", "method", "identity", "matches")
    methods = {spec: informed(spec, extra) for spec in specs}
    made_with = {spec: (spec, identity(spec, extra), matches) for spec in specs}
    measured: dict[str, dict[tuple[int, int], Row]] = {spec: {} for spec in specs}
    todo: dict[tuple[int, int], dict[str, Method]] = {}
    for seed in range(seeds):
        for i, (pair, _) in enumerate(items):
            for spec, method in methods.items():
                row = known.get((pair.identity, seed, *made_with[spec]))
                if row is None:
                    todo.setdefault((seed, i), {})[spec] = method
                else:
                    measured[spec][seed, i] = row
    for spec in dict.fromkeys(spec for missing in todo.values() for spec in missing):
        methods[spec](*items[0], 0)  # not counted: lazy initialisation
    for (seed, i), missing in track(todo.items(), "estimating", console=console, transient=True):
        new = {spec: _row(method, items[i], seed) for spec, method in missing.items()}
        for spec, row in new.items():
            row |= dict(zip(("method", "identity", "matches"), made_with[spec], strict=True))
            measured[spec][seed, i] = row
        kept.add(list(new.values()))
    return {spec: _result(rows, (seeds, len(items))) for spec, rows in measured.items()}


def _row(method: Method, item: Item, seed: int) -> Row:
    """NSGD, 1 where there is no estimate, and milliseconds of one call."""
    pair, c = item
    start = time.process_time()
    estimate = method(pair, c, seed)
    ms = 1e3 * (time.process_time() - start)
    nsgd = 1.0
    if bool(estimate.ok[0]):
        assert c.size0 is not None
        assert c.size1 is not None
        nsgd = float(metrics.nsgd(torch.from_numpy(pair.F)[None], estimate.F, c.size0, c.size1, key=c.keys))
    return {"pair": pair.identity, "seed": seed, "nsgd": nsgd, "ms": ms}


def _result(rows: Mapping[tuple[int, int], Row], shape: tuple[int, int]) -> Result:
    """The figures of all seeds and pairs, (seeds, pairs) each."""
    return {
        name: np.array([[rows[seed, i][name] for i in range(shape[1])] for seed in range(shape[0])])
        for name in ("nsgd", "ms")
    }


def summaries(results: dict[str, Result], pairs: list[ImagePair], inside: NDArray[np.bool_]) -> table.Figures:
    """The figures of each estimator over some pairs, in percent; ahead_*: what the first has more, with its interval.

    None where the pairs are too few for one. interval_over: its units, scenes or, of fewer than five scenes, pairs.
    """
    first = {key: value[:, inside] for key, value in next(iter(results.values())).items()}
    scenes = [scene for scene, member in zip(matched.scenes(pairs), inside, strict=True) if member]
    figures: table.Figures = {}
    for spec, result in results.items():
        nsgd, ms = result["nsgd"][:, inside], result["ms"][:, inside]
        figures[spec] = {name: PERCENT * float(values(nsgd).mean()) for name, values in MERITS.items()}
        for name in ("recall_01", "auc_05"):
            own, other = MERITS[name](first["nsgd"]), MERITS[name](nsgd)
            ahead = difference(own, other, scenes, PERCENT, share=name in SHARES)
            figures[spec][f"ahead_{name}"] = None if ahead is None else [ahead.value, ahead.low, ahead.high]
        figures[spec]["interval_over"] = unit(scenes)
        figures[spec] |= {
            "ms_median": float(np.median(ms)),
            "ms_mean": float(ms.mean()),
            "ms_ratio": float(np.median(ms.mean(0) / first["ms"].mean(0))),
        }
    return figures
