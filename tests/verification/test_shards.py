"""Verification by processes and in shards: what one process alone writes."""

import shutil
from pathlib import Path

import pytest

import fmtorch
from fmtorch.jobs import Execution
from tests.verification import test_matches as alone
from tests.verification.databases import plain, read, scene, write


@pytest.fixture(autouse=True)
def _small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fmtorch.verification.verify.BATCH", 2)


def test_processes_find_what_threads_find(tmp_path: Path) -> None:
    path, other = tmp_path / "database.db", tmp_path / "other.db"
    write(path, scene(5))
    shutil.copy(path, other)
    reports: list[tuple[int, int]] = []
    fmtorch.verify(path)
    result = fmtorch.verify(other, execution=Execution("processes", 2), report=lambda *c: reports.append(c))
    assert ((result.pairs, result.verified), reports[0]) == ((10, 10), (0, 10))
    assert (reports[-1], plain(read(other))) == ((10, 10), plain(read(path)))


@pytest.mark.parametrize("output", [False, True])
def test_shards_are_merged(output: bool, tmp_path: Path) -> None:
    path, unsharded = tmp_path / "database.db", tmp_path / "whole.db"
    write(path, scene(5))
    shutil.copy(path, unsharded)
    fmtorch.verify(unsharded)
    before = path.read_bytes()
    end = {"output": tmp_path / "verified.db"} if output else {}
    results = [fmtorch.verify(path, shard=f"{i}/3", **end) for i in (1, 3)]
    assert [result.pairs for result in results] == [3, 4]
    assert path.read_bytes() == before  # the database itself is only read
    again = fmtorch.verify(path, shard="3/3", **end)
    assert (again.kept, again.verified) == (4, 0)
    merged = fmtorch.verify(path, **end)  # the second shard was never run
    assert (merged.pairs, merged.verified, merged.kept) == (10, 10, 7)
    assert plain(read(merged.path)) == plain(read(unsharded))
    assert not results[0].path.exists()


def test_shards_of_other_settings_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    write(path, scene(3))
    fmtorch.verify(path, shard="1/2")
    with pytest.raises(ValueError, match=r"holds geometries of other settings; .*: seed: 0 -> 1\. Give the same, or"):
        fmtorch.verify(path, shard="2/2", seed=1)
    with pytest.raises(ValueError, match=r"shard=3/2; it must be i/n"):
        fmtorch.verify(path, shard="3/2")


def test_shards_of_matches_alone(tmp_path: Path) -> None:
    pairs = enumerate(alone.points(4))
    arrays = {f"{i}/{key}": x for i, pair in pairs for key, x in zip(("x0", "x1"), pair, strict=True)}
    path = alone.save(tmp_path / "matches.npz", arrays)
    unsharded = fmtorch.verify(matches=path, output=tmp_path / "whole.npz")
    for shard in ("1/2", "2/2"):
        fmtorch.verify(matches=path, output=tmp_path / "merged.npz", shard=shard)
    merged = fmtorch.verify(matches=path, output=tmp_path / "merged.npz")
    assert (merged.pairs, merged.kept) == (6, 6)
    assert alone.load(merged.path) == alone.load(unsharded.path)
    alone.save(path, {**arrays, "5/x0": arrays["5/x0"] + 1})
    fmtorch.verify(matches=path, output=tmp_path / "new.npz", shard="1/2")
    alone.save(path, arrays)
    with pytest.raises(ValueError, match=r"holds geometries of other settings; what differs .*: files: "):
        fmtorch.verify(matches=path, output=tmp_path / "new.npz", shard="2/2")
