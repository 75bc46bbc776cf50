"""Pruners of a composed config, and those that take other options for pairs of some families."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf, open_dict

from fmtorch.core.stages import Pruner
from fmtorch.presets.objects import expect_buildable, instantiate

FAMILIES = "families"  # among a pruner's options: family -> options that its pairs get instead
OF_PIPELINES = frozenset({FAMILIES, "soft"})  # options that pipelines' presets set, of pruners that may be replaced
WIDE_FAMILIES = "wide"  # stands there for every family of wide baselines
WIDE = (
    "Tanks_and_Temples", "CPC",  # of FM-Bench
    "Strecha", "Strecha_train", "PhotoTourism", "TanksLike",  # further photographs of unordered scenes
    "orbit", "collection",  # rendered
)  # fmt: skip
"""Families of wide baselines by name. The others are taken for videos, whose baselines are short."""


def pruner_configs(config: DictConfig) -> dict[str, Any]:
    """The pruners' configs by name, in the order in which they run.

    Raises ValueError where one pruner's options stand in the place of the names.
    """
    if not config.get("pruner"):
        return {}
    plain = OmegaConf.to_container(config.pruner, resolve=True)
    assert isinstance(plain, dict)
    if "_target_" in plain:
        raise ValueError(
            "pruner: a `_target_` stands where the names of pruners belong; the `# @package` line of a preset of yours "
            "must be `# @package pruner.<name>`, or be left out"
        )
    return {str(name): value for name, value in plain.items() if not _left_over(value)}


def _left_over(value: Any) -> bool:
    """Whether a pipeline's preset says this of a pruner that others have taken the place of."""
    return isinstance(value, Mapping) and bool(value) and OF_PIPELINES.issuperset(value)


def expect_pruners(config: DictConfig) -> None:
    """Raises ValueError, naming the option, where a pruner cannot be built with its options, for any family."""
    for name, value in pruner_configs(config).items():
        for where, options, _ in _versions(name, value):
            expect_buildable(options, where)


def build_pruners(config: DictConfig) -> tuple[dict[str, Pruner], dict[str, dict[str, Pruner]]]:
    """The pruners by name, and by family those that pairs of this family get in their places."""
    usual: dict[str, Pruner] = {}
    for_families: dict[str, dict[str, Pruner]] = {}
    for name, value in pruner_configs(config).items():
        for where, options, families in _versions(name, value):
            pruner = instantiate(options, where)
            if not families:
                usual[name] = pruner
            for family in families:
                for_families.setdefault(family, {})[name] = pruner
    return usual, for_families


def with_explicit(config: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """A composed config in which an option of a pruner that was given explicitly holds for all families.

    A preset's options of families give way to it; those of a family that were given explicitly themselves stay.

    Args:
        config: what Hydra composed; it is not changed.
        overrides: the words that it was composed with, e.g. ``pruner.gms.with_scale=false``.
    """
    words = [word for word in overrides if word.lstrip("+~").startswith("pruner.")]
    given = {path[1:] for word in words for path in _given(word)}
    changed = config
    for name, value in (config.get("pruner") or {}).items():
        families = value.get(FAMILIES) if isinstance(value, DictConfig) else None
        own = {path[1:] for path in given if path[0] == name}
        for family, options in families.items() if isinstance(families, DictConfig) else ():
            for option in options if isinstance(options, DictConfig) else ():
                explicit = (FAMILIES, str(family), str(option))
                stays = any(path == explicit[: len(path)] or path[:3] == explicit for path in own)
                if not stays and any(path[0] == option for path in own):
                    changed = changed.copy() if changed is config else changed
                    with open_dict(changed):
                        del changed.pruner[name][FAMILIES][family][option]
    return changed


def _given(override: str) -> Iterator[tuple[str, ...]]:
    """The paths of the options that an override gives: one, or those within a mapping."""
    parsed = OverridesParser.create().parse_override(override)

    def within(path: tuple[str, ...], value: Any) -> Iterator[tuple[str, ...]]:
        if isinstance(value, Mapping) and value:
            for key, inner in value.items():
                yield from within((*path, str(key)), inner)
        else:
            yield path

    yield from within(tuple(parsed.key_or_group.split(".")), parsed.value())


def _versions(name: str, config: Any) -> Iterator[tuple[str, Any, tuple[str, ...]]]:
    """Where the options of a pruner stand, the options, and the families that they are for: none, the usual ones first.

    Those of a family that is named come after those of all wide baselines, which they add to.
    """
    where = f"pruner.{name}"
    if not isinstance(config, Mapping) or FAMILIES not in config:
        yield where, config, ()
        return
    usual = {key: value for key, value in config.items() if key != FAMILIES}
    yield where, usual, ()
    families = config[FAMILIES] or {}
    if not isinstance(families, Mapping) or not all(isinstance(options, Mapping) for options in families.values()):
        raise ValueError(
            f"{where}.{FAMILIES}={families}; it must be a mapping of families to options, e.g. "
            "{wide: {with_scale: true}}"
        )
    wide = families.get(WIDE_FAMILIES, {})
    if WIDE_FAMILIES in families:
        yield f"{where}.{FAMILIES}.{WIDE_FAMILIES}", {**usual, **wide}, WIDE
    for family, options in families.items():
        if family != WIDE_FAMILIES:
            below = wide if family in WIDE else {}
            yield f"{where}.{FAMILIES}.{family}", {**usual, **below, **options}, (str(family),)
