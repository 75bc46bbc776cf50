"""Parts of a run that are merged as they grow in number, by several writers, with readers beside them."""

import threading
from pathlib import Path

import pytest

from fmtorch.runs import PairRow, RunFolder
from fmtorch.runs import run_folder as parts_module
from fmtorch.runs.run_folder import MAX_LEVEL, MERGED, part_files

IDENTITY = {"pipeline": "sift_ratio", "seed": 0}


def row(key: int) -> PairRow:
    return PairRow(f"scene/{key}", key, "family", "scene", ok=False, reason=f"reason {key}", corrs=key)


def keys(folder: RunFolder) -> list[int]:
    return [int(key) for key in folder.read()["key"].to_numpy()]


def test_few_parts_are_left_of_many_batches(tmp_path: Path) -> None:
    folder = RunFolder.open(tmp_path / "run", IDENTITY)
    batches = 2 * MERGED**2 + 3 * MERGED + 5
    for batch in range(batches):
        folder.append([row(2 * batch), row(2 * batch + 1)])
    assert len(part_files(folder.path / "pairs")) == 2 + 3 + 5
    assert keys(folder) == list(range(2 * batches))
    assert folder.done() == set(range(2 * batches))
    assert RunFolder.load(folder.path).read()["reason"][7].as_py() == "reason 7"


def test_parts_do_not_grow_without_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts_module, "MERGED", 2)
    folder = RunFolder.open(tmp_path / "run", IDENTITY)
    for key in range(3 * 2**MAX_LEVEL):
        folder.append([row(key)])
    assert [len(parts_module.read_part(path)) for path in part_files(folder.path / "pairs")] == [2**MAX_LEVEL] * 3


def test_the_first_written_row_counts_after_parts_were_merged(tmp_path: Path) -> None:
    first, second = (RunFolder.open(tmp_path / "run", IDENTITY) for _ in range(2))
    first.append([PairRow("scene/0", 0, "family", "scene", ok=False, reason="the first")])
    second.append([PairRow("scene/0", 0, "family", "scene", ok=False, reason="the second")])
    for key in range(1, MERGED):
        first.append([row(key)])
    assert len(part_files(first.path / "pairs")) == 2
    assert first.read()["reason"][0].as_py() == "the first"


def test_a_damaged_part_is_left_for_the_reader_to_name(tmp_path: Path) -> None:
    folder = RunFolder.open(tmp_path / "run", IDENTITY)
    folder.append([row(0)])
    (damaged,) = part_files(folder.path / "pairs")
    damaged.write_bytes(b"PAR1")
    for key in range(1, MERGED):
        folder.append([row(key)])
    assert len(part_files(folder.path / "pairs")) == MERGED
    with pytest.raises(ValueError, match=damaged.name):
        folder.done()
    damaged.unlink()
    assert folder.done() == set(range(1, MERGED))


def test_a_full_disk_leaves_parts_unmerged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = RunFolder.open(tmp_path / "run", IDENTITY)
    for key in range(MERGED - 1):
        folder.append([row(key)])

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(parts_module.pa, "concat_tables", full)
    folder.append([row(MERGED - 1)])
    monkeypatch.undo()
    assert len(part_files(folder.path / "pairs")) == MERGED
    assert folder.done() == set(range(MERGED))


def test_readers_lose_no_row_while_parts_are_merged(tmp_path: Path) -> None:
    folder = RunFolder.open(tmp_path / "run", IDENTITY)
    written, ended, errors = [0], threading.Event(), list[str]()

    def read() -> None:
        while not ended.is_set():
            before = written[0]
            missing = set(range(before)) - RunFolder.load(folder.path).done()
            if missing:
                errors.append(f"{missing} of {before}")

    reader = threading.Thread(target=read)
    reader.start()
    for key in range(10 * MERGED):
        folder.append([row(key)])
        written[0] = key + 1
    ended.set()
    reader.join()
    assert errors == []
