"""Disks that are full, folders that may not be written, two writers at once: one line that says so, no row lost.

Rights do not bind an administrator, as whom tests often run; so folders that cannot be written are file systems mounted
read-only, and files that stand in the place of folders. Where nothing may be mounted those tests are skipped."""

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers import draw_set
from tests.processes import Command, Starter
from tests.reliability.conftest import Rows, evaluation, parts, results


def may_mount() -> bool:
    if not sys.platform.startswith("linux"):
        return False
    probe = "mount -t tmpfs -o size=4k tmpfs /mnt"  # in a name space of its own
    return subprocess.run(["unshare", "-m", "sh", "-c", probe], capture_output=True, check=False).returncode == 0


mounts = pytest.mark.skipif(not may_mount(), reason="file systems may not be mounted here")


@contextlib.contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[Path]:
    """A file system of so many kilobytes, mounted on the folder. Raises OSError where that is not allowed."""
    folder.mkdir(parents=True, exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder)]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode:
        raise OSError(done.stderr.decode().strip())
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def remount(folder: Path, options: str) -> None:
    """Change a mounted file system: ``size=9m``, ``ro``, ``rw``."""
    subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)


def expect_one_line(command: Command, *words: str) -> None:
    """The command failed and said why, without a traceback."""
    said = command.said()
    assert command.status == 1, said
    assert "Traceback" not in said, said
    last = said.strip().splitlines()[-1]
    assert all(word in said for word in words), said
    assert last.startswith("error: "), said


@mounts
def test_a_full_disk_ends_the_run_which_goes_on_with_more_room(starter, root, truth, tmp_path):
    with small_disk(tmp_path / "disk", 60) as disk:
        full = starter.run(tmp_path, "eval", *evaluation(root, disk / "run"))
        expect_one_line(full, "No space left on device")
        had = results(disk / "run")
        assert 0 < len(had) < len(truth)
        assert all(row in truth for row in had)
        assert not list((disk / "run" / "pairs").glob("*.tmp"))
        remount(disk, "size=4m")
        again = starter.run(tmp_path, "eval", *evaluation(root, disk / "run"))
        assert again.status == 0, again.said()
        assert (results(disk / "run"), parts(disk / "run")) == (truth, len(truth))


@mounts
@pytest.mark.parametrize("options", ["size=40k", "ro"])
def test_a_cache_that_cannot_be_written_costs_no_row(options, starter, root, truth, tmp_path):
    with small_disk(tmp_path / "disk", 40) as disk:
        remount(disk, options)
        run = starter.run(tmp_path, "eval", *evaluation(root, tmp_path / "run", f"cache={disk / 'features'}"))
    assert run.status == 0, run.said()
    assert "nothing is kept in" in run.said()
    assert "No space left on device" in run.said() or "Read-only file system" in run.said()
    assert results(tmp_path / "run") == truth


@mounts
@pytest.mark.parametrize("name", ["eval", "match", "train"])
def test_a_read_only_folder_is_named(name: str, starter: Starter, root: Path, tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 40) as disk:
        remount(disk, "ro")
        command = starter.run(tmp_path, name, *arguments(name, root, disk / "out"))
    expect_one_line(command, "Read-only file system", str(disk / "out"))


@pytest.mark.parametrize("name", ["eval", "match", "train"])
@pytest.mark.parametrize("below", [False, True])
def test_a_file_in_the_place_of_a_folder_is_named(name, below, starter, root, tmp_path):
    (tmp_path / "file").write_text("mine")
    command = starter.run(tmp_path, name, *arguments(name, root, tmp_path / "file" / ("out" if below else "")))
    expect_one_line(command, str(tmp_path / "file"))
    assert (tmp_path / "file").read_text() == "mine"


def arguments(name: str, root: Path, output: Path) -> list[str]:
    if name == "eval":
        return evaluation(root, output)
    if name == "match":
        images = [f"image{i}={root}/scene0/Images/{i:08d}.png" for i in (0, 1)]
        return ["pipeline=sift_gms", *images, f"output={output}"]
    from tests.reliability.test_kills import TRAIN

    two = root.parent / "Two"
    if not two.exists():
        draw_set(two, ["scene0", "scene1"], images=4)
    return ["dataset=fmbench", f"dataset.root={two}", *TRAIN, f"output={output}"]


FULL = """
import errno, os, sys
state = {{"count": 0}}
def hook(event, arguments):
    if event == "open":
        path, mode, flags = arguments
        writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR)
    elif event in ("os.mkdir", "os.link", "os.rename"):
        path, writes = arguments[-3 if event == "os.mkdir" else 1], True
    else:
        return
    if not writes or not str(path).startswith({folder!r}):
        return
    state["count"] += 1
    if state["count"] == {number}:
        print("a write failed", file=sys.stderr)
        raise OSError(errno.ENOSPC, "No space left on device", str(path))
sys.addaudithook(hook)
"""


def fail_at(starter: Starter, root: Path, folder: Path, truth: Rows, number: int) -> bool:
    """Evaluate on a disk that is full at the number-th write of the run, and then again; whether there was such."""
    run_dir = folder / f"run{number}"
    before = FULL.format(folder=str(run_dir), number=number)
    full = starter.run(folder, "eval", *evaluation(root, run_dir, "batch=9"), before=before)
    if "a write failed" not in full.said():
        return False
    if full.status != 0:  # some have a way out, such as a link that cannot be made
        expect_one_line(full, "No space left on device", str(run_dir))
    again = starter.run(folder, "eval", *evaluation(root, run_dir, "batch=9"))
    assert again.status == 0, again.said()
    assert results(run_dir) == truth
    return True


@pytest.mark.parametrize("number", [1, 5])
def test_a_write_that_fails_loses_nothing(number, starter, root, truth, tmp_path):
    assert fail_at(starter, root, tmp_path, truth, number)


@pytest.mark.reliability
def test_no_write_that_fails_loses_anything(starter, root, truth, tmp_path, record_property):
    number = 1
    while fail_at(starter, root, tmp_path, truth, number):
        number += 1
    assert number > 10
    record_property("writes that failed", number - 1)


@pytest.mark.parametrize("runs", [1, pytest.param(10, marks=pytest.mark.reliability)])
def test_two_writers(runs: int, starter: Starter, root: Path, truth: Rows, tmp_path: Path) -> None:
    """Two evaluations of one run at the same time, which share the work or do it twice."""
    for number in range(runs):
        words = evaluation(root, tmp_path / f"run{number}", *(["workers=2", "batch=2"] if number % 2 else []))
        both = [starter.start(tmp_path, "eval", *words) for _ in range(2)]
        assert [command.wait() for command in both] == [0, 0], [command.said() for command in both]
        assert results(tmp_path / f"run{number}") == truth
        assert not list(tmp_path.glob("**/*.tmp"))
