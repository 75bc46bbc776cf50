"""Pipelines on pairs that were selected by overlap rather than by SIFT; the sets are made by `fmtorch pairs overlap=`.

python -m scripts.benchmark hard --root HARD/orbit --root HARD/collection --root HARD/PhotoTourism --json hard.jsonl
python -m scripts.benchmark hard --from hard.jsonl --markdown docs/appendix/features.md

--json is appended to batch by batch: started again, the command goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track

from fmtorch.data import ImagePair, read_image, to_grey
from fmtorch.data.construction import Keypoints, keypoints, matchable
from fmtorch.evaluation.run import select
from fmtorch.evaluation.statistics import PERCENT, areas, described, difference, interval, recalled
from fmtorch.presets.pruners import WIDE
from scripts.benchmark.kept import Kept, Row, read
from scripts.benchmark.matched import add_set_arguments, console, sets_of
from scripts.benchmark.pipelines import add_measure_arguments, measure
from scripts.benchmark.pipelines_table import failed, nsgd_by_seed, solved_means
from scripts.benchmark.pruning_table import scenes_of
from scripts.benchmark.sheet import MISSING, Sheet, put, shown

GROUPS = {
    "": [
        "sift_ratio", "sift_fmtorch", "rootsiftpca_ratio", "rootsiftpca_gms", "hesaffnet_ratio", "hesaffnet_gms",
        "hesaffnet_fmtorch",
    ],
    " with fmtorch": ["rootsiftpca_ratio"],
    " int8": ["hardnet_ratio", "hardnet_gms", "hardnet_fmtorch"],
}  # fmt: skip
"""Pipelines by what their names get appended for the overrides that they are measured with."""
OVERRIDES = {
    "": [],
    " with fmtorch": ["estimator=fmtorch", "pruner=[ratio,one_to_one,frame_consistency]"],  # as in hardnet_fmtorch
    " int8": ["features.precision=int8"],  # of the network, in a third of the time
}
RULE = "the paper's rule"
MARKER = "hard pairs"
DIFFERENCES = [
    ("sift_fmtorch", "sift_ratio"), ("hardnet_ratio int8", "sift_ratio"), ("hesaffnet_ratio", "hardnet_ratio int8"),
    ("hesaffnet_gms", "hesaffnet_ratio"), ("rootsiftpca_ratio with fmtorch", "sift_fmtorch"),
    ("hardnet_fmtorch int8", "sift_fmtorch"), ("hesaffnet_fmtorch", "hardnet_fmtorch int8"),
    ("hesaffnet_fmtorch", "sift_fmtorch"), ("hesaffnet_fmtorch", "hesaffnet_ratio"),
]  # fmt: skip


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("hard", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_set_arguments(parser, "pairs of each family at most, chosen by hash")
    add_measure_arguments(parser, seeds=5)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    rows = [row for path in arguments.earlier for row in read(path)]
    if arguments.root:
        rows += judged(arguments)
        for label, names in GROUPS.items():
            options = {**vars(arguments), "pipelines": names, "overrides": OVERRIDES[label], "label": label}
            rows += measure(argparse.Namespace(**options))
    sheets = tables(list({(row["pair"], row["method"]): row for row in rows}.values()))
    for sheet in sheets:
        console.print(sheet.terminal())
    if arguments.markdown:
        put(arguments.markdown, sheets, MARKER)


def judged(arguments: argparse.Namespace) -> list[Row]:
    """A row for each pair that says whether the paper's rule would select it."""
    pairs = select([dataset[i] for dataset in sets_of(arguments) for i in range(len(dataset))], arguments.limit)
    kept = Kept(arguments.json)
    known = kept.by("method", "pair")
    rows = [known[RULE, pair.identity] for pair in pairs if (RULE, pair.identity) in known]
    todo = [pair for pair in pairs if (RULE, pair.identity) not in known]
    features: dict[Path, Keypoints] = {}
    for pair in track(todo, RULE, console=console):
        row = {"method": RULE, "identity": "", **_place(pair), "matchable": _passes(pair, features)}
        kept.add([row])
        rows.append(row)
    return rows


def _place(pair: ImagePair) -> Row:
    return {"pair": pair.identity, "family": pair.family, "scene": pair.scene}


def _passes(pair: ImagePair, features: dict[Path, Keypoints]) -> bool:
    for image in (pair.image0, pair.image1):
        if image.path not in features:
            features[image.path] = keypoints(to_grey(read_image(image)))
    return matchable(features[pair.image0.path], features[pair.image1.path], pair.F)


def tables(rows: Sequence[Row]) -> list[Sheet]:
    """A table for each family, and one of paired differences."""
    measured = [row for row in rows if row["method"] != RULE]
    passing = {row["pair"]: row["matchable"] for row in rows if row["method"] == RULE}
    families = sorted({row["family"] for row in measured}, key=lambda family: (WIDE.index(family), family))
    sheets = [_family(name, [row for row in measured if row["family"] == name], passing) for name in families]
    return [*sheets, _differences(measured, families)]


def _family(family: str, rows: list[Row], passing: dict[str, bool]) -> Sheet:
    """%Recall and AUC@0.05, %Recall apart for pairs that the paper's rule selects and leaves out, and counts."""
    methods = dict.fromkeys(row["method"] for row in rows)
    pairs = list({row["pair"]: row for row in rows}.values())
    selected = sum(passing.get(row["pair"], False) for row in pairs)
    title = f"{family}: {described(scenes_of(pairs))}; the paper's rule selects {selected}"
    lines = []
    for method in methods:
        own = [row for row in rows if row["method"] == method]
        nsgd = nsgd_by_seed(own)
        apart = np.array([passing.get(row["pair"], False) for row in own])
        recall = recalled(nsgd)
        cells = [
            shown(interval(recall, scenes_of(own), PERCENT, share=True), ".1f"),
            shown(interval(areas(nsgd), scenes_of(own), PERCENT), ".1f"),
            *(
                f"{PERCENT * recall[selected].mean():.1f}" if selected.any() else MISSING
                for selected in (apart, ~apart)
            ),
            f"{np.nanmean(solved_means(own, 'corrs_before')):.0f}",
        ]
        note = "" if len(own) == len(pairs) else f", {len(own)} pairs"
        lines.append([f"`{method}`{note}", *cells, failed(own)])
    heads = ["", "%Recall", "AUC@0.05", "%Recall, selected", "%Recall, left out", "#Corrs-m", "failed"]
    return Sheet(title, heads, lines)


def _differences(rows: list[Row], families: list[str]) -> Sheet:
    """What one pipeline has more than another on the same pairs of each family."""
    by_method = {m: {r["pair"]: r for r in rows if r["method"] == m} for m in {row["method"] for row in rows}}
    lines = []
    for family in families:
        for better, worse in DIFFERENCES:
            first, second = by_method.get(better, {}), by_method.get(worse, {})
            common = [pair for pair in first if pair in second and first[pair]["family"] == family]
            if not common:
                continue
            a, b = ([own[pair] for pair in common] for own in (first, second))
            scenes = scenes_of(a)
            cells = [
                shown(difference(of(nsgd_by_seed(a)), of(nsgd_by_seed(b)), scenes, PERCENT, share=share), "+.1f")
                for of, share in ((recalled, True), (areas, False))
            ]
            lines.append([f"{family}: `{better}` - `{worse}`", str(len(common)), *cells])
    return Sheet("Paired differences on hard pairs, in points", ["", "pairs", "%Recall", "AUC@0.05"], lines)
