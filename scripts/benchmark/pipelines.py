"""Pipelines on the same pairs: recall, inlier rates and counts by set, beside the paper's figures; paired differences.

Each of these benchmarks is a page of settings, the YAML file of its name in this folder: pipelines with their names in
the tables, as PRESET NAME=VALUE ..., what is shown of them, and which are compared. --pipelines takes some of them, by
names or patterns such as 'sift*', or others, as 'NAME = PRESET NAME=VALUE ...'; `+ PRUNER` at the end of one adds one.
The time of pruners is that of all but `ratio` and `one_to_one`, on one thread.

python -m scripts.benchmark pruning --rendered full --limit 50 --pipelines RATIO 'mine = sift_ratio pruner=[ratio,lpm]\'
"""

import argparse
import fnmatch
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from fmtorch.data import ImagePair, read_image, to_grey
from fmtorch.data.construction import keypoints, matchable
from fmtorch.evaluation.run import select
from fmtorch.features import ASIFT
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from scripts.benchmark import pairs
from scripts.benchmark.methods import pipeline_method
from scripts.benchmark.runner import Item, Kept, Measured, Method, Row, add_command, measure
from scripts.benchmark.tables import KIN, Record, Results, Sheet, published, show

FOLDER = Path(__file__).parent
BENCHMARKS = ("pipelines", "hard", "paper", "pruning", "learned", "refinement", "gc_ransac")
RULE = "the paper's rule"
PAPER = {"%Recall": "recall", "%Inlier": "inlier", "%Inlier-m": "inlier_m", "#Corrs": "corrs", "#Corrs-m": "corrs_m"}
"""Columns of the paper's tables, by what they are called here and there."""
Settings = Mapping[str, Any]


def settings_of(name: str) -> dict[str, Any]:
    settings: dict[str, Any] = yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
    return settings


def add_arguments(commands: Any) -> None:
    for name in BENCHMARKS:
        settings = settings_of(name)
        about = f"{settings['about']}\n\n{(__doc__ or '').partition(chr(10))[2]}"
        parser = add_command(commands, name, functools.partial(run, settings), about, seeds=settings.get("seeds", 1))
        pairs.add_set_options(parser)
        asift = "the same of pipelines with ASIFT, a minute a pair"
        parser.add_argument("--asift-limit", type=int, default=10, help=asift)
        add_pipeline_options(parser)


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
    """The pipelines that are asked for, by name. Raises SystemExit for one that is none."""
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
            shared = Pipeline(pipeline.extractor, pipeline.matcher, {}, pairs.no_estimator, model=None)
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
    """What one pipeline has more than another on the pairs that both have, of each set."""
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
