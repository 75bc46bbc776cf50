"""Where estimators fail: sweeps of inlier ratio, noise and number of matches, and conditions that hurt.

python -m scripts.benchmark stress --root DATA/Strecha --root DATA/PhotoTourism --root DATA/KITTI --root DATA/TUM \\
    --rendered full --json stress.jsonl --update docs/appendix/stress.md
python -m scripts.benchmark stress --from stress.jsonl --update docs/appendix/stress.md

--json is appended to pair by pair: started again, the command goes on where it was interrupted, and measures what more
seeds need. A row counts only for the code, options and learned files that it was made with. `sizeless` among an
estimator's stages takes the image sizes away, and with them the prior on cameras.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import torch

from fmtorch import metrics
from fmtorch.core.types import Correspondences
from scripts.benchmark import stress_cases, stress_rows, stress_table
from scripts.benchmark.kept import Kept, Row, read
from scripts.benchmark.specs import Method, identity, informed, read_specs
from scripts.benchmark.stress_cases import Case, on_plane, parallax
from scripts.benchmark.stress_changes import CONDITIONS, SWEEPS, Change, sizes

SPECS = Path(__file__).with_name("stress.txt")
CONDITIONED = "conditions"


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("stress", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    stress_cases.add_arguments(parser)
    parser.add_argument(
        "--specs", type=Path, default=SPECS, help="estimators, one a line; (...) holds for conditions only"
    )
    parser.add_argument("--only", nargs="*", default=[], help=f"of {', '.join([*SWEEPS, CONDITIONED])}; all by default")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", type=Path, help="keep the figures of every pair here, one line each")
    parser.add_argument("--from", nargs="*", type=Path, default=[], dest="earlier", help="only show earlier --json")
    parser.add_argument("--update", type=Path, help="write the tables into this Markdown file, figures beside it")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    unknown = set(arguments.only) - {*SWEEPS, CONDITIONED}
    if unknown:
        raise SystemExit(f"--only {unknown.pop()!r}: it must be one of: {', '.join([*SWEEPS, CONDITIONED])}")
    rows = [row for path in arguments.earlier for row in read(path)]
    if arguments.root or arguments.rendered:
        rows += measure(stress_cases.load(arguments), arguments)
    if not rows:
        raise SystemExit("nothing to show: name sets with --root or --rendered, or earlier figures with --from")
    rows = stress_rows.comparable(rows, [spec.strip("()") for spec in read_specs(arguments.specs)])
    stress_table.show(rows)
    if arguments.update:
        stress_table.write(arguments.update, rows)


def measure(cases: Iterator[Case], arguments: argparse.Namespace) -> list[Row]:
    """A row for each case, change and estimator; those of an interrupted run are not measured again."""
    kept = Kept(arguments.json)
    always, under_conditions = methods(arguments.specs)
    every = {**always, **under_conditions}
    made_with = {name: identity(name, STAGES) for name in every}
    known = kept.by("pair", "sweep", "level", "method", "identity")
    rows = {key: row for key, row in known.items() if made_with.get(row["method"]) == row["identity"]}
    for case in cases:
        for sweep, level, change in changes(arguments.only):
            chosen_methods = every if sweep == CONDITIONED else always
            place = {name: (case.pair.identity, sweep, level, name, made_with[name]) for name in chosen_methods}
            before = {name: rows[key] for name, key in place.items() if key in rows}
            todo = {
                n: m for n, m in chosen_methods.items() if n not in before or len(before[n]["nsgd"]) < arguments.seeds
            }
            changed = change(case) if todo else None
            if changed is None:
                continue
            facts: Row = {"sweep": sweep, "level": level}
            if sweep == CONDITIONED:
                plane = float(on_plane(changed).sum() / changed.right.sum())
                side = max(max(image.tolist()) for image in sizes(changed))
                facts |= {"plane": round(plane, 3), "parallax": round(parallax(changed), 2), "side": side}
            measured = rows_of(changed, todo, arguments.seeds, before)
            new = [row | facts | {"identity": made_with[row["method"]]} for row in measured]
            rows |= {place[row["method"]]: row for row in new}
            kept.add(new)
    complete = [row for row in rows.values() if len(row["nsgd"]) >= arguments.seeds]
    return [row | {name: row[name][: arguments.seeds] for name in ("nsgd", "ms")} for row in complete]


def changes(only: list[str]) -> Iterator[tuple[str, float | str, Change]]:
    """Sweep, level and what is done to a case, of all that are asked for."""
    for sweep, levels in SWEEPS.items():
        if not only or sweep in only:
            yield from ((sweep, level, change) for level, change in levels.items())
    if not only or CONDITIONED in only:
        yield from ((CONDITIONED, name, change) for name, change in CONDITIONS.items())


def rows_of(
    case: Case, chosen_methods: Mapping[str, Method], seeds: int, before: Mapping[str, Row] | None = None
) -> Iterator[Row]:
    """A row for each estimator, with NSGD and processor milliseconds of each seed; they take turns.

    before: rows with fewer seeds, whose figures are taken over.
    """
    c, pair = case.c, case.pair
    F = torch.from_numpy(pair.F)[None]
    assert c.size0 is not None
    assert c.size1 is not None
    earlier = {name: (before or {}).get(name, {"nsgd": [], "ms": []}) for name in chosen_methods}
    figures = {name: (list(row["nsgd"]), list(row["ms"])) for name, row in earlier.items()}
    for seed in range(seeds):
        for name, method in chosen_methods.items():
            if seed < len(figures[name][0]):
                continue
            start = time.process_time()
            estimate = method(pair, c, seed)
            milliseconds = 1e3 * (time.process_time() - start)
            nsgd = float(metrics.nsgd(F, estimate.F, c.size0, c.size1, key=c.keys)) if bool(estimate.ok[0]) else 1.0
            figures[name][0].append(round(nsgd, 6))
            figures[name][1].append(round(milliseconds, 2))
    facts: Row = {"pair": pair.identity, "family": pair.family, "scene": pair.scene}
    facts |= {"matches": len(case.right), "right": int(case.right.sum())}
    for name, (nsgds, ms) in figures.items():
        yield {**facts, "method": name, "nsgd": nsgds, "ms": ms}


def methods(path: Path) -> tuple[dict[str, Method], dict[str, Method]]:
    """The estimators of a file, by their lines: those of every sweep, and those in brackets, of conditions alone."""
    specs = read_specs(path)
    bracketed = [spec.strip("()") for spec in specs if spec.startswith("(")]
    return (
        {spec: informed(spec, STAGES) for spec in specs if not spec.startswith("(")},
        {spec: informed(spec, STAGES) for spec in bracketed},
    )


def sizeless(c: Correspondences) -> Correspondences:
    """The matches of images whose sizes nobody tells."""
    return c.replace(size0=None, size1=None)


STAGES = {"sizeless": sizeless}
