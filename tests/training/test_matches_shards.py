"""Files of matches: what is written is read, damage is noticed, nothing is executed."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from fmtorch.training.stored_matches import SCHEMA, Shard, ShardError, write_shard


def rows(n: int = 5) -> list[dict[str, Any]]:
    rng = np.random.default_rng(0)
    drawn = []
    for i in range(n):
        count = int(rng.integers(1, 50))
        arrays = {
            "x0": (count, 2), "x1": (count, 2), "quality": (count,), "lafs0": (count, 2, 3), "lafs1": (count, 2, 3)
        }  # fmt: skip
        drawn.append(
            {
                "key": int(rng.integers(-(2**62), 2**62)), "identity": f"set/scene/{i}", "family": "set", "scene": "s",
                "reason": "", "matches": count, "inliers": 1, "outliers": count - 1,
                "label": rng.integers(-1, 2, count).astype(np.int8),
                "mutual": rng.integers(0, 2, count).astype(np.uint8),
                "F": rng.normal(size=9), "size0": np.array([480, 640]), "size1": np.array([300, 500]),
                **{name: rng.normal(size=shape).astype(np.float32).ravel() for name, shape in arrays.items()},
            }
        )  # fmt: skip
    drawn.append({
        "key": 7, "identity": "set/scene/failed", "family": "set", "scene": "s", "reason": "no keypoints in image 0",
        "matches": 0, "inliers": 0, "outliers": 0,
    })  # fmt: skip
    return drawn


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "shard.arrow"
    written = rows()
    write_shard(path, written)
    shard = Shard(path, verify=True)
    assert len(shard) == len(written)
    index = shard.index()
    for number, row in enumerate(written):
        for name, values in index.items():
            assert values[number] == row[name]
        arrays = shard.read(number)
        expected = {name: value for name, value in row.items() if isinstance(value, np.ndarray)}
        assert set(arrays) == set(expected)
        for name, value in expected.items():
            assert arrays[name].dtype == value.dtype
            np.testing.assert_array_equal(arrays[name].ravel(), value)
    first = shard.read(0, ("x0", "lafs1", "F", "K0"))
    n = written[0]["matches"]
    assert {name: value.shape for name, value in first.items()} == {"x0": (n, 2), "lafs1": (n, 2, 3), "F": (3, 3)}
    assert not first["x0"].flags.owndata  # a view of the file
    assert [file.name for file in tmp_path.iterdir()] == ["shard.arrow"]


def test_any_dataframe_library_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "shard.arrow"
    write_shard(path, rows())
    table = pa.ipc.open_file(path).read_all()
    assert table.schema.names == SCHEMA.names
    assert table.column("matches").to_pylist()[-1] == 0


def test_the_same_rows_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_shard(tmp_path / name, rows())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_any_changed_byte_of_the_values_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "shard.arrow"
    write_shard(path, rows())
    intact = path.read_bytes()
    values = np.random.default_rng(0).choice(len(intact), 60, replace=False)
    noticed = 0
    for position in values:
        changed = bytearray(intact)
        changed[position] ^= 0x10
        path.write_bytes(changed)
        try:
            shard = Shard(path, verify=True)
        except ShardError:
            noticed += 1
        else:  # padding between buffers, or a number in the headers that no reader looks at
            path.write_bytes(intact)
            for row in range(len(shard)):
                for name, value in Shard(path).read(row).items():
                    np.testing.assert_array_equal(shard.read(row)[name], value)
    assert noticed > 20


@pytest.mark.parametrize("content", ["missing", "empty", "truncated", "pickle", "other schema"])
def test_what_is_no_such_file_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "shard.arrow"
    write_shard(path, rows())
    intact = path.read_bytes()
    if content == "missing":
        path.unlink()
    elif content == "other schema":
        batch = pa.record_batch({"a": [1]})
        with pa.ipc.new_file(str(path), batch.schema) as writer:
            writer.write_batch(batch)
    else:
        path.write_bytes({"empty": b"", "truncated": intact[: len(intact) // 2], "pickle": pickle.dumps([1])}[content])
    with pytest.raises(ShardError, match=r"shard\.arrow"):
        Shard(path)
