"""Run folders: identity, rows, parts that are merged as they grow in number, by several writers with readers; the code
that makes a result: commits, changed sources, the modules of a user's own parts and what they import."""

import dataclasses
import errno
import importlib
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fmtorch import __version__
from fmtorch.core import pair_key
from fmtorch.runs import PAIR_SCHEMA, PairRow, RunFolder, RunFolderError, fingerprint, identity_digest
from fmtorch.runs import run_folder as parts_module
from fmtorch.runs.run_folder import MAX_LEVEL, MERGED, content_digest, part_files
from tests.evaluation.test_summary import F, bad
from tests.helpers import full_disk, write_file

CONFIG = {
    "pipeline": {"name": "sift_ratio", "estimator": {"threshold": 0.5, "samples": 2000}, "stages": ["a", "b"]},
    "dataset": {"name": "rendered", "digest": "ab12"},
    "seed": 0,
    "files": {},
    "version": "0.1.0",
}
NAN = float("nan")
PIPELINE = {**CONFIG["pipeline"], "estimator": {"threshold": 0.5 + 2**-53, "samples": 2000}}
IDENTITY = {"pipeline": "sift_ratio", "seed": 0}


def row(name: str, **changes: object) -> PairRow:
    plain = PairRow(pair=name, key=pair_key(name), family="indoor", scene="s", ok=True, nsgd=0.01, F=F)
    return dataclasses.replace(plain, **changes)


def test_identity_changes_with_any_field_and_ignores_order_and_container_types() -> None:
    swapped = {key: CONFIG[key] for key in reversed(CONFIG)}
    swapped["pipeline"] = {**CONFIG["pipeline"], "stages": ("a", "b")}
    assert identity_digest(swapped) == identity_digest(CONFIG)
    for change in ({"seed": 1}, {"version": "0.1.1"}, {"pipeline": PIPELINE}, {"extra": None}):
        assert identity_digest({**CONFIG, **change}) != identity_digest(CONFIG), change
    # blake2b of the canonical text, computed apart; run folders of old must stay valid.
    assert identity_digest({"b": 0.1, "a": [1, None, True, "ü"]}) == "2087b63ed2736b65dc1c72eed6e2b183"


def test_open_writes_the_identity_and_continues(tmp_path: Path) -> None:
    path = tmp_path / "runs" / "rendered" / "sift"
    run = RunFolder.open(path, CONFIG)
    stored = json.loads((path / "run.json").read_text())
    assert stored["config"] == CONFIG
    assert stored["identity"] == identity_digest(CONFIG) == run.identity
    before = (path / "run.json").read_bytes(), (path / "run.json").stat().st_mtime_ns
    run.append([row("a")])
    for again in (RunFolder.open(path, CONFIG), RunFolder.load(path)):
        assert (again.done(), again.config, again.read().num_rows) == ({pair_key("a")}, CONFIG, 1)
    assert ((path / "run.json").read_bytes(), (path / "run.json").stat().st_mtime_ns) == before
    with pytest.raises(RunFolderError, match=r"no run\.json"):
        RunFolder.load(tmp_path)


def test_open_refuses_another_identity_and_says_what_differs(tmp_path: Path) -> None:
    RunFolder.open(tmp_path, CONFIG)
    content = (tmp_path / "run.json").read_bytes()
    other = {**CONFIG, "seed": 7, "pipeline": {**CONFIG["pipeline"], "estimator": {"threshold": 1.5, "method": "x"}}}
    with pytest.raises(RunFolderError) as caught:
        RunFolder.open(tmp_path, other)
    message = str(caught.value)
    own = ("threshold: 0.5 -> 1.5", 'method: (absent) -> "x"', "samples: 2000 -> (absent)")
    for part in (str(tmp_path), "seed: 0 -> 7", *(f"pipeline.estimator.{p}" for p in own), "output", "delete"):
        assert part in message
    assert "dataset" not in message
    assert (tmp_path / "run.json").read_bytes() == content


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("run/thesis.tex", "precious", r"not empty.*thesis\.tex"),
        ("run", "", "is a file"),
        *(
            ("run/run.json", text, r"run\.json")
            for text in ("{", "[]", '{"config": 3}', '{"config": {}, "format": 99}')
        ),
    ],
)
def test_what_is_no_run_is_refused(name: str, content: str, message: str, tmp_path: Path) -> None:
    write_file(tmp_path / name, content)
    with pytest.raises(RunFolderError, match=message):
        RunFolder.open(tmp_path / "run", CONFIG)
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == [Path(name).name]


def test_a_part_of_other_columns_is_named(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path, CONFIG)
    run.append([row("a")])
    (part,) = (tmp_path / "pairs").iterdir()
    sink = pa.BufferOutputStream()
    pq.write_table(pq.read_table(part).drop_columns(["H", "corner_error"]), sink)
    data = sink.getvalue().to_pybytes()
    other = part.with_name(f"part-0-0-{content_digest(data)}.parquet")
    other.write_bytes(data)
    part.unlink()
    with pytest.raises(RunFolderError, match=rf"{other.name} cannot be read \(its columns are not those"):
        run.read()


def test_the_order_of_a_list_of_names_is_part_of_the_identity(tmp_path: Path) -> None:
    stages = [{"ratio": {"threshold": 0.8}}, {"gms": {"with_scale": True}}]
    RunFolder.open(tmp_path, {"pruner": stages})
    with pytest.raises(RunFolderError, match=r"differs \(there -> now\): pruner: \[ratio, gms\] -> \[gms, ratio\]\. "):
        RunFolder.open(tmp_path, {"pruner": stages[::-1]})
    with pytest.raises(RunFolderError, match=r"\): pruner\.ratio\.threshold: 0\.8 -> 0\.9\. "):
        RunFolder.open(tmp_path, {"pruner": [{"ratio": {"threshold": 0.9}}, stages[1]]})


def test_a_file_system_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def link(source: object, target: object) -> None:
        raise PermissionError("no hard links here")

    monkeypatch.setattr(os, "link", link)
    assert RunFolder.open(tmp_path, CONFIG).config == CONFIG
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pairs", "run.json"]


def test_rows_come_back_as_they_went(tmp_path: Path) -> None:
    full = row(
        "a/b c/ü", scene="t", nsgd=0.25, nsgd_released=0.3, inlier_rate=0.5, inlier_rate_before=0.25, corrs=3,
        corrs_before=9, features0=100, features1=8000, samples=2000, seconds_features=0.5, seconds_matching=0.25,
        seconds_pruning=0.0, seconds_estimation=1e-3, seconds_metrics=2.0, rotation_error=1.5, translation_error=89.0,
        pose_reason=None,
    )  # fmt: skip
    run = RunFolder.open(tmp_path, CONFIG)
    run.append([full, bad("b", "too few matches: 5, needs 8")])
    run.append([row("c", inlier_rate=NAN)])
    run.append([])
    table = run.read()
    assert table.schema == PAIR_SCHEMA
    first, second, third = table.to_pylist()
    assert first["key"] == pair_key("a/b c/ü")
    assert first == {**dataclasses.asdict(full), "F": list(F)}
    assert (second["ok"], second["nsgd"], second["F"]) == (False, 1.0, None)
    assert second["reason"].startswith("too few")
    assert third["inlier_rate"] is None
    assert len(list((tmp_path / "pairs").iterdir())) == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"corner_error": 1.0, "F": None}, "needs a corner error of at least 0, NSGD NaN and no F"),
        ({"corner_error": 1.0, "nsgd": NAN}, "NSGD NaN and no F"),
        ({"corner_error": -1.0, "nsgd": NAN, "F": None, "H": F}, "a corner error of at least 0"),
        ({"corner_error": 1.0, "nsgd": NAN, "F": None}, "nine finite numbers of H"),
        ({"corner_error": 1.0, "nsgd": NAN, "F": None, "H": F, "ok": False, "reason": "x"}, "the largest error"),
        ({"nsgd": NAN}, "nsgd"),
        ({"nsgd": 1.5}, "nsgd"),
        ({"reason": "x"}, "no reason"),
        ({"rotation_error": 3.0}, "angles of both"),
        ({"rotation_error": 3.0, "translation_error": NAN}, "angles of both"),
        ({"rotation_error": 190.0, "translation_error": 0.0}, "angles of both"),
        ({"F": None}, "nine finite"),
        ({"F": F[:8]}, "nine finite"),
        ({"F": (NAN, *F[1:])}, "nine finite"),
        ({"ok": False}, "a reason"),
        ({"ok": False, "reason": "x", "F": None}, "the largest error"),
        ({"ok": False, "reason": "x", "nsgd": 1.0}, "no F"),
        ({"ok": False, "reason": "x", "nsgd": 1.0, "F": None, "related": True}, "not to be related"),
    ],
)
def test_a_row_cannot_contradict_itself(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        row("a", **changes)


def test_of_duplicates_the_first_written_counts_and_order_is_kept(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path, CONFIG)
    run.append([row("z", corrs=1), row("y", corrs=2), row("z", corrs=3)])
    run.append([row("y", corrs=4), row("a", corrs=5)])
    assert run.read()["corrs"].to_pylist() == [1, 2, 5]
    assert run.done() == {pair_key(name) for name in "zya"}
    assert run.read({pair_key("a"), pair_key("z"), 5})["corrs"].to_pylist() == [1, 5]
    assert run.read(set()).num_rows == 0


def test_an_error_while_writing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = RunFolder.open(tmp_path, CONFIG)

    write = Path.write_bytes

    def full_disk(path: Path, data: bytes) -> None:
        write(path, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")  # as the system says it: of no file

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OSError, match=f"No space left on device: '{tmp_path}/pairs/part-.*parquet'"):
        run.append([row("a")])
    assert list((tmp_path / "pairs").iterdir()) == []


def _write(path: Path, number: int, config: dict[str, object]) -> bool:
    """Whether rows were written: of a folder of the same identity."""
    try:
        run = RunFolder.open(path, config)
    except RunFolderError:
        return False
    for i in range(10):
        run.append([row(f"{number}-{i}"), row(f"shared-{i}", corrs=number)])
    return True


def written(path: Path, *configs: dict[str, object]) -> list[bool]:
    """Of processes that write one folder at once, whether they did."""
    with multiprocessing.get_context("fork").Pool(len(configs)) as pool:
        return pool.starmap(_write, [(path, n, config) for n, config in enumerate(configs)], chunksize=1)


def test_several_processes_write_one_folder(tmp_path: Path) -> None:
    assert written(tmp_path / "run", CONFIG, CONFIG, CONFIG) == [True] * 3
    run = RunFolder.load(tmp_path / "run")
    assert (run.read().num_rows, len(run.done())) == (3 * 10 + 10, 40)
    assert list(tmp_path.rglob("*.tmp")) == []


def test_of_processes_with_different_identities_one_wins(tmp_path: Path) -> None:
    assert sorted(written(tmp_path / "run", *({"seed": n} for n in range(3)))) == [False, False, True]
    run = RunFolder.load(tmp_path / "run")
    corrs = np.unique(run.read()["corrs"].to_numpy()[1::2])
    assert corrs.tolist() == [run.config["seed"]]


def test_summary_files(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path, CONFIG)
    run.write_summary({"recall": 0.5, "none": None}, "| é |\n")
    run.write_summary({"recall": 0.75}, "| ü |\n")
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8")) == {"recall": 0.75}
    assert (tmp_path / "summary.md").read_text(encoding="utf-8") == "| ü |\n"
    with pytest.raises(ValueError, match="JSON"):
        run.write_summary({"recall": NAN}, "")
    assert list(tmp_path.rglob("*.tmp")) == []


def numbered_row(key: int) -> PairRow:
    return PairRow(f"scene/{key}", key, "family", "scene", ok=False, reason=f"reason {key}", corrs=key)


def test_few_parts_are_left_of_many_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts_module, "MERGED", 6)
    folder = RunFolder.open(tmp_path / "run", IDENTITY)
    batches = 2 * 6**2 + 3 * 6 + 5
    for batch in range(batches):
        folder.append([numbered_row(2 * batch), numbered_row(2 * batch + 1)])
    assert len(part_files(folder.path / "pairs")) == 2 + 3 + 5
    assert (folder.read()["key"].to_pylist(), folder.done()) == (list(range(2 * batches)), set(range(2 * batches)))
    assert RunFolder.load(folder.path).read()["reason"][7].as_py() == "reason 7"


def test_parts_do_not_grow_without_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts_module, "MERGED", 2)
    folder = RunFolder.open(tmp_path / "run", IDENTITY)
    for key in range(3 * 2**MAX_LEVEL):
        folder.append([numbered_row(key)])
    assert [len(parts_module.read_part(path)) for path in part_files(folder.path / "pairs")] == [2**MAX_LEVEL] * 3


def test_the_first_written_row_counts_after_parts_were_merged(tmp_path: Path) -> None:
    first, second = (RunFolder.open(tmp_path / "run", IDENTITY) for _ in range(2))
    first.append([PairRow("scene/0", 0, "family", "scene", ok=False, reason="the first")])
    second.append([PairRow("scene/0", 0, "family", "scene", ok=False, reason="the second")])
    for key in range(1, MERGED):
        first.append([numbered_row(key)])
    assert len(part_files(first.path / "pairs")) == 2
    assert first.read()["reason"][0].as_py() == "the first"


def test_a_damaged_part_is_left_for_the_reader_to_name_and_the_remedy_works(tmp_path: Path) -> None:
    folder = RunFolder.open(tmp_path / "run", IDENTITY)
    folder.append([numbered_row(0)])
    (damaged,) = part_files(folder.path / "pairs")
    damaged.write_bytes(b"PAR1")
    for key in range(1, MERGED):
        folder.append([numbered_row(key)])
    assert len(part_files(folder.path / "pairs")) == MERGED
    for use in (folder.read, folder.done):
        with pytest.raises(RunFolderError, match=rf"{damaged.name}.*delete it"):
            use()
    damaged.unlink()
    assert folder.done() == set(range(1, MERGED))


def test_a_full_disk_leaves_parts_unmerged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = RunFolder.open(tmp_path / "run", IDENTITY)
    for key in range(MERGED - 1):
        folder.append([numbered_row(key)])
    monkeypatch.setattr(parts_module.pa, "concat_tables", full_disk)
    folder.append([numbered_row(MERGED - 1)])
    monkeypatch.undo()
    assert len(part_files(folder.path / "pairs")) == MERGED
    assert folder.done() == set(range(MERGED))


def test_readers_lose_no_row_while_parts_are_merged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts_module, "MERGED", 4)  # often
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
    for key in range(80):
        folder.append([numbered_row(key)])
        written[0] = key + 1
    ended.set()
    reader.join()
    assert errors == []


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A checkout of another program, taken for this one."""
    folder = tmp_path / "checkout" / "fmtorch"
    write_file(folder / "a.py", "one")
    (folder.parent / "pyproject.toml").write_text("")
    monkeypatch.setattr(fingerprint, "PACKAGE", folder)
    fingerprint.fmtorch_version.cache_clear()
    yield folder
    fingerprint.fmtorch_version.cache_clear()


def version() -> str:
    fingerprint.fmtorch_version.cache_clear()
    return fingerprint.fmtorch_version()


def git(folder: Path, *arguments: str) -> str:
    who = ["-c", "user.name=A", "-c", "user.email=a@b"]
    command = ["git", "-C", str(folder), *who, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_a_checkout_is_its_commit_and_what_was_changed_since(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkout = package.parent
    git(checkout, "init", "-q")
    assert version().startswith(f"{__version__}+sources.")  # nothing is committed yet
    git(checkout, "add", ".")
    git(checkout, "commit", "-qm", "first")
    commit = git(checkout, "rev-parse", "HEAD")
    clean = f"{__version__}+g{commit[: fingerprint.DIGITS]}"
    assert version() == clean
    (checkout / "notes.md").write_text("decides nothing")
    monkeypatch.setenv("GIT_DIR", str(checkout / "elsewhere"))  # as within a hook of another repository
    assert version() == clean
    monkeypatch.delenv("GIT_DIR")
    (package / "a.py").write_text("two")
    dirty = version()
    assert dirty.startswith(f"{clean}.dirty.")
    (package / "a.py").write_text("three")
    assert dirty != version() != clean
    (package / "a.py").write_text("one")
    assert version() == clean
    (package / "b.py").write_text("new")
    assert version().startswith(f"{clean}.dirty.")


def test_without_git_the_sources_tell(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (package.parent / ".git").mkdir()  # which git refuses, were it there
    monkeypatch.setenv("PATH", "")
    first = version()
    assert first.startswith(f"{__version__}+sources.")
    (package / "a.py").write_text("two")
    assert version() != first
    (package.parent / "pyproject.toml").unlink()  # installed: the version says it all
    assert version() == __version__


OWN = {
    "lone.py": "import helper\nfrom folder import inner\nimport json, numpy", "helper.py": "from folder.inner import x",
    "folder/inner.py": "x = 1", "folder/unused.py": "", "other.py": "",
    "parts/__init__.py": "", "parts/common.py": "import lone", "parts/broken.py": "",
    "parts/deep/stage.py": "from ..common import lone\nfrom . import near\nimport fmtorch.core.types",
    "parts/deep/near.py": "", "parts/deep/below/far.py": "",
}  # fmt: skip
FOLLOWED = {
    "lone": {"lone.py", "helper.py", "folder/inner.py"},
    "parts.deep.stage": {
        *("parts/deep/stage.py", "parts/deep/near.py", "parts/deep/below/far.py", "parts/common.py"),
        *("lone.py", "helper.py", "folder/inner.py"),
    },
}


@pytest.mark.parametrize("module", FOLLOWED)
def test_a_module_is_all_that_it_imports_of_its_own(module, tmp_path, monkeypatch):
    for name, text in OWN.items():
        write_file(tmp_path / name, text)
    monkeypatch.syspath_prepend(str(tmp_path))
    names = [name.removesuffix(".py").replace("/", ".") for name in OWN]
    for name in ("parts", "parts.deep", "folder", *names):
        monkeypatch.delitem(sys.modules, name, raising=False)
    importlib.import_module(module)

    def of() -> str:
        fingerprint.code_digest.cache_clear()
        return fingerprint.code_digest(module)

    before = of()
    assert of() == before
    changing = set()
    for name, text in OWN.items():
        (tmp_path / name).write_text(f"{text}\n# edited")
        changing |= {name} if of() != before else set()
        (tmp_path / name).write_text(text)
    assert changing == FOLLOWED[module]
    (tmp_path / "helper.py").write_text("not python")  # what does not compile is told by its text, and follows nothing
    assert of() != before
    for name in names:
        sys.modules.pop(name, None)


def test_a_module_without_a_file_is_refused() -> None:
    with pytest.raises(TypeError, match="sys is in no file"):
        fingerprint.code_digest("sys")
