"""Files that are replaced whole, and records."""

import dataclasses
import errno
from pathlib import Path
from typing import Any

import pytest
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch import core
from fmtorch.training import LabelledMatches


def message(error: BaseException) -> str:
    """What a command says of an error, without the place in this file, which counts as a user's own code."""
    return core.error_line(error).partition(f" ({Path(__file__).name}:")[0]


INTERRUPTIONS = [OSError(errno.ENOSPC, "No space left on device"), OSError(errno.EIO, "I/O error"), KeyboardInterrupt()]


@pytest.mark.parametrize("error", INTERRUPTIONS, ids=repr)
def test_a_failed_write_names_the_file_and_leaves_what_was_there(error: BaseException, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_text("before")

    def write() -> None:
        with core.replacing(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(type(error)) as caught:
        write()
    if isinstance(error, OSError):
        assert caught.value.errno == error.errno
        assert message(caught.value) == f"{path}: {error.strerror}"
    assert (path.read_text(), list(tmp_path.iterdir())) == ("before", [path])


def test_a_missing_folder_is_named_by_the_file_and_another_files_error_stays_its_own(tmp_path: Path) -> None:
    path = Path("/nowhere/at/all.txt")
    with pytest.raises(FileNotFoundError) as caught, core.replacing(path) as temporary:
        temporary.write_text("")
    assert message(caught.value) == f"{path}: No such file or directory"
    other = tmp_path / "image.png"
    with pytest.raises(FileNotFoundError) as caught, core.replacing(tmp_path / "out.json"):
        other.read_bytes()
    assert message(caught.value) == f"{other}: No such file or directory"


def test_an_installed_wheel_uses_its_own_folders_and_an_incomplete_one_is_named(tmp_path, monkeypatch):
    package = tmp_path / "site-packages" / "fmtorch"
    monkeypatch.setattr(core.files, "PACKAGE", package)
    with pytest.raises(FileNotFoundError, match=f"'conf' in {package}"):
        core.files.conf_dir()
    for folder in ("fmtorch/conf", "fmtorch/models", "conf", "models"):
        (package.parent / folder).mkdir(parents=True)
    assert (core.files.conf_dir(), core.files.models_dir()) == (package / "conf", package / "models")


def test_cache_dir(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/someone")
    monkeypatch.setenv("XDG_CACHE_HOME", "/scratch/cache")
    monkeypatch.setenv("FMTORCH_CACHE", "/data/fmtorch")
    assert core.files.cache_dir() == Path("/data/fmtorch")
    monkeypatch.setenv("FMTORCH_CACHE", "~/here")
    assert core.files.cache_dir() == Path("/home/someone/here")
    monkeypatch.setenv("FMTORCH_CACHE", "")
    assert core.files.cache_dir() == Path("/scratch/cache/fmtorch")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert core.files.cache_dir() == Path("/home/someone/.cache/fmtorch")


@dataclasses.dataclass(frozen=True, eq=False)
class Sheet(core.Record):
    """A record of rows, with or without a batch; the fields are not annotated for the checks of the test suite."""

    x: Any
    size: Any
    note: Any = None

    def __post_init__(self) -> None:
        core.expect_fields(self)


Sheet.__annotations__ = {
    "x": Float[Tensor, "*batch n 2"], "size": Int[Tensor, "*batch 2"], "note": Float[Tensor, "*batch n"] | None,
}  # fmt: skip
Sheet.__init_subclass__.__func__(Sheet)  # type: ignore[attr-defined]  # read them again


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        (core.Features, ("lafs", "scores", "descriptors", "mask")),
        (core.Correspondences, ("x0", "x1", "mask", "ratio", "score", "prior", "lafs0", "lafs1", "mutual", "noise")),
        (core.Estimate, ("inliers",)),
        (LabelledMatches, ("label",)),
    ],
)
def test_fields_with_an_entry_for_each_slot(kind: type[core.Record], fields: tuple[str, ...]) -> None:
    assert set(kind.per_slot) == set(fields)


@pytest.mark.parametrize("batch", [(), (4,)])
def test_what_fits_is_taken(batch: tuple[int, ...]) -> None:
    sheet = Sheet(torch.zeros(*batch, 3, 2), torch.ones(*batch, 2, dtype=torch.int32))
    assert list(core.slotted(sheet)) == ["x"]
    assert list(core.slotted(sheet.replace(note=torch.zeros(*batch, 3)))) == ["x", "note"]


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"x": None}, TypeError, "x is a NoneType; it must be a tensor"),
        ({"note": [1.0, 2.0]}, TypeError, "note is a list; it must be a tensor"),
        ({"x": torch.zeros(3)}, ValueError, r"x has shape \(3,\); it must be \(N, 2\), or \(B, N, 2\) of a batch"),
        ({"x": torch.zeros(3, 3)}, ValueError, r"x has shape \(3, 3\); it must be \(3, 2\)"),
        ({"size": torch.ones(4, 2).long()}, ValueError, r"size has shape \(4, 2\); it must be \(2,\)"),
        ({"note": torch.zeros(4)}, ValueError, r"note has shape \(4,\); it must be \(3,\)"),
        ({"size": torch.ones(2)}, ValueError, r"size is of torch.float32; it must hold whole numbers"),
        ({"x": torch.zeros(3, 2, dtype=torch.complex64)}, ValueError, "x is of torch.complex64; it must hold floating"),
        ({"size": torch.ones(2, device="meta").long()}, ValueError, "size is on meta and another field on cpu"),
    ],
)
def test_what_does_not_fit_is_named(changes: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        Sheet(torch.zeros(3, 2), torch.ones(2, dtype=torch.int64)).replace(**changes)


def test_a_derived_record_is_another_one_of_its_kind() -> None:
    sheet = Sheet(torch.zeros(3, 2), torch.ones(2, dtype=torch.int64))
    note, inner = torch.ones(3, requires_grad=True), torch.zeros(3, 2).requires_grad_()
    derived = sheet.derived(x=inner, note=note)
    assert isinstance(derived, Sheet)
    assert derived.note is note
    assert derived.size is sheet.size
    assert sheet.note is None
    assert derived.requires_grad
    cut = derived.detach()
    assert not cut.requires_grad
    assert torch.equal(cut.note, note)
    with pytest.raises(ValueError, match="note has shape"):  # what a user changes is checked
        derived.replace(note=torch.ones(2))
