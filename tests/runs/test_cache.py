"""Arrays on disk: whole or absent, bounded, shared by processes, and never trusted."""

import multiprocessing
import os
import pickle
import signal
import time
import warnings
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pytest

from fmtorch.runs import ArrayCache
from tests.helpers import in_threads


def write_many(folder: Path, limit: int, count: int) -> None:
    """Write files of 400 kB in a row, and read others back."""
    warnings.simplefilter("error")
    cache = ArrayCache(folder, limit or None)
    for i in range(count):
        cache.write("some", f"{i % 50}", {"a": np.full(50_000, i % 50)})
        found = cache.read("some", f"{(i * 7) % 50}")
        assert found is None or (found["a"] == (i * 7) % 50).all()


def writer(folder: Path, limit: int = 0, count: int = 1_000_000) -> BaseProcess:
    """A process that does so."""
    process = multiprocessing.get_context("fork").Process(target=write_many, args=(folder, limit, count))
    process.start()
    return process


def test_what_is_written_is_read(tmp_path: Path) -> None:
    cache = ArrayCache(tmp_path / "cache")
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array([True, False]), "empty": np.zeros((0, 2, 3), np.float32)}
    assert cache.read("some", "name") is None
    cache.write("some", "name", arrays)
    cached = cache.read("some", "name")
    assert cached.keys() == arrays.keys()
    for name, array in arrays.items():
        assert cached[name].dtype == array.dtype
        np.testing.assert_array_equal(cached[name], array)
    assert [path.name for path, _ in cache.files()] == ["name.npz"]


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.999])
def test_a_truncated_file_counts_as_absent(tmp_path: Path, keep: float) -> None:
    cache = ArrayCache(tmp_path)
    cache.write("some", "name", {"a": np.arange(1000)})
    path = tmp_path / "some" / "name.npz"
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.warns(UserWarning, match=r"name\.npz is damaged"):
        assert cache.read("some", "name") is None
    cache.write("some", "name", {"a": np.arange(3)})
    cached = cache.read("some", "name")
    assert len(cached["a"]) == 3


def test_a_changed_byte_never_goes_unnoticed_and_never_crashes(tmp_path: Path) -> None:
    cache = ArrayCache(tmp_path)
    values = np.arange(40, dtype=np.uint8)
    cache.write("some", "name", {"a": values})
    path = tmp_path / "some" / "name.npz"
    sound = path.read_bytes()
    for i in range(len(sound)):
        path.write_bytes(sound[:i] + bytes([sound[i] ^ 0x55]) + sound[i + 1 :])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cached = cache.read("some", "name")
        # Some bytes of a zip file mean nothing (time stamps, attributes, an entry's name).
        assert cached is None or "a" not in cached or np.array_equal(cached["a"], values)


def test_a_pickle_is_not_opened(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.mkdir, (str(tmp_path / "executed"),)

    cache = ArrayCache(tmp_path)
    (tmp_path / "some").mkdir()
    with (tmp_path / "some" / "pickled.npz").open("wb") as file:
        np.savez(file, a=np.array([Bomb()], dtype=object))
    (tmp_path / "some" / "plain.npz").write_bytes(pickle.dumps(Bomb()))
    for name in ("pickled", "plain"):
        with pytest.warns(UserWarning, match="damaged"):
            assert cache.read("some", name) is None
    assert not (tmp_path / "executed").exists()


def test_the_least_recently_used_files_go(tmp_path: Path) -> None:
    size = 8 * 1000
    cache = ArrayCache(tmp_path, limit=20 * size)
    for i in range(12):
        cache.write("some", f"{i}", {"a": np.full(1000, i)})
        os.utime(tmp_path / "some" / f"{i}.npz", (1000 + i, 1000 + i))
    assert cache.read("some", "0") is not None  # used again, so 1 is the oldest
    for i in range(12, 40):
        cache.write("other", f"{i}", {"a": np.full(1000, i)})
        time.sleep(0.002)  # file systems' clocks tick in milliseconds
        assert sum(status.st_size for _, status in cache.files()) <= 1.05 * 20 * size
        if i == 24:
            assert cache.read("some", "0") is not None
            assert cache.read("some", "1") is None
    kept = {path.stem for path, _ in cache.files()}
    assert "39" in kept
    assert "12" not in kept


def test_dead_writers_leftovers_are_removed_and_live_ones_kept(tmp_path: Path) -> None:
    (tmp_path / "some").mkdir()
    dead, live = tmp_path / "some" / "a.npz.1.tmp", tmp_path / "some" / "b.npz.2.tmp"
    for path in (dead, live):
        path.write_bytes(b"half")
    before = time.time() - 7200
    os.utime(dead, (before, before))
    ArrayCache(tmp_path).write("some", "c", {"a": np.zeros(1)})
    assert not dead.exists()
    assert live.exists()


def test_a_killed_writer_leaves_no_broken_file(tmp_path: Path) -> None:
    for kill in range(2):
        process = writer(tmp_path)
        deadline = time.monotonic() + 60
        while len(list(tmp_path.glob("some/*.npz"))) < 3 + kill and time.monotonic() < deadline:
            time.sleep(0.002)
        process.kill()
        process.join(60)
        assert process.exitcode == -signal.SIGKILL
    cache = ArrayCache(tmp_path)
    names = [path.stem for path, _ in cache.files()]
    assert len(names) >= 3
    for name in names:  # without a warning
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            cached = cache.read("some", name)
        assert (cached["a"] == int(name)).all()


@pytest.mark.parametrize("limit", [0, 5_000_000])
def test_processes_share_a_cache(tmp_path: Path, limit: int) -> None:
    processes = [writer(tmp_path, limit, 55) for _ in range(2)]
    for process in processes:
        process.join(120)
        assert process.exitcode == 0
    cache = ArrayCache(tmp_path)
    files = list(cache.files())
    for path, _ in files:
        cached = cache.read("some", path.stem)
        assert (cached["a"] == int(path.stem)).all()
    total = sum(status.st_size for _, status in files)
    assert len(files) == 50 if limit == 0 else total <= 1.1 * limit + 2 * 400_500
    assert not list(tmp_path.glob("some/*.tmp"))


def test_threads_share_a_cache(tmp_path: Path) -> None:
    cache = ArrayCache(tmp_path, limit=30 * 8000)

    def work(start: int) -> None:
        for i in range(start, start + 60):
            cache.write("some", f"{i % 40}", {"a": np.full(1000, i % 40)})
            cached = cache.read("some", f"{(i * 3) % 40}")
            assert cached is None or (cached["a"] == (i * 3) % 40).all()

    in_threads(4, work)


def test_what_cannot_be_written_is_told_and_harms_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numpy.savez", full)
    cache = ArrayCache(tmp_path)
    with pytest.warns(UserWarning, match="No space left on device"):
        cache.write("some", "name", {"a": np.zeros(1)})
    assert cache.read("some", "name") is None
    assert not list(tmp_path.glob("some/*"))


def test_bad_arguments(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file"):
        ArrayCache(tmp_path / "file")
    with pytest.raises(ValueError, match="must be positive"):
        ArrayCache(tmp_path, limit=0)


@pytest.mark.parametrize("change", ["value", "shape", "name", "another image's", "no digest"])
def test_a_sound_file_of_wrong_content_is_absent(tmp_path: Path, change: str) -> None:
    cache = ArrayCache(tmp_path)
    cache.write("s", "a", {"x": np.arange(6.0), "seconds": np.array(1.0)})
    cache.write("s", "b", {"x": np.arange(9.0), "seconds": np.array(1.0)})
    path = tmp_path / "s" / "a.npz"
    with np.load(path) as file:
        arrays = dict(file)
    if change == "another image's":
        path.write_bytes((tmp_path / "s" / "b.npz").read_bytes())
    else:
        changed = {
            "value": {**arrays, "x": arrays["x"] + np.eye(6)[0]}, "shape": {**arrays, "x": arrays["x"].reshape(2, 3)},
            "name": {"y": arrays["x"], "seconds": arrays["seconds"], "digest": arrays["digest"]},
            "no digest": {"x": arrays["x"], "seconds": arrays["seconds"]},
        }[change]  # fmt: skip
        np.savez(path, **changed)
    said = "'digest'" if change == "no digest" else "it is not what was written there"
    with pytest.warns(UserWarning, match=f"a.npz is damaged .{said}.; it is computed anew"):
        assert cache.read("s", "a") is None
    cache.write("s", "a", {"x": np.arange(6.0), "seconds": np.array(1.0)})
    again = cache.read("s", "a")
    np.testing.assert_array_equal(again["x"], np.arange(6.0))
