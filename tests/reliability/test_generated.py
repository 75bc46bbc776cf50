"""Generated calls of every public function, in a process of their own (see `generated`)."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fmtorch import geometry, matching, metrics, pruning
from tests.processes import run_command
from tests.reliability.generated import installed_estimators
from tests.variants import variants

BOUNDED = 4  # calls of each subject
WHOLE = {
    "geometry.": 120, "metrics.": 120, "pruning.": 100, "matching.": 200, "types.": 200, "find_fundamental.": 150,
    "pruner.": 150, "fmtorch.match": 150,
}  # fmt: skip
"""Calls of each subject by the beginning of its name: some 16,000 in all."""


def generate(folder: Path, calls: int, *names: str) -> list[dict[str, Any]]:
    """What came of so many calls of each subject; fails where one has a fault."""
    done = run_command("tests.reliability.generated", "--calls", str(calls), *names, cwd=folder, patience=7200)
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"subject"')]
    faults = "\n\n".join(f"{line['subject']}: {line['fault']}\n{line['call']}" for line in lines if "fault" in line)
    assert not faults, faults
    assert done.returncode == 0, f"{done.returncode} after {lines[-1:]}: {done.stderr[-3000:]}"
    return lines


def test_calls_of_everything(tmp_path: Path) -> None:
    lines = generate(tmp_path, BOUNDED)
    called = {line["subject"] for line in lines}
    for module in (geometry, metrics, pruning, matching):
        names = {name for name in module.__all__ if name.islower()}
        assert {f"{module.__name__.removeprefix('fmtorch.')}.{name}" for name in names} <= called
    assert {f"find_fundamental.{name}" for name in installed_estimators()} <= called
    assert {f"pruner.{name}" for name in variants("pruner")} <= called
    assert sum(line.get("sound", 0) for line in lines) > len(lines)


@pytest.mark.reliability
@pytest.mark.parametrize("beginning", WHOLE)
def test_many_calls(beginning: str, tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    lines = generate(tmp_path, WHOLE[beginning], beginning)
    for outcome in ("sound", "refused"):
        record_property(f"{beginning} {outcome}", sum(line.get(outcome, 0) for line in lines))
