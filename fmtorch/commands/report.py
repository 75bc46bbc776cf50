"""`fmtorch report runs=[runs]`: runs of `fmtorch.eval` side by side on one HTML page."""

import functools
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from omegaconf import DictConfig
from rich.progress import track

from fmtorch import presets
from fmtorch.commands.config import job, run_command
from fmtorch.commands.options import REPORT, ReportOptions
from fmtorch.core import files, terminal
from fmtorch.evaluation.curves import axis_of
from fmtorch.evaluation.report import Options, Run, Section, gallery, render, run_names, shared_settings
from fmtorch.presets.composition import read_fields
from fmtorch.runs import RunFolder, RunFolderError


def run(config: DictConfig) -> Path:
    """Write the page of a composed config and return its path. Raises ValueError where there is no run."""
    fields = read_fields(ReportOptions, config)
    paths = [Path(path) for path in ([fields.runs] if isinstance(fields.runs, str) else fields.runs)]
    runs = named([RunFolder.load(path) for path in run_folders(paths)])
    if fields.order not in (None, "given", "recall"):
        raise ValueError(f"order={fields.order} must be given or recall")
    given = fields.order == "given" or all((path / "run.json").exists() for path in paths)
    if fields.order == "recall" or not given:
        runs.sort(key=lambda r: -_recall(r.table))
    roots = [fields.root] if isinstance(fields.root, str) else fields.root or []
    places, device = [Path(root) for root in roots], presets.resolve_device(fields.device)
    options = Options(fields.pictures, places, fields.own_code, device, config.cache, fields.cache_limit)
    output = fields.output or (paths[0].parent if (paths[0] / "run.json").exists() else paths[0]) / "report.html"
    files.expect_writable(output.parent)
    if output.is_dir():
        raise ValueError(f"output={output} is a folder; it must name a file")
    sections, groups = [], by_dataset(runs)
    for heading, group in groups.items():
        bar = functools.partial(track, description="drawing pairs", console=terminal.console, transient=True)
        pairs, notes = gallery(group, options, bar)
        signed = [r.name for r in group if r.folder.config.get("pose") is not None]
        sections.append(Section(heading, {r.name: r.table for r in group}, pairs, notes, signed))
    rows = []
    for heading, group in groups.items():
        for r in group:
            settings = (str(r.folder.config.get(name)) for name in ("version", "seed"))
            rows.append([r.name, heading, r.folder.identity[:8], *settings, str(r.folder.path)])
    page = render(str(config.title), sections, rows, shared_settings([r.folder.config for r in runs]))
    files.write_whole(output, page)
    for section in sections:
        for note in section.notes:
            terminal.console.print(f"{section.heading}: {note}")
    if fields.output is None and not (ignoring := output.with_name(".gitignore")).exists():
        files.write_whole(ignoring, f"{output.name}\n{ignoring.name}\n")
    size = output.stat().st_size / 2**20
    terminal.console.print(f"{output}: {files.counted(len(runs), 'run')}, {size:.1f} MB", style="dim")
    return output


def _recall(table: pa.Table) -> float:
    axis = axis_of({"": table})
    return axis.recall(table[axis.column].to_numpy().astype(np.float64))


def run_folders(paths: Iterable[Path]) -> list[Path]:
    """The run folders that the paths are or hold, at any depth. Raises RunFolderError for a path without any."""
    folders: dict[Path, None] = {}
    for path in paths:
        inside = [path] if (path / "run.json").exists() else sorted(file.parent for file in path.glob("**/run.json"))
        if not inside:
            raise RunFolderError(f"{path} holds no run; `python -m fmtorch.eval pipeline=NAME` makes one in runs/")
        folders |= dict.fromkeys(inside)
    return list(folders)


def named(folders: Sequence[RunFolder]) -> list[Run]:
    """The runs that hold results, under short names."""
    held = _merged([(folder, table) for folder in folders if (table := folder.read()).num_rows])
    if not held:
        raise RunFolderError("no run holds results yet; the command that began one continues it")
    configs = [{"pipeline": folder.path.name, **folder.config} for folder, _ in held]
    names = run_names(configs, [folder.identity for folder, _ in held], [_dataset(folder) for folder, _ in held])
    return [Run(name, folder, table) for name, (folder, table) in zip(names, held, strict=True)]


def _merged(held: Sequence[tuple[RunFolder, pa.Table]]) -> list[tuple[RunFolder, pa.Table]]:
    """Runs, with shards of one run, which have no pair in common, as one."""
    runs: list[tuple[RunFolder, pa.Table]] = []
    keys: list[set[int]] = []
    for folder, table in held:
        own = set(table["key"].to_pylist())
        for i, (other, rows) in enumerate(runs):
            if other.identity == folder.identity and not keys[i] & own:
                runs[i] = other, pa.concat_tables([rows, table])
                keys[i] |= own
                break
        else:
            runs.append((folder, table))
            keys.append(own)
    return runs


def by_dataset(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """The runs of each data set, under a heading that says which: its options and families."""
    groups: dict[str, list[Run]] = {}
    for r in runs:
        groups.setdefault(_dataset(r.folder), []).append(r)
    headings = {digest: _heading(group) for digest, group in groups.items()}
    for digest, heading in headings.items():
        if list(headings.values()).count(heading) > 1:
            headings[digest] = f"{heading} ({digest[:6]})"
    return {headings[digest]: group for digest, group in groups.items()}


def _dataset(folder: RunFolder) -> str:
    """What tells a run's data set from others: the digest of its contents."""
    return str((folder.config.get("dataset") or {}).get("digest"))


def _heading(runs: Sequence[Run]) -> str:
    options = {key: value for key, value in (runs[0].folder.config.get("dataset") or {}).items() if key != "digest"}
    preset = presets.files.closest("dataset", options)
    words = [] if preset is None else [preset[0]]
    words += [value for key, value in options.items() if key != "_target_" and isinstance(value, str)]
    families = dict.fromkeys(name for r in runs for name in r.table["family"].to_pylist())
    return ": ".join(dict.fromkeys(", ".join(part) for part in (words, families) if part))


@job
def task(config: DictConfig) -> None:
    """What Hydra runs."""
    run(config)


main = functools.partial(run_command, REPORT, task)
