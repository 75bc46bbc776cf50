"""What the annotations of a record say, and what is told of fields that do not fit them."""

import dataclasses
from typing import Any

import pytest
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch.core import Correspondences, Estimate, Features
from fmtorch.core.records import Record, expect_fields, slotted
from fmtorch.training import LabelledMatches


@dataclasses.dataclass(frozen=True, eq=False)
class Sheet(Record):
    """A record of rows, with or without a batch; the fields are not annotated for the checks of the test suite."""

    x: Any
    size: Any
    note: Any = None

    def __post_init__(self) -> None:
        expect_fields(self)


Sheet.__annotations__ = {
    "x": Float[Tensor, "*batch n 2"], "size": Int[Tensor, "*batch 2"], "note": Float[Tensor, "*batch n"] | None,
}  # fmt: skip
Sheet.__init_subclass__.__func__(Sheet)  # type: ignore[attr-defined]  # read them again


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        (Features, ("lafs", "scores", "descriptors", "mask")),
        (Correspondences, ("x0", "x1", "mask", "ratio", "score", "prior", "lafs0", "lafs1", "mutual", "noise")),
        (Estimate, ("inliers",)),
        (LabelledMatches, ("label",)),
    ],
)
def test_fields_with_an_entry_for_each_slot(kind: type[Record], fields: tuple[str, ...]) -> None:
    assert set(kind.per_slot) == set(fields)


@pytest.mark.parametrize("batch", [(), (4,)])
def test_what_fits_is_taken(batch: tuple[int, ...]) -> None:
    sheet = Sheet(torch.zeros(*batch, 3, 2), torch.ones(*batch, 2, dtype=torch.int32))
    assert list(slotted(sheet)) == ["x"]
    assert list(slotted(sheet.replace(note=torch.zeros(*batch, 3)))) == ["x", "note"]


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
