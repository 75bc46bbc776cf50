"""Pipelines on the same pairs: recall, inlier rates and counts by set, beside the paper's figures; paired differences.

Each of these benchmarks is a page of settings, the YAML file of its name in this folder: pipelines with their names in
the tables, as PRESET NAME=VALUE ..., what is shown of them, and which are compared. --pipelines takes some of them, by
names or patterns such as 'sift*', or others, as 'NAME = PRESET NAME=VALUE ...'; `+ PRUNER` at the end of one adds one.
The time of pruners is that of all but `ratio` and `one_to_one`, on one thread.
"""

import argparse
import fnmatch
import functools
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml  # type: ignore[import-untyped]

from fmtorch import data, presets
from fmtorch.core.types import RELATED
from fmtorch.data import ImagePair, read_image, to_grey
from fmtorch.data.construction import keypoints, matchable
from fmtorch.evaluation.run import select
from fmtorch.evaluation.statistics import PERCENT, interval
from fmtorch.features import ASIFT
from fmtorch.features.describe import codebook, descriptor_kind, local_descriptors, vlad
from fmtorch.pipeline import Outcome, Pipeline, describe
from fmtorch.pipeline.folder import similar_pairs
from fmtorch.training.matched_pairs import no_estimator
from scripts.benchmark import pairs, tables
from scripts.benchmark.methods import pipeline_method, pipeline_of
from scripts.benchmark.runner import Item, Kept, Measured, Method, Row, add_command, measure
from scripts.benchmark.tables import KIN, Record, Results, Sheet, Span, published, show, span

FOLDER = Path(__file__).parent
BENCHMARKS = ("pipelines", "hard", "paper", "pruning", "learned", "refinement", "gc_ransac")
RULE = "the paper's rule"
PAPER = {"%Recall": "recall", "%Inlier": "inlier", "%Inlier-m": "inlier_m", "#Corrs": "corrs", "#Corrs-m": "corrs_m"}
"""Columns of the paper's tables, by what they are called here and there."""
Settings = Mapping[str, Any]
RIGHT = 0.05  # NSGD below which an estimate of a related pair is right
LEVELS = (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 5.0, 8.0)
Rows = dict[str, list[Row]]  # by pipeline
SIMILAR = "How many of the pairs that can be matched `pairs=similar:N` proposes, all scenes mixed in one folder."
VERDICT = "The verdict on pairs of one scene and of different scenes: shares accepted and rejected, and ROC."


def settings_of(name: str) -> dict[str, Any]:
    settings: dict[str, Any] = yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
    return settings


def add_arguments(commands: Any) -> None:
    for name in BENCHMARKS:
        settings = settings_of(name)
        about = f"{settings['about']}\n\n{(__doc__ or '').partition(chr(10))[2]}"
        command, seeds = functools.partial(run, settings), settings.get("seeds", 1)
        parser = add_command(commands, name, command, about, pairs.add_set_options, seeds)
        asift = "the same of pipelines with ASIFT, a minute a pair"
        parser.add_argument("--asift-limit", type=int, default=10, help=asift)
        add_pipeline_options(parser)
    parser = add_command(commands, "related", run_related, VERDICT, pairs.add_set_options, seeds=1)
    parser.add_argument("--unrelated", type=int, default=300, help="pairs of each two scenes at most, chosen by hash")
    add_pipeline_options(parser)
    parser.add_argument("--figure", type=Path, help="draw the ROC curves here, as SVG")
    parser.set_defaults(asift_limit=None)
    parser = add_command(commands, "similar", run_similar, SIMILAR)
    parser.add_argument("--root", type=Path, nargs="+", required=True, help="folders in the layout of fmbench")
    parser.add_argument("--pipeline", default="sift_fmtorch")


def add_pipeline_options(parser: argparse.ArgumentParser) -> None:
    names = "names or patterns of the settings, or NAME = WORDS"
    parser.add_argument("--pipelines", nargs="*", default=["*"], help=names)
    parser.add_argument("--overrides", nargs="*", default=[], help="of each pipeline, e.g. features.precision=int8")
    parser.add_argument("--label", default="", help="appended to the pipelines' names in the tables")
    parser.add_argument("--cache", default="null", help="folder of features; null: the user's; off: nowhere")


def run(settings: Settings, arguments: argparse.Namespace) -> None:
    def measured_rows(kept: Kept) -> list[Row]:
        every = pairs.pairs_of(arguments)
        bare = [Item(pair, functools.partial(Outcome, pair)) for pair in every]
        rows = measure([Rule()], bare, 1, kept, RULE) if settings.get("rule") else []
        return rows + measured(settings["methods"], every, arguments, kept)

    rows = pairs.rows_of(arguments, measured_rows)
    selected = {row["pair"] for row in rows if row["method"] == RULE and row["selected"]}
    results = Results(row for row in rows if row["method"] != RULE)
    sheets = [figures_sheet(results, settings, selected), differences_sheet(results, settings)]
    show([sheet for sheet in sheets if sheet.records], arguments.table)


def selected_pipelines(known: Mapping[str, str], wanted: Sequence[str]) -> dict[str, str]:
    selected: dict[str, str] = {}
    for word in wanted:
        name, equals, words = (part.strip() for part in word.partition(" = "))
        names = fnmatch.filter(known, name)
        if not equals and not names and "*" in name:
            raise SystemExit(f"--pipelines {word!r}: there are {', '.join(known)}")
        selected |= {name: words} if equals else {n: known[n] for n in names} if names else {name: name}
    return selected


def measured(known: Mapping[str, str], every: Sequence[ImagePair], arguments: Any, kept: Kept) -> list[Row]:
    """The rows of the pipelines that are asked for; those with the same features share their matches and take turns."""
    groups: dict[str, tuple[Pipeline, list[Method]]] = {}
    for name, words in selected_pipelines(known, arguments.pipelines).items():
        overrides = f"cache={arguments.cache}", *arguments.overrides
        method, pipeline, front = pipeline_method(name + arguments.label, words, *overrides)
        if front not in groups:
            shared = Pipeline(pipeline.extractor, pipeline.matcher, {}, no_estimator, model=None)
            groups[front] = shared, []
        groups[front][1].append(method)
    rows: list[Row] = []
    for pipeline, methods in groups.values():
        slow = isinstance(getattr(pipeline.extractor, "extractor", pipeline.extractor), ASIFT)
        own = select(every, arguments.asift_limit) if slow else every
        rows += measure(methods, pairs.items(own, pipeline), arguments.seeds, kept, methods[0].name)
    return rows


class Rule(Measured):
    """Whether the paper's rule would select a pair, as a method."""

    name, identity = RULE, ""

    def __init__(self) -> None:
        self._keypoints = functools.lru_cache(maxsize=64)(lambda path: keypoints(to_grey(read_image(path))))

    def figures(self, item: Item, seed: int) -> Row:
        a, b = (self._keypoints(image) for image in (item.pair.image0, item.pair.image1))
        return {"selected": bool(matchable(a, b, item.pair.F))}


def figures_sheet(results: Results, settings: Settings, selected: set[str]) -> Sheet:
    """Each set's figures, beside the paper's; recall apart for pairs that the paper's rule selects and leaves out."""
    groups = results.groups(results.all_pairs)
    groups.pop("all", None)
    minus, against = settings.get("minus", ()), settings.get("against", "")
    records = results.records(groups, settings["columns"], "pipeline", minus, against, intervals=True)
    for record in records:
        own = [pair for pair in groups[record["set"]] if pair in results.pairs(record["pipeline"])]
        for head, inside in (("selected", True), ("left out", False)) if settings.get("rule") else ():
            apart = [pair for pair in own if (pair in selected) == inside]
            record[f"%Recall, {head}"] = results.cell(record["pipeline"], apart, "R.05")
        if theirs := _papers(settings, record["set"], record["pipeline"]):
            record |= {"paper's set": KIN[record["set"]]} | {f"paper: {c}": theirs[field] for c, field in PAPER.items()}
    return Sheet("", f"{settings['about']}: {results.described(results.all_pairs)}", records)


def _papers(settings: Settings, family: str, name: str) -> dict[str, str]:
    """The paper's figures of a pipeline, by its name or words, on its set of the same kind of motion."""
    paper = published(FOLDER / settings["published"]) if "published" in settings else {}
    words = settings["methods"].get(name, name).replace(" features=sift_vlfeat", "")
    kin = KIN.get(family, "")
    return paper.get((kin, name)) or paper.get((kin, words)) or {}


def differences_sheet(results: Results, settings: Settings) -> Sheet:
    stated = [tuple(two) for two in settings.get("differences", []) if set(two) <= set(results.methods)]
    labelled = [(name, base) for name in results.methods for base in results.methods if name.startswith(f"{base} ")]
    records = []
    for group, every in results.groups(results.all_pairs).items():
        for first, second in dict.fromkeys([*stated, *labelled]):
            common = [pair for pair in results.pairs(first, second) if pair in set(every)]
            if not common:
                continue
            line: Record = {"set": group, "pairs": len(common), "pipeline": first, "minus": second}
            for name in settings.get("compared", ("%Recall", "AUC@0.05")):
                line[name] = results.difference(first, second, common, name)
            theirs = [_papers(settings, group, name) for name in (first, second)]
            if all(theirs):
                line["paper: %Recall"] = f"{float(theirs[0]['recall']) - float(theirs[1]['recall']):+.1f}"
            records.append(line)
    return Sheet("differences", "Paired differences, in points", records)


# Which pairs show one scene: the verdict on them, and the likeness of images


def run_related(arguments: argparse.Namespace) -> None:
    def measured_rows(kept: Kept) -> list[Row]:
        related = [pair for pair in pairs.pairs_of(arguments) if pair.problem is None]
        unrelated = pairs.unrelated_pairs(related, pairs.sets_of(arguments), arguments.unrelated)
        every = sorted([*related, *unrelated], key=lambda p: (p.family, p.scene, p.image0.identity, p.image1.identity))
        return measured(settings_of("related")["methods"], every, arguments, kept)

    rows = verdicts(pairs.rows_of(arguments, measured_rows))
    show([rates_sheet(rows), levels_sheet(rows), sets_sheet(rows)], arguments.table)
    if arguments.figure:
        draw(rows, arguments.figure)


def verdicts(rows: Iterable[Row]) -> Rows:
    """The newest row of each pipeline and pair: whether it shows one scene, is called so, and is estimated right.
    `significance` is least where there is no F, `inliers` are 0."""
    judged = []
    for row in {(row["method"], row["pair"]): row for row in rows}.values():
        true = not row["family"].startswith(pairs.UNRELATED)
        significance = -math.inf if row["significance"] is None else float(row["significance"])
        own = {"true": true, "right": true and row["nsgd"] < RIGHT, "significance": significance}
        judged.append({**row, **own, "called": significance >= RELATED, "inliers": float(row["corrs"] * row["ok"])})
    return {name: own for (name,), own in tables.grouped(judged, "method").items()}


RULES: dict[str, Callable[[Row], bool]] = {
    "COLMAP's rule": lambda row: row["inliers"] >= max(15, 0.25 * row["corrs_before"]),
    "15 inliers": lambda row: row["inliers"] >= 15,
    "20 inliers": lambda row: row["inliers"] >= 20,
}
"""What others accept a pair by. COLMAP's default: 15 inliers that are a quarter of the matches."""


def split(rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    """Unrelated pairs, and those whose estimate is right."""
    return [row for row in rows if not row["true"]], [row for row in rows if row["right"]]


def rates_sheet(rows: Rows) -> Sheet:
    """Each rule: the share of unrelated pairs that it accepts, and of right estimates that it rejects."""
    records: list[Record] = []
    for name, own in rows.items():
        unrelated, good = split(own)
        line: Record = {"pipeline": name, "unrelated pairs": len(unrelated), "right pairs": len(good)}
        line["unrelated pairs with an F, %"] = percent([bool(row["ok"]) for row in unrelated])
        line["accepted, %"] = share(unrelated, lambda row: row["called"])
        line["rejected, %"] = share(good, lambda row: not row["called"])
        for rule, accepts in RULES.items():
            line[f"{rule}: accepted, %"] = percent([accepts(row) for row in unrelated])
            line[f"{rule}: rejected, %"] = percent([not accepts(row) for row in good])
        for head, figure in (("area", "significance"), ("area by inliers", "inliers")):
            line[head] = f"{tables.chance_of_more(*([row[figure] for row in part] for part in (good, unrelated))):.5f}"
        records.append(line)
    title = f"At level {RELATED:g}: unrelated pairs accepted and right ones (NSGD < {RIGHT}) rejected"
    return Sheet("rates", title, records)


def levels_sheet(rows: Rows) -> Sheet:
    records: list[Record] = []
    for name, own in rows.items():
        unrelated, good = ([row["significance"] for row in part] for part in split(own))
        for level in LEVELS:
            accepted, rejected = percent([x >= level for x in unrelated]), percent([x < level for x in good])
            records.append({"pipeline": name, "level": f"{level:g}", "accepted, %": accepted, "rejected, %": rejected})
    return Sheet("levels", "Points of the ROC curves", records)


def sets_sheet(rows: Rows) -> Sheet:
    records: list[Record] = []
    every = [row for own in rows.values() for row in own]
    for (family, name), own in sorted(tables.grouped(every, "family", "method").items(), key=lambda each: each[0][0]):
        line: Record = {"set": family, "pipeline": name}
        for head, kind in (("right", True), ("other", False)):
            called = [row["called"] for row in own if row["right"] == kind]
            line |= {f"{head} pairs": len(called), f"{head} pairs called related": sum(called)}
        records.append(line)
    return Sheet("sets", "Pairs called related", records)


def share(rows: Sequence[Row], holds: Callable[[Row], bool]) -> Span | str:
    """The share of pairs for which something holds, in %, with its interval."""
    scenes = [f"{row['family']}/{row['scene']}" for row in rows]
    return span(interval(np.array([float(holds(row)) for row in rows]), scenes, PERCENT, share=True), ".2f")


def percent(values: Sequence[bool]) -> str:
    return f"{100 * np.mean(values):.2f}" if values else ""


def draw(rows: Rows, path: Path) -> None:
    """The ROC curves: a panel for each way to judge pairs, a line for each pipeline, a dot at the verdict's level."""
    panels: dict[str, dict[str, tables.Line]] = {"by significance": {}, "by the number of inliers": {}}
    for name, own in ((name, own) for name, own in rows.items() if all(split(own))):
        for figure, lines in zip(("significance", "inliers"), panels.values(), strict=True):
            unrelated, good = (np.array([row[figure] for row in part]) for part in split(own))
            levels = np.append(np.unique(np.concatenate([unrelated, good])), np.inf)
            accepted, rejected = (unrelated >= levels[:, None]).mean(1), (good < levels[:, None]).mean(1)
            perfect = " (along the axes)" if ((accepted == 0) & (rejected == 0)).any() else ""
            dot = int(np.searchsorted(levels, RELATED)) if figure == "significance" else None
            lines[name + perfect] = tables.Line((100 * accepted).tolist(), (100 * rejected).tolist(), dot)
    tables.draw(path, panels, ("unrelated pairs accepted, %", "right pairs rejected, %"), "shares")


def run_similar(arguments: argparse.Namespace) -> None:
    roots = sorted(arguments.root)
    paths = [path for root in roots for path in sorted(root.glob("*/Images/*"))]
    sets = [data.load("fmbench", root=root) for root in roots]  # pairs with a true F, which `fmtorch pairs` would keep
    true = [pair for own in sets for pair in own]
    overlapping = {frozenset((p.image0.path, p.image1.path)): f"{p.family}/{p.scene}" for p in true}
    pipeline = pipeline_of(arguments.pipeline)
    kind = descriptor_kind((presets.pipeline_stages(arguments.pipeline) or {})["features"])
    book = codebook(kind)
    described = [describe(pipeline, read_image(path), 1600).features.descriptors for path in paths]
    start = time.process_time()
    vectors = torch.stack([vlad(local_descriptors(descriptors, kind), book) for descriptors in described])
    seconds = (time.process_time() - start) / len(paths)
    print(f"{len(paths)} images; {1e3 * seconds:.1f} s for a thousand once described")
    proposed = {n: {frozenset(pair) for pair in similar_pairs(paths, vectors, n)} for n in (5, 10, 20)}
    records: list[Record] = []
    for scene, count in [*Counter(overlapping.values()).items(), ("all", len(overlapping))]:
        line: Record = {"scene": scene, "overlapping pairs": count}
        for n, chosen in proposed.items():
            hits = sum(pair in chosen for pair, of in overlapping.items() if scene in (of, "all"))
            line |= {f"similar:{n}, recall, %": f"{100 * hits / count:.0f}", f"similar:{n}, pairs": len(chosen)}
        records.append(line)
    show([Sheet("similar", f"Pairs proposed, of {len(paths) * (len(paths) - 1) // 2}", records)], arguments.table)
