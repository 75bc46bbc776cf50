"""`python -m fmtorch.report runs=[runs]`: runs of `fmtorch.eval` side by side on one HTML page."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import pyarrow as pa
import pyarrow.compute as pc
from omegaconf import DictConfig, OmegaConf
from rich.progress import track

from fmtorch import data, presets
from fmtorch.command import console, exits_with_message
from fmtorch.data import DataError, ImageError, ImagePair, read_image
from fmtorch.evaluation.page import Picture, Section, ShownPair, differing_pairs, render
from fmtorch.evaluation.redraw import difference, drawn
from fmtorch.pipeline import Pipeline
from fmtorch.resources import conf_dir
from fmtorch.storage import RunFolder, RunFolderError
from fmtorch.storage.files import replacing
from fmtorch.storage.runs import leaves

MOST_OPTIONS = 3  # that a run's name tells; of more its identity does


@dataclasses.dataclass(frozen=True)
class _Run:
    """A run folder, its results, and how the page calls it."""

    name: str
    folder: RunFolder
    table: pa.Table


def run(config: DictConfig) -> Path:
    """Write the page of a composed config and return its path. Raises ValueError where there is no run."""
    runs = _named([RunFolder.load(path) for path in run_folders([Path(str(path)) for path in config.runs])])
    sections = []
    for heading, group in _by_dataset(runs).items():
        shown, trouble = _pictures(group, config)
        sections.append(Section(heading, {r.name: r.table for r in group}, shown, trouble))
    rows = [
        [
            r.name,
            r.folder.identity[:8],
            str(r.folder.config.get("version")),
            str(r.folder.config.get("seed")),
            str(r.folder.path),
        ]
        for r in runs
    ]
    output = Path(str(config.output))
    output.parent.mkdir(parents=True, exist_ok=True)
    with replacing(output) as temporary:
        temporary.write_text(render(str(config.title), sections, rows), encoding="utf-8")
    for section in sections:
        if section.no_pictures:
            console.print(f"{section.heading}: {section.no_pictures}", highlight=False)
    console.print(f"[dim]{output}: {len(runs)} runs, {output.stat().st_size / 2**20:.1f} MB[/dim]", highlight=False)
    return output


def run_folders(paths: Iterable[Path]) -> list[Path]:
    """The run folders that the paths are or hold, at any depth. Raises RunFolderError for a path without any."""
    found: dict[Path, None] = {}
    for path in paths:
        inside = [path] if (path / "run.json").exists() else sorted(file.parent for file in path.glob("**/run.json"))
        if not inside:
            raise RunFolderError(f"{path} holds no run; `python -m fmtorch.eval pipeline=NAME` makes one in runs/")
        found |= dict.fromkeys(inside)
    return list(found)


def _named(folders: Sequence[RunFolder]) -> list[_Run]:
    """The runs that hold results: pipelines' names, with what differs where several share one."""
    held = [(folder, table) for folder in folders if (table := folder.read()).num_rows]
    if not held:
        raise RunFolderError("no run holds results yet; the command that began one continues it")
    names = []
    for folder, _ in held:
        same = [other.config for other, _ in held if _pipeline_name(other) == _pipeline_name(folder)]
        names.append(" ".join([_pipeline_name(folder), *_distinction(folder.config, same)]))
    unique = [
        name if names.count(name) == 1 else f"{name} {f.identity[:6]}" for name, (f, _) in zip(names, held, strict=True)
    ]
    return [_Run(name, folder, table) for name, (folder, table) in zip(unique, held, strict=True)]


def _pipeline_name(folder: RunFolder) -> str:
    return str(folder.config.get("pipeline", folder.path.name))


def _distinction(config: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """What tells a run from others of the same pipeline: presets' names, or a few options."""
    words = []
    for group in (*presets.STAGES, "seed", "version"):
        values = [run.get(group) for run in runs]
        if all(value == values[0] for value in values):
            continue
        mine = config.get(group)
        close = presets.closest(group, mine) if isinstance(mine, Mapping) else None
        if close is not None and len({str(presets.closest(group, value)) for value in values if value}) > 1:
            words += [close[0], *(f"{key}={value}" for key, value in close[1].items())]
            continue
        known = [dict(leaves(value, group)) for value in values]
        different = {key for one in known for key in one if any(one[key] != other.get(key) for other in known)}
        own = {key: text for key, text in leaves(mine, group) if key in different}
        if len(own) <= MOST_OPTIONS:
            words += [f"{key}={text.strip(chr(34))}" for key, text in own.items()]
    return words


def _by_dataset(runs: Sequence[_Run]) -> dict[str, list[_Run]]:
    """The runs of each data set, under a heading that says which: its options and families."""
    groups: dict[str, list[_Run]] = {}
    for r in runs:
        groups.setdefault(str((r.folder.config.get("dataset") or {}).get("digest")), []).append(r)
    headings = {digest: _heading(group) for digest, group in groups.items()}
    for digest, heading in headings.items():
        if list(headings.values()).count(heading) > 1:
            headings[digest] = f"{heading} ({digest[:6]})"
    return {headings[digest]: group for digest, group in groups.items()}


def _heading(runs: Sequence[_Run]) -> str:
    options = runs[0].folder.config.get("dataset") or {}
    words = [
        str(value) for key, value in options.items() if key not in ("digest", "_target_") and isinstance(value, str)
    ]
    families = dict.fromkeys(name for r in runs for name in r.table["family"].to_pylist())
    return f"{', '.join(words)}: {', '.join(families)}"


def _pictures(runs: Sequence[_Run], config: DictConfig) -> tuple[list[ShownPair], str]:
    """Pairs of one data set as each run sees them; and why there are none."""
    wanted = differing_pairs({r.name: r.table for r in runs}, int(config.pictures))
    if not wanted:
        return [], "" if config.pictures == 0 else "No pictures: the runs share no pair."
    try:
        pairs = _images(runs[0], config)
        pipelines = {r.name: _pipeline(r, config) for r in runs}
    except (ValueError, ImportError) as error:
        return [], f"No pictures: {error}"
    shown = []
    for identity in track(wanted, "drawing pairs", console=console, transient=True):
        pair = pairs.get(identity)
        if pair is not None:
            shown.append(_shown(pair, runs, pipelines))
    return shown, "" if shown else "No pictures: the data set does not hold the pairs of the runs."


def _images(r: _Run, config: DictConfig) -> Mapping[str, ImagePair]:
    """The pairs of the data set that a run evaluated. Raises ValueError where it is another or nowhere to be found."""
    options = {key: value for key, value in (r.folder.config.get("dataset") or {}).items() if key != "digest"}
    if "_target_" in options or "name" not in options:
        raise DataError("the data set is one of your own, which a report does not load")
    dataset = data.load(**options, root=config.root)
    if dataset.digest != r.folder.config["dataset"].get("digest"):
        raise DataError("the data set has changed since the run")
    return {dataset[i].identity: dataset[i] for i in range(len(dataset))}


def _pipeline(r: _Run, config: DictConfig) -> Pipeline:
    """The pipeline of a run. Raises ValueError for parts that are not the project's own: a file never runs code."""
    stages = {group: r.folder.config.get(group) for group in presets.STAGES}
    foreign = presets.targets_of(stages) - presets.known_targets()
    if foreign:
        raise ValueError(f"{r.name} has parts of your own ({', '.join(sorted(foreign))}), which a report does not load")
    try:
        composed = presets.composed(stages)
    except ValueError as error:
        raise ValueError(f"{r.name}, made by an earlier version, cannot be drawn again: {error}") from error
    cache = {"cache": config.cache, "cache_limit": config.cache_limit}
    return presets.build_pipeline(OmegaConf.create({**composed, **cache}), presets.resolve_device(str(config.device)))


def _shown(pair: ImagePair, runs: Sequence[_Run], pipelines: Mapping[str, Pipeline]) -> ShownPair:
    pictures: list[Picture] = []
    errors: list[str] = []
    notes: list[str] = []
    try:
        images = [read_image(source) for source in (pair.image0, pair.image1)]
    except ImageError as error:
        return ShownPair(f"{pair.identity}: {error}", [])
    for r in runs:
        (outcome,) = pipelines[r.name].run([pair], int(r.folder.config.get("seed", 0)))
        stored = r.table.filter(pc.equal(r.table["key"], pair.key)).to_pylist()[0]
        errors.append(f"{r.name} {stored['nsgd']:.4f}" if stored["ok"] else f"{r.name} failed ({stored['reason']})")
        note = difference(pair, images, stored, outcome)
        if note:
            notes.append(f"{r.name} {note}")
        pictures += drawn(pair, images, stored, outcome, r.name)
    return ShownPair(f"{pair.identity}: NSGD {', '.join(errors)}", pictures, notes)


@hydra.main(version_base=None, config_path=str(conf_dir()), config_name="report")
def main(config: DictConfig) -> None:
    """The command."""
    with exits_with_message():
        run(config)


if __name__ == "__main__":
    main()
