"""Records, and files that are replaced whole."""

import dataclasses
import errno
import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch import core
from fmtorch.core import Correspondences, Estimate, Features, collate, pair_key
from fmtorch.training import LabelledMatches
from tests.helpers import same

PER_MATCH = ("x0", "x1", "mask", "ratio", "score", "prior", "lafs0", "lafs1", "mutual", "noise", "stretch")


def features(n: int = 5, d: int = 3, seed: int = 0) -> Features:
    g = torch.Generator().manual_seed(seed)
    lafs, scores, descriptors = (torch.rand(n, *shape, generator=g) for shape in ((2, 3), (), (d,)))
    return Features(lafs, scores, descriptors, torch.tensor([480, 640 + seed]))


def drawn(b: int, seed: int, shapes: dict[str, tuple[int, ...]]) -> tuple[dict[str, torch.Tensor], torch.Generator]:
    """Random values for fields, which are named with their shape."""
    g = torch.Generator().manual_seed(seed)
    return {name: torch.rand(b, *shape, generator=g) for names, shape in shapes.items() for name in names.split()}, g


def matches(b: int = 4, n: int = 6, seed: int = 0) -> Correspondences:
    shapes = {"x0 x1": (n, 2), "ratio score prior noise": (n,), "lafs0 lafs1": (n, 2, 3), "stretch": (n, 2, 2, 2)}
    fields, g = drawn(b, seed, {**shapes, "K0 K1": (3, 3), "focal lens": (2, 2)})
    mask, mutual = (torch.rand(b, n, generator=g) < share for share in (0.6, 0.5))
    shared = {name: torch.rand(b, generator=g) < 0.5 for name in ("shared_focal", "shared_lens")}
    sizes = {"size0": torch.tensor([[480, 640]]).repeat(b, 1), "size1": torch.tensor([[240, 320]]).repeat(b, 1)}
    return Correspondences(**fields, **shared, **sizes, mask=mask, mutual=mutual, key=torch.arange(b) + 100 * seed)


def estimate(b: int = 4, n: int = 6, seed: int = 0) -> Estimate:
    shapes = {"fit_scale lens_suggested": (), "focals lens": (2,), "t other_t": (3,), "focal_precision sizes": (2, 2)}
    matrices = {"matrix E R homography other_R": (3, 3), "tangents": (3, 2)}
    matrices |= {"covariance": (7, 7), "covariance_F": (9, 9)}
    fields, g = drawn(b, seed, {**shapes, **matrices})
    flags = {name: torch.rand(b, generator=g) < 0.5 for name in ("contradicted", "sizes_doubtful")}
    ok = torch.arange(b) % 2 == 0
    fields["significance"] = torch.where(ok, torch.rand(b, generator=g, dtype=torch.float64), -torch.inf)
    reason = tuple("" if good else f"reason {i}" for i, good in enumerate(ok.tolist()))
    numbers = {"samples": torch.arange(b) + seed, "pair_type_index": torch.arange(b) % 5}
    return Estimate(**fields, **flags, **numbers, inliers=torch.rand(b, n, generator=g) < 0.5, ok=ok, reason=reason)


def batched_features(b: int = 4) -> Features:
    return collate([features(n=5, seed=i) for i in range(b)])


RECORDS: list[Callable[..., Any]] = [batched_features, matches, estimate]
records = pytest.mark.parametrize("make", RECORDS, ids=["Features", "Correspondences", "Estimate"])


def test_pair_key_is_blake2b_and_stable() -> None:
    digest = hashlib.blake2b(b"Strecha/fountain-P11/3-7", digest_size=8).digest()
    assert pair_key("Strecha/fountain-P11/3-7") == int.from_bytes(digest, "big", signed=True) == 3483045311563998181
    torch.tensor([pair_key(str(i)) for i in range(100)])  # fits int64
    assert any(pair_key(str(i)) < 0 for i in range(100))


@records
def test_to_moves_every_tensor(make: Callable[..., Any]) -> None:
    moved = make().to("meta")
    values = [getattr(moved, f.name) for f in dataclasses.fields(moved)]
    assert all(v.device.type == "meta" for v in values if isinstance(v, torch.Tensor))
    assert sum(isinstance(v, torch.Tensor) for v in values) >= 4


INDICES = [
    0, 3, -1, -4, slice(1, 3), slice(None, None, 2), slice(-2, None), slice(9, 12), [2, 0, 2], (1,), [-1], [],
    [True, False, False, True], torch.tensor([3, 1]), torch.tensor(2), torch.tensor([], dtype=torch.int64),
    torch.tensor([False, True, True, False]), torch.zeros(4, dtype=torch.bool),
]  # fmt: skip


@records
@pytest.mark.parametrize("index", INDICES, ids=str)
def test_indexing_always_gives_a_batch(make: Callable[..., Any], index: Any) -> None:
    expected = np.atleast_1d(np.arange(4)[index.numpy() if isinstance(index, torch.Tensor) else index]).tolist()
    record = make()
    picked = record[index]
    assert type(picked) is type(record)
    for field in dataclasses.fields(record):
        value, part = getattr(record, field.name), getattr(picked, field.name)
        if field.name == "model":
            assert part == value
        elif field.name == "reason":
            assert part == tuple(value[i] for i in expected)
        else:
            assert torch.equal(part, value[torch.tensor(expected, dtype=torch.int64)])


@records
@pytest.mark.parametrize("index", [4, -5, torch.tensor(4), [0, 4], torch.tensor([-5])], ids=str)
def test_an_index_out_of_range_is_an_error(make: Callable[..., Any], index: Any) -> None:
    with pytest.raises(IndexError, match=r"out of (range|bounds)"):
        make()[index]


@records
def test_iteration_gives_batches_of_one_and_ends(make: Callable[..., Any]) -> None:
    record = make()
    parts = list(record)
    assert len(parts) == 4
    assert same(collate(parts), record)


@records
def test_records_are_immutable_and_fields_of_another_length_refused(make: Callable[..., Any]) -> None:
    record = make()
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(record, dataclasses.fields(record)[0].name, torch.zeros(1))
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if isinstance(value, torch.Tensor | tuple):
            with pytest.raises(Exception, match=r"shape|type|reason has 3 entries"):
                record.replace(**{field.name: value[:-1]})


def test_features_of_one_image_are_indexed_by_feature() -> None:
    f = features()
    assert torch.equal(f.keypoints, f.lafs[:, :, 2])
    assert torch.equal(f[[4, 0]].scores, f.scores[[4, 0]])
    assert torch.equal(f[f.scores.argsort(descending=True)[:2]].image_size, f.image_size)
    assert (len(f[-1]), len(f[torch.zeros(5, dtype=torch.bool)])) == (1, 0)
    assert collate([features(n=0)] * 2).lafs.shape == (2, 0, 2, 3)


def test_correspondences_defaults() -> None:
    c = Correspondences(torch.zeros(2, 3, 2), torch.zeros(2, 3, 2), torch.ones(2, 3, dtype=torch.bool))
    assert (len(c), c.keys.tolist(), c.keys.dtype, c.count().tolist()) == (2, [0, 0], torch.int64, [3, 3])
    assert all(getattr(c, f) is None for f in ("ratio", "prior", "lafs0", "lafs1", "size0", "size1", "K0", "K1"))
    assert same(c[0].to("cpu").compact(), c[:1])


def test_keep_only_ever_removes() -> None:
    c = matches()
    chosen = torch.rand(4, 6) < 0.5
    assert torch.equal(c.keep(chosen).mask, c.mask & chosen)
    assert same(c.keep(torch.ones_like(chosen)), c)
    for wrong in (chosen.float(), chosen[:, 1:]):
        with pytest.raises(ValueError, match=r"mask is .*; it must be booleans of shape"):
            inspect.unwrap(Correspondences.keep)(c, wrong)


def _survivors(c: Correspondences) -> list[dict[str, torch.Tensor]]:
    """Per pair, the surviving matches of every per-match field, in order."""
    return [{f: getattr(c, f)[i][c.mask[i]] for f in PER_MATCH} for i in range(len(c))]


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 4), st.integers(0, 9), st.integers(1, 8), st.integers(0, 2**31))
def test_compact_keeps_survivors_and_their_order(b: int, n: int, multiple: int, seed: int) -> None:
    c = matches(b, n, seed)
    packed = c.compact(multiple)
    slots = packed.x0.shape[1]
    longest = int(c.count().max()) if b and n else 0
    assert slots % multiple == 0
    assert longest <= slots < longest + multiple
    assert torch.equal(packed.count(), c.count())
    assert (packed.mask.long().diff(dim=1) <= 0).all()  # survivors first
    for before, after in zip(_survivors(c), _survivors(packed), strict=True):
        assert all(torch.equal(before[f], after[f]) for f in PER_MATCH)
    assert torch.equal(packed.keys, c.keys)
    assert packed.K0 is not None
    assert same(packed.compact(multiple), packed)


def test_compact_passes_gradients_to_survivors_only() -> None:
    c = matches()
    x0 = c.x0.clone().requires_grad_()
    packed = c.replace(x0=x0).compact(8)
    torch.where(packed.mask[..., None], packed.x0, 0.0).sum().backward()
    assert torch.equal(x0.grad, c.mask[..., None].expand_as(x0).float())


def test_collate_stacks_and_pads_single_images() -> None:
    items = [features(n, seed=n) for n in (3, 0, 5)]
    batch = collate(items)
    assert (batch.lafs.shape, batch.valid.sum(-1).tolist()) == ((3, 5, 2, 3), [3, 0, 5])
    assert batch.image_size.tolist() == [[480, 643], [480, 640], [480, 645]]
    for i, item in enumerate(items):
        n = len(item)
        assert torch.equal(batch.lafs[i, :n], item.lafs)
        assert torch.equal(batch.scores[i, :n], item.scores)
        assert torch.equal(batch.descriptors[i, :n], item.descriptors)
        assert not batch.valid[i, n:].any()
        assert not batch.descriptors[i, n:].any()


def test_collate_joins_and_pads_pairs() -> None:
    a, b = matches(2, 3), matches(3, 6, seed=1)
    joined = collate([a, b])
    assert (len(joined), joined.x0.shape) == (5, (5, 6, 2))
    assert not joined.mask[:2, 3:].any()
    assert torch.equal(joined.keys, torch.cat([a.keys, b.keys]))
    assert joined.K0.shape == (5, 3, 3)
    assert same(joined[:2].compact(), a.compact())
    assert same(joined[2:], b)
    assert collate([a.replace(prior=None), b]).prior is None


def test_collate_errors() -> None:
    with pytest.raises(ValueError, match="at least one"):
        collate([])
    for mixed in ([matches(), estimate()], [features(5), batched_features()]):
        with pytest.raises(TypeError, match="one kind"):
            collate(mixed)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@records
def test_on_a_gpu(make: Callable[..., Any]) -> None:
    record = make()
    there = record.to("cuda")
    for index in (-1, [2, 0], [True, False, True, False], torch.tensor([1]), slice(1, 3)):
        assert same(there[index].to("cpu"), record[index])
    assert same(collate([there, there]).to("cpu"), collate([record, record]))


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
    for value, folder in (("/data/x", "/data/x"), ("~/here", "/home/someone/here"), ("", "/scratch/cache/fmtorch")):
        monkeypatch.setenv("FMTORCH_CACHE", value)
        assert core.files.cache_dir() == Path(folder)
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


def test_fields_with_an_entry_for_each_slot() -> None:
    others = {Features: {"lafs", "scores", "descriptors", "mask"}, Estimate: {"inliers"}, LabelledMatches: {"label"}}
    for kind, fields in {**others, Correspondences: {*PER_MATCH}}.items():
        assert set(kind.per_slot) == fields, kind


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
