"""What every benchmark shares: rows that are kept as they are made, methods that take turns and time."""

import argparse
import dataclasses
import functools
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra.utils
import torch
from rich.console import Console
from rich.progress import track

from fmtorch import presets
from fmtorch.core.stages import PairImages, Pruner, pruned
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import ImagePair
from fmtorch.evaluation.run import evaluate
from fmtorch.geometry import sampson
from fmtorch.pipeline.pipeline import Outcome
from fmtorch.runs import identity_digest
from fmtorch.runs.fingerprint import code_digest, learned, libraries

Row = dict[str, Any]
Stages = list[tuple[str, str, dict[str, Any]]]  # group, preset and changed options of each
console = Console(stderr=True)  # progress and remarks; the tables alone go to the standard output

DIGITS = 16  # of an identity
WHICH = ("pair", "sweep", "level", "threshold", "seed", "method", "identity")  # what rows are told apart by
KEPT = (
    "ok", "reason", "nsgd", "inlier_rate", "inlier_rate_before", "corrs", "corrs_before", "features0", "features1",
    "significance", "rotation_error", "translation_error",
)  # fmt: skip
FOCAL_ERRORS = (5, 10)  # per cent
NEAR = 2.0  # px from the true epipolar line: matches whose exactness is looked at
ROWS = "keeps what each method makes of each pair, one line each; shown where no data set is named"


def add_command(
    commands: Any, name: str, run: Callable[[argparse.Namespace], None], about: str | None,
    add_options: Callable[[argparse.ArgumentParser], None] | None = None, seeds: int | None = None,
) -> argparse.ArgumentParser:  # fmt: skip
    """A command with `--table`, `--seeds` and `--rows` where `seeds` says how many by default, and further options."""
    raw = argparse.RawDescriptionHelpFormatter
    head = (about or "").partition("\n")[0].replace("%", "%%")
    parser: argparse.ArgumentParser = commands.add_parser(name, help=head, description=about, formatter_class=raw)
    if seeds is not None:
        parser.add_argument("--seeds", type=int, default=seeds, help="of the methods, from 0; figures are their means")
        parser.add_argument("--rows", type=Path, help=ROWS)
    parser.add_argument("--table", type=Path, help="write the table here as CSV; of several each to FILE_NAME.csv")
    parser.set_defaults(run=run)
    if add_options is not None:
        add_options(parser)
    return parser


def timed(compute: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """What a call returns, and the seconds of the processor that it takes, whatever else runs beside it."""
    start = time.process_time()
    result = compute(*arguments)
    return result, time.process_time() - start


class Kept:
    """The rows of one benchmark, appended to a file of JSON lines as they are made; without a file in memory only.
    A last line that was cut off by an interruption is removed. Raises SystemExit where the folder does not exist or the
    file holds anything else."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.rows: list[Row] = []
        if path is not None and not path.parent.is_dir():
            raise SystemExit(f"{path}: there is no folder {path.parent}")
        if path is not None and path.exists():
            content = path.read_bytes()
            whole = content[: content.rfind(b"\n") + 1]
            for number, line in enumerate(whole.splitlines(), 1):
                try:
                    self.rows.append(dict(json.loads(line)))
                except (ValueError, TypeError):
                    raise SystemExit(f"{path}, line {number}: no row of a benchmark; name another file") from None
            with path.open("r+b") as file:
                file.truncate(len(whole))

    def add(self, rows: Sequence[Row]) -> None:
        """Keep some rows, together: an interruption loses all of them or none."""
        self.rows += rows
        if self.path is not None and rows:
            with self.path.open("a", encoding="utf-8") as file:
                file.write("".join(json.dumps(row) + "\n" for row in rows))

    def by(self, *fields: str) -> dict[tuple[Any, ...], Row]:
        """The rows by the values of some fields, None for one that is missing; of equals the last."""
        return {tuple(row.get(field) for field in fields): row for row in self.rows}


def identity(stages: Stages, *others: Any) -> str:
    """The digest of what defines the results of stages: options, code, versions of peers' packages, learned files.
    stages: e.g. ``[("estimator", "usac", {"threshold": 1.0})]``. others: configs with a `_target_`, plain values, and
    objects, of which only the learned files count."""
    configs: list[Any] = [presets.merged(presets.load(group, name), options) for group, name, options in stages]
    configs += [other for other in others if isinstance(other, Mapping)]
    rest = [other for other in others if not isinstance(other, Mapping)]
    modules = {name: hydra.utils.get_object(name).__module__ for name in sorted(presets.files.targets_of(configs))}
    made_with = {
        "stages": configs, "code": {target: code_digest(module) for target, module in modules.items()},
        "libraries": libraries(presets.files.peer_packages(configs)),
        "others": [each if isinstance(each, bool | int | float | str | None) else learned(each) for each in rest],
    }  # fmt: skip
    return identity_digest(made_with)[:DIGITS]


@dataclasses.dataclass
class Item:
    """A pair with its matches, which are made when a method first asks for them.
    facts: parts of its rows, those of `WHICH` from the beginning; `make` may add others."""

    pair: ImagePair
    make: Callable[[], Outcome | None]
    facts: Row = dataclasses.field(default_factory=dict)
    images: Callable[[], PairImages] | None = None

    @functools.cached_property
    def outcome(self) -> Outcome | None:
        """The pair with its matches; None where there is nothing to measure."""
        return self.make()

    @property
    def matches(self) -> Correspondences:
        assert self.outcome is not None
        assert self.outcome.correspondences is not None
        return self.outcome.correspondences


class Measured:
    """Anything that is measured. name: in tables; identity: the digest of what its results depend on."""

    name: str
    identity: str

    def applies(self, item: Item) -> bool:
        return True

    def figures(self, item: Item, seed: int) -> Row:
        """What it makes of a pair, with the processor milliseconds of it as ``ms``."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class Method(Measured):
    """Pruners, whose time counts, and an estimator.
    stages: of a family's pairs, by name. untimed: the names of those whose time does not count. takes: whether it is
    measured on an item. view: what is done to a pair and its matches before, by a seed. signed: whether the sign of a
    translation counts."""

    name: str
    identity: str
    stages: Callable[[str], Mapping[str, Pruner]]
    estimator: Callable[[ImagePair, Correspondences, int], Estimate]
    untimed: frozenset[str] = frozenset()
    takes: Callable[[Item], bool] = lambda item: True
    view: Callable[[Outcome, int], Outcome] = lambda outcome, seed: outcome
    signed: bool = False

    def applies(self, item: Item) -> bool:
        return self.takes(item)

    def figures(self, item: Item, seed: int) -> Row:
        """`KEPT` of the pair's row, and milliseconds of pruners and of all."""
        assert item.outcome is not None
        matched = self.view(item.outcome, seed)
        if matched.correspondences is None:
            return {**judged(matched, seed, self.signed), "ms": 0.0, "ms_pruning": 0.0}
        c, pruning = matched.correspondences, 0.0
        for name, stage in self.stages(item.pair.family).items():
            start = time.process_time()
            c = pruned(stage, c, lambda _: item.images())  # type: ignore[misc]
            c = c if bool(c.mask.all()) else c.compact()
            pruning += (time.process_time() - start) * (name not in self.untimed)
        estimate, estimation = timed(self.estimator, matched.pair, c, seed)
        sized = c.replace(size0=matched.correspondences.size0, size1=matched.correspondences.size1)
        outcome = dataclasses.replace(matched, correspondences=sized, estimate=estimate, reason=estimate.reason[0])
        row = judged(outcome, seed, self.signed)
        return {**row, "ms": 1e3 * (pruning + estimation), "ms_pruning": 1e3 * pruning}


def judged(outcome: Outcome, seed: int, signed: bool = False) -> Row:
    """The figures of an estimate by the true F and cameras: `KEPT`, the errors of focal lengths that were not given
    exactly, whether t points backwards, and the exactness of the matches."""
    row = evaluate([outcome], seed, signed)[0]
    figures: Row = {name: getattr(row, name) for name in KEPT}
    errors = [error for error in (row.focal_error0, row.focal_error1) if error is not None]
    figures |= {f"focal_{p}": sum(error <= p / 100 for error in errors) / len(errors) for p in FOCAL_ERRORS if errors}
    t, true = None if outcome.estimate is None else outcome.estimate.t, outcome.pair.t
    if t is not None and true is not None and row.ok and bool(t.isfinite().all()):
        figures["flipped"] = bool(t[0].double().numpy() @ true < 0)
    if (c := outcome.correspondences) is not None:
        r = sampson(torch.from_numpy(outcome.pair.F)[None], c.x0.double(), c.x1.double())[c.mask].abs()
        near = r[r < NEAR]
        figures["distance"] = float(near.median()) if len(near) else math.nan
    return figures


def measure(
    methods: Sequence[Measured], items: Iterable[Item], seeds: int, kept: Kept, title: str = "measuring"
) -> list[Row]:
    """A row for each item, seed and method, those of an earlier run included.
    The methods take turns at each pair, so that what else the machine does slows them down alike. A pair's rows are
    kept together, seed by seed; rows that are there for the same code and options are not measured again."""
    known = kept.by(*WHICH)
    started: set[str] = set()
    rows: list[Row] = []
    for item in track(items, title, console=console, transient=True):
        for seed in range(seeds):
            new = []
            for method in (each for each in methods if each.applies(item)):
                about = {"pair": item.pair.identity, **item.facts, "seed": seed}
                about |= {"method": method.name, "identity": method.identity}
                row = known.get(tuple(about.get(field) for field in WHICH))
                if row is None:
                    if item.outcome is None:
                        continue
                    if method.name not in started:
                        method.figures(item, seed)  # not counted: lazy initialisation
                        started.add(method.name)
                    place = {"family": item.pair.family, "scene": item.pair.scene, **item.facts}
                    row = {**about, **place, **method.figures(item, seed)}
                    new.append(row)
                rows.append(row)
            kept.add(new)
    return rows
