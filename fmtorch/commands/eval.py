"""`python -m fmtorch.eval pipeline=sift_ratio`: run a pipeline over a data set of image pairs and evaluate it."""

import dataclasses
import functools
import json
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from omegaconf import DictConfig

from fmtorch import data, presets
from fmtorch.commands.config import chosen_pipeline, job, run_command
from fmtorch.commands.options import EVAL, EvalOptions
from fmtorch.commands.report import by_dataset, named
from fmtorch.core.files import write_whole
from fmtorch.core.terminal import console, errors, progress_bars, reporter
from fmtorch.data import ImagePair, ImageSource, PairDataset
from fmtorch.evaluation import curves, tables
from fmtorch.evaluation.run import evaluate_pairs, informed, run_identity, select
from fmtorch.evaluation.statistics import ALL, Group, summarize
from fmtorch.io import MatchStore, export_kinds, write_exports
from fmtorch.jobs.execution import MIN_PAIRS_FOR_PROCESSES, Execution, shard_of
from fmtorch.pipeline.folder import exportable
from fmtorch.pipeline.pipeline import Pipeline, build_pipeline
from fmtorch.presets.composition import execution_of, plain, read_fields
from fmtorch.runs import CachedFeatures, RunFolder, identity_digest
from fmtorch.two_view.arguments import expect_lens, expect_lenses

NO_TRUTH = "its true F, or H, must be a finite 3 x 3 matrix that is not zero"
SWEPT = "FMTORCH_SWEPT"  # names the file in which the jobs of a sweep note their run folders and pairs


def run(config: DictConfig, pipeline_name: str, overrides: Sequence[str] = ()) -> Path:
    """Evaluate one composed config and return the run folder.
    overrides: what the command line changed of the pipeline of that name; said beside it. Raises ValueError, before
    anything is computed or written, where an option is not what it may be."""
    fields = read_fields(EvalOptions, config)
    execution_of(config, fields.workers, fields.processes)
    shard = shard_of(fields.shard)
    device = presets.resolve_device(fields.device)
    exports = export_kinds(fields.export)
    dataset_config = plain(config.dataset)
    presets.expect_buildable(dataset_config, "dataset")
    presets.expect_stages(config)
    model = getattr(presets.target_of(dataset_config, "dataset"), "model", "fundamental")
    if model != "fundamental" and (exports or fields.cameras is not None or fields.lens is not None):
        raise ValueError(f"the data set has {model} matrices, which take no export=, cameras=, lens=: leave them out")
    if fields.lens != "known":
        expect_lens(fields.lens)
    with progress_bars() as progress:
        pipeline: Pipeline = build_pipeline(config, device, model)
        if fields.lens not in (None, "known"):
            expect_lenses(pipeline.estimator, type(pipeline.estimator).__name__)
        dataset = data.build(dataset_config, reporter(progress, "drawing scenes"))
        every, known = _pairs_of(dataset), (fields.cameras, fields.pose.signed, fields.lens)
        identity = run_identity(config, pipeline_name, pipeline, dataset.digest, *known)
        name = f"{pipeline_name.replace('/', '-')}-{identity_digest(identity)[:8]}"
        folder = RunFolder.open(fields.output or Path(f"runs/{dataset.name}/{name}"), identity)
        pairs = select(every, fields.limit)
        if fields.lens == "known" and all(image.lens is None for p in pairs for image in (p.image0, p.image1)):
            raise ValueError("lens=known, but no lens of the data set bends its images: leave it out")
        journal = _journal(folder.path, pairs) if exports else None
        own = pairs if shard is None else shard.of(pairs)
        todo = _missing(own, folder, journal, again=bool(fields.debug))
        bar = progress.add_task(pipeline_name, total=len(own), completed=len(own) - len(todo))
        try:
            for count in _evaluated(config, fields, pipeline, todo, folder, journal):
                progress.advance(bar, count)
        except KeyboardInterrupt:
            kept = len({pair.key for pair in own} & folder.done())
            raise KeyboardInterrupt(f"{kept} of {len(own)} pairs are kept in {folder.path}") from None
    if len(todo) < len(own):
        console.print(f"{len(own) - len(todo)} of {len(own)} pairs taken from an earlier run in {folder.path}")
    table = folder.read({pair.key for pair in pairs}, without=("pair", "F"))
    if shard is not None and len(table) < len(pairs):
        console.print(f"{len(table)} of {len(pairs)} pairs have rows; other shards have the rest")
    if shard is not None and not len(table):  # of an empty shard, before the others
        return folder.path
    title = f"{' '.join([pipeline_name, *overrides])} on {dataset.name}"
    summary = _summarize(table, folder, title, fields.pose.signed)
    if journal is not None and len(table) == len(pairs):
        ends = [(p.image0.path, p.image1.path) for p in pairs if exportable(p)]
        written = write_exports(journal, ends, exports, folder.path)
        console.print(f"{folder.path}: {', '.join(written)}; names of images are below {journal.root}", style="dim")
    if isinstance(pipeline.extractor, CachedFeatures):
        console.print(pipeline.extractor.report(), style="dim")
    for reason, trace in pipeline.tracebacks.items():
        errors.print(f"{reason}\n{trace}".strip(), soft_wrap=True)
    if pairs and summary[ALL]["failures"] == len(pairs):
        again = f"once that is mended, delete {folder.path} to run again"
        if folder.config.get("code"):
            again = f"an edit of your parts makes a new run; otherwise delete {folder.path} to run again"
        raise ValueError(f"every pair failed, the first because: {table['reason'][0]}; {again}")
    return folder.path


def _pairs_of(dataset: PairDataset) -> list[ImagePair]:
    """All pairs of a data set, which may be anybody's. Raises ValueError where one is something else, or twice."""
    kind = type(dataset).__name__
    if lacking := [part for part in ("name", "digest", "__len__", "__getitem__") if not hasattr(dataset, part)]:
        raise ValueError(f"{kind} is no data set: it has no {', '.join(lacking)}")
    pairs = [dataset[i] for i in range(len(dataset))]
    for i, pair in enumerate(pairs):
        if not isinstance(pair, ImagePair):
            raise ValueError(f"{kind}[{i}] is a {type(pair).__name__}; the pairs of a data set are ImagePair")
        if not isinstance(pair.image0, ImageSource):
            raise ValueError(f"{kind}[{i}]: image0 is a {type(pair.image0).__name__}; images are ImageSource")
    ends: dict[str, tuple[ImageSource, ImageSource]] = {}
    twice = [p.identity for p in pairs if ends.setdefault(p.identity, (p.image0, p.image1)) != (p.image0, p.image1)]
    if twice:
        raise ValueError(f"{kind} has two pairs of the identity {twice[0]!r}")
    if not pairs:
        raise ValueError(f"the data set {dataset.name} has no pairs")
    return [p if p.problem or _has_truth(p) else dataclasses.replace(p, problem=NO_TRUTH) for p in pairs]


def _has_truth(pair: ImagePair) -> bool:
    true = pair.F if pair.H is None else pair.H
    return np.shape(true) == (3, 3) and bool(np.isfinite(true).all() and np.any(true))


def _missing(pairs: Sequence[ImagePair], folder: RunFolder, journal: MatchStore | None, again: bool) -> list[ImagePair]:
    """The pairs that have no row yet, or whose matches are to be exported and not in the journal; again: or failed."""
    done = folder.done()
    if again and done:
        table = folder.read(done, without=("pair", "F"))
        done = set(table["key"].filter(table["ok"]).to_pylist())
    images = {p.key: (p.image0.path, p.image1.path) for p in pairs if exportable(p)}
    missing = {k for k, ends in images.items() if journal is not None and not journal.has_pair(*ends)}
    return [p for p in pairs if p.key not in done or (p.key in missing and all(map(Path.is_file, images[p.key])))]


def _evaluated(
    config: DictConfig, fields: EvalOptions, pipeline: Pipeline, pairs: Sequence[ImagePair], folder: RunFolder,
    journal: MatchStore | None,
) -> Iterator[int]:  # fmt: skip
    parallel = len(pairs) >= MIN_PAIRS_FOR_PROCESSES and pipeline.device.type == "cpu"
    execution = execution_of(config, fields.workers, fields.processes).decided(parallel)
    if fields.debug:
        execution = Execution(workers=1)
    if execution.shared and execution.workers is None and pipeline.device.type != "cpu":
        execution = dataclasses.replace(execution, workers=1)
    build = None if execution.shared else functools.partial(build_pipeline, config, pipeline.device, None)
    return evaluate_pairs(
        pipeline, informed(pairs, fields.cameras, fields.lens), seed=fields.seed, batch=fields.batch,
        execution=execution, store=folder.append, build=build, journal=journal, signed=fields.pose.signed,
    )  # fmt: skip


def _summarize(table: pa.Table, folder: RunFolder, title: str, signed: bool) -> dict[str, Group]:
    """The summary of the rows asked for, which is shown; that of all rows of the run goes to its folder."""
    run_table = folder.read()
    summary = summarize(table, signed)
    all_rows = summary if len(run_table) == len(table) else summarize(run_table, signed)
    folder.write_summary(all_rows, tables.summary_markdown(all_rows, title=title))
    write_whole(folder.path / "recall.svg", curves.picture(title.partition(" ")[0], run_table))
    part = "" if len(run_table) == len(table) else f", {len(table)} of the {len(run_table)} pairs of the run"
    for each in tables.terminal_tables(summary, f"{title}{part}", console.width):
        console.print(each)
    about = f"summary.md, recall.svg{f'; of all {len(run_table)} pairs' if part else ''}"
    console.print(f"{folder.path}: pairs/, summary.json, {about}", style="dim", soft_wrap=True)
    if file := os.environ.get(SWEPT):
        with open(file, "ab", buffering=0) as swept:  # a line in one piece, beside those of other processes
            swept.write(f"{json.dumps([str(folder.path.absolute()), table['key'].to_pylist()])}\n".encode())
    return summary


def _journal(folder: Path, pairs: Sequence[ImagePair]) -> MatchStore:
    """Where what is to be exported is kept. Raises ValueError where no pair has images to name."""
    parents = {str(image.path.absolute().parent) for p in pairs if exportable(p) for image in (p.image0, p.image1)}
    if not parents:
        raise ValueError("export: no pair has images in which a pipeline finds keypoints, as they are stored")
    return MatchStore(folder / "export", Path(os.path.commonpath(sorted(parents))))


@job
def task(config: DictConfig) -> None:
    """What Hydra runs."""
    run(config, *chosen_pipeline())


def main() -> None:
    """The command; a sweep ends with one table of all its runs."""
    if not {"-m", "--multirun"} & set(sys.argv[1:]):
        run_command(EVAL, task)
        return
    with tempfile.NamedTemporaryFile("r", suffix=".txt", encoding="utf-8") as swept:
        os.environ[SWEPT] = swept.name  # which jobs in other processes have as well
        try:
            run_command(EVAL, task)
        finally:
            del os.environ[SWEPT]
            _print_sweep(swept.read().splitlines())


def _print_sweep(lines: Sequence[str]) -> None:
    """lines: of each job its run folder and the keys of its pairs, to which the table keeps."""
    jobs = [json.loads(line) for line in lines]
    paths, keys = dict.fromkeys(path for path, _ in jobs), pa.array([key for _, own in jobs for key in own], pa.int64())
    runs = named([RunFolder.load(path) for path in paths]) if len(paths) > 1 else []
    runs = [r._replace(table=r.table.filter(pc.is_in(r.table["key"], keys))) for r in runs]
    for heading, group in by_dataset(runs).items():
        figures = {r.name: summarize(r.table, r.folder.config.get("pose") is not None)[ALL] for r in group}
        for table in tables.terminal_tables(figures, f"{len(group)} runs on {heading}", console.width):
            console.print(table)
