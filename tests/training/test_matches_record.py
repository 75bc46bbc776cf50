"""`LabelledMatches`: shapes, masks, collation."""

from __future__ import annotations

import pytest
import torch
from jaxtyping import TypeCheckError

from fmtorch.core.types import Correspondences
from fmtorch.training import LabelledMatches, collate
from tests.training.conftest import exact


def test_masked_slots_have_no_label() -> None:
    m = exact(pairs=2)
    kept = m.keep(m.correspondences.quality < 0.6)
    outside = ~kept.correspondences.mask
    assert (kept.label[outside] == -1).all()
    assert not kept.labelled[outside].any()
    assert not kept.inlier[outside].any()
    assert torch.equal(kept.labelled, (m.label >= 0) & kept.correspondences.mask)


@pytest.mark.parametrize("multiple", [1, 16])
def test_compact_moves_labels_with_their_matches(multiple: int) -> None:
    m = exact(pairs=3)
    kept = m.keep(m.correspondences.quality < 0.6)
    short = kept.compact(multiple)
    assert short.label.shape == short.correspondences.mask.shape
    assert short.label.shape[1] % multiple == 0
    assert short.label.shape[1] < kept.correspondences.count().max() + multiple
    expected = kept.correspondences.compact(multiple)
    assert torch.equal(short.correspondences.mask, expected.mask)
    assert torch.equal(short.correspondences.x0[short.correspondences.mask], expected.x0[expected.mask])
    for i in range(3):
        assert torch.equal(short.label[i][short.correspondences.mask[i]], kept.label[i][kept.correspondences.mask[i]])


def test_collate_pads_and_indexing_takes_apart() -> None:
    items = [exact(seed, n=n) for seed, n in enumerate((7, 3, 5))]
    batch = collate(items)
    assert len(batch) == 3
    assert batch.label.shape == (3, 7)
    assert batch.correspondences.count().tolist() == [7, 3, 5]
    assert (batch.label[1, 3:] == -1).all()
    for i, item in enumerate(items):
        mine = batch[i].compact()
        assert torch.equal(mine.label, item.label)
        assert torch.equal(mine.F, item.F)
        assert torch.equal(mine.correspondences.lafs1, item.correspondences.lafs1)
    assert len(batch[torch.tensor([True, False, True])]) == 2
    assert len(collate([batch, items[0]])) == 4
    with pytest.raises(ValueError, match="at least one"):
        collate([])


def test_moves_and_gradients_reach_all_tensors() -> None:
    m = exact().to("meta")
    assert m.label.device.type == m.F.device.type == m.correspondences.x0.device.type == "meta"
    leaf = exact()
    x0 = leaf.correspondences.x0.clone().requires_grad_()
    leaf = leaf.replace(correspondences=leaf.correspondences.replace(x0=x0))
    assert leaf.requires_grad
    assert not leaf.detach().requires_grad
    assert leaf.replace(F=leaf.F.clone().requires_grad_()).detach().F.grad_fn is None


def test_shapes_are_checked() -> None:
    x = torch.zeros(2, 3, 2)
    c = Correspondences(x, x, torch.ones(2, 3, dtype=torch.bool))
    with pytest.raises(ValueError, match="label has shape"):
        LabelledMatches(c, torch.zeros(2, 4, dtype=torch.int8), torch.zeros(2, 3, 3).double())
    with pytest.raises((ValueError, TypeCheckError), match=r"F has shape|parameter 'F'"):
        LabelledMatches(c, torch.zeros(2, 3, dtype=torch.int8), torch.zeros(1, 3, 3).double())
