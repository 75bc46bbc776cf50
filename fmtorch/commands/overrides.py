"""The words of a command line as Hydra reads them: positional file names, and paths with any character in them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

OVERRIDE = re.compile(r"(?P<key>(?:\+\+|\+)?[A-Za-z_][\w./@:-]*)=(?P<value>.*)", re.DOTALL)
LITERAL = re.compile(r"null|true|false|\?\?\?|'.*'|\".*\"", re.IGNORECASE | re.DOTALL)  # what a path field may hold


def hydra_arguments(words: Sequence[str], paths: Sequence[str], positional: Sequence[str]) -> list[str]:
    """The arguments for Hydra: its own flags first, then ``name=value``.

    Args:
        words: the command line.
        paths: fields that hold a path. It may hold spaces, brackets, commas and ``=`` without further quotes.
        positional: fields that may be given by place alone; the last one takes a list if its name ends in ``...``.

    Raises:
        ValueError: for more positional arguments than there are.
    """
    flags, overrides = _split(words)
    multirun = any(flag in ("-m", "--multirun") for flag in flags)
    placed = [word for word in overrides if _is_positional(word)]
    named = [_quoted(word, paths, multirun) for word in overrides if not _is_positional(word)]
    return [*flags, *_named(placed, positional), *named]


def _split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The flags with their values, and all others."""
    takes_value = {name for action in get_args_parser()._actions if action.nargs != 0 for name in action.option_strings}
    flags: list[str] = []
    others: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word == "--":
            return flags, others + rest
        if not word.startswith("-"):
            others.append(word)
            continue
        flags.append(word)
        if word in takes_value and rest and not (word in ("-i", "--info") and "=" in rest[0]):
            flags.append(rest.pop(0))
    return flags, others


def _is_positional(word: str) -> bool:
    return not word.startswith("~") and (OVERRIDE.fullmatch(word) is None or _exists(word))


def _named(placed: list[str], positional: Sequence[str]) -> Iterator[str]:
    """Positional arguments with the names of their fields."""
    if not placed:
        return
    names = ", ".join(name.removesuffix("...") for name in positional)
    if not positional:
        raise ValueError(f"{placed[0]} is not of the form NAME=VALUE")
    if positional[-1].endswith("..."):
        yield f"{names}=[{','.join(map(_text, placed))}]"
        return
    if len(placed) > len(positional):
        raise ValueError(f"{' '.join(placed[len(positional) :])}: only {names} may stand without NAME=")
    yield from (f"{name}={_text(value)}" for name, value in zip(positional, placed, strict=False))


def _quoted(word: str, paths: Sequence[str], multirun: bool) -> str:
    """The override with its value in quotes where that is a path, which Hydra would take apart."""
    match = OVERRIDE.fullmatch(word)
    if match is None:
        return word
    key, value = match["key"], match["value"]
    swept = multirun and ("," in value or "(" in value) and _parses(word)
    is_path = key.lstrip("+") in paths and LITERAL.fullmatch(value) is None and not swept
    is_file = _exists(value) and (set(value) & set(",[]{}()") or not _parses(word))
    return f"{key}={_text(value)}" if is_path or is_file else word


def _exists(value: str) -> bool:
    try:
        return bool(value) and Path(value).exists()
    except OSError:  # too long for a name
        return False


def _parses(word: str) -> bool:
    try:
        OverridesParser.create().parse_override(word)
    except HydraException:
        return False
    return True


def _text(value: str) -> str:
    return QuotedString(text=value, quote=Quote.single).with_quotes()
