"""Short names of runs: what differs between them and nothing else."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from fmtorch import presets
from fmtorch.core.settings import leaves

MAX_OPTIONS = 3  # that a name tells of a stage; of more the identity's first digits do
_DIGITS = 6  # of an identity
_LONG = re.compile(r"([0-9a-f]{7})[0-9a-f]+")  # a commit or a digest, whose first digits do


def run_names(
    configs: Sequence[Mapping[str, Any]], identities: Sequence[str], groups: Sequence[str] | None = None
) -> list[str]:
    """A name for each run, no two alike within a group.

    The pipeline's name, unless all runs share it and differ in something else; of the runs of one pipeline the presets,
    options, seeds and versions in which they differ, other than those that the pipeline has of itself; and an
    identity's first digits where that does not tell them apart.

    Args:
        configs: what defines each run, `RunFolder.config`.
        identities: `RunFolder.identity` of each, or what else is unique.
        groups: what runs are shown together, such as the data set: the same method on another has the same name. All
            in one group if not given.
    """
    groups = groups if groups is not None else [""] * len(configs)
    pipelines = [str(config.get("pipeline", "run")) for config in configs]
    details = []
    for pipeline, config in zip(pipelines, configs, strict=True):
        same = [other for name, other in zip(pipelines, configs, strict=True) if name == pipeline]
        details.append(list(_details(config, same)))
    shared = len(set(pipelines)) == 1 and len(configs) > 1 and all(details)
    names = [
        " ".join(words if shared else [pipeline, *words]) for pipeline, words in zip(pipelines, details, strict=True)
    ]
    grouped = list(zip(names, groups, strict=True))
    return [
        entry[0] if grouped.count(entry) == 1 else f"{entry[0]} {identity[:_DIGITS]}"
        for entry, identity in zip(grouped, identities, strict=True)
    ]


def shared_settings(configs: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """What all runs have in common, which their names leave out: the pipeline, stages' presets, seed and version."""
    settings = []
    for group in ("pipeline", *presets.STAGES, "seed", "version"):
        values = [config.get(group) for config in configs]
        if values[0] in (None, {}, []) or any(value != values[0] for value in values):
            continue
        if group == "pruner":
            words = list(_pruners(values[0]))
        else:
            words = list(_stage(group, values[0], [])) if isinstance(values[0], Mapping) else [str(values[0])]
        settings.append((group, ", ".join(words)))
    return settings


def _details(config: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """What tells a run from the others of its pipeline, word by word."""
    usual = presets.pipeline_stages(str(config.get("pipeline"))) or {}
    for group in (*presets.STAGES, "seed", "version"):
        values = [run.get(group) for run in runs]
        mine = config.get(group)
        if group not in config or all(value == mine for value in values) or mine == usual.get(group):
            continue
        if group == "pruner":
            yield from _pruner_words(mine, values)
        elif isinstance(mine, Mapping):
            yield from _stage(group, mine, [value for value in values if isinstance(value, Mapping)])
        elif group == "version":
            yield "version=" + _LONG.sub(r"\1", str(mine))
        else:
            yield f"{group}={mine}"


def _stage(group: str, mine: Mapping[str, Any], values: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The name of a stage's preset or class where others have another, and the options that others, or it, have not."""
    kind, changed = _kind(group, mine)
    alike = [value for value in values if _kind(group, value)[0] == kind]
    others = [dict(leaves(dict(value))) for value in values]
    options = dict(_options(mine, alike)) or {
        key: text for key, text in changed.items() if not others or any(other.get(key) != text for other in others)
    }
    if len(alike) < len(values) or not options or not values:
        yield kind
    yield from _words(options)


def _kind(group: str, value: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """The preset from which a stage differs least, and the options in which it does; without one its class."""
    close = presets.closest(group, value)
    if close is None:
        return str(value.get("_target_", group)).rpartition(".")[2], {}
    return close[0], {key: text for key, text in leaves(close[1]) if key}


def _words(options: Mapping[str, str]) -> list[str]:
    words = [f"{key}={text.strip(chr(34))}" for key, text in options.items()]
    return words if len(words) <= MAX_OPTIONS else []


def _pruner_words(mine: Any, values: Sequence[Any]) -> Iterator[str]:
    """The pruners' names in their order where the order or the choice differs, and options that differ."""
    names = list(_pruners(mine))
    if any(list(_pruners(value)) != names for value in values):
        yield "+".join(names) or "no pruner"
    yield from _words(dict(_options(_pruners(mine), [_pruners(value) for value in values])))


def _pruners(value: Any) -> dict[str, Any]:
    """The pruners of a run by name, stored as a list of one-name mappings."""
    return {name: options for entry in value or () for name, options in entry.items()}


def _options(mine: Mapping[str, Any], values: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """The options that others have with another value, by their shortest unambiguous names."""
    own, others = dict(leaves(dict(mine))), [dict(leaves(dict(value))) for value in values]
    for key, text in own.items():
        if not key.endswith("_target_") and any(other.get(key, text) != text for other in others):
            parts = key.split(".")
            endings = [".".join(parts[i:]) for i in range(len(parts) - 1, -1, -1)]
            yield next(end for end in endings if sum(_ends(other, end) for other in own) == 1), text


def _ends(key: str, ending: str) -> bool:
    return key == ending or key.endswith(f".{ending}")
