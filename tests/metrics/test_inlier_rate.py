"""Inlier rate: known answer, scalar reference, published evaluator, laws."""

import numpy as np
import pytest
import torch

from fmtorch.metrics import ground_truth_inliers, inlier_rate
from tests.conftest import oracle
from tests.metrics.test_nsgd import random_pairs, rows_shifted
from tests.reference import metrics as reference

SIZE = torch.tensor([300, 400])  # diagonal 500: the limit is 1.5 px


def test_known_answer() -> None:
    x0 = torch.tensor([[10.0, 20.0]]).repeat(5, 1)
    x1 = torch.tensor([[90.0, 20.0], [5.0, 21.4], [5.0, 18.6], [5.0, 21.6], [5.0, 80.0]])
    kept = torch.tensor([True, True, False, True, False])
    F = rows_shifted(0.0).float()
    rate = inlier_rate(F, x0, x1, kept, SIZE, SIZE)
    assert rate.before.item() == pytest.approx(3 / 5)
    assert rate.after.item() == pytest.approx(2 / 3)
    assert ground_truth_inliers(F, x0, x1, SIZE, SIZE).tolist() == [True, True, True, False, False]
    # Each image's own diagonal limits its own distance: with half the size in image 1 the limit there is 0.75 px.
    assert inlier_rate(F, x0, x1, kept, SIZE, SIZE / 2).before.item() == pytest.approx(1 / 5)
    assert inlier_rate(F, x0, x1, kept, SIZE, SIZE, threshold=0.0033).before.item() == pytest.approx(4 / 5)


def test_empty_sets_give_nan_and_no_pair_takes_its_batch_down() -> None:
    F_gt, _ = random_pairs(0, 4)
    F_gt[1], F_gt[2] = 0.0, torch.nan
    x = torch.rand(4, 6, 2, dtype=torch.float64) * 200
    inliers = torch.ones(4, 6, dtype=torch.bool)
    inliers[3] = False
    rate = inlier_rate(F_gt, x, x, inliers, SIZE, SIZE)
    assert rate.after[3].isnan()
    assert rate.before[1:3].tolist() == rate.after[1:3].tolist() == [0, 0]
    none = inlier_rate(F_gt[0], x[0, :0], x[0, :0], inliers[0, :0], SIZE, SIZE)
    assert none.before.isnan()
    assert none.after.isnan()


def test_matches_scalar_reference_and_hides_padding() -> None:
    g = torch.Generator().manual_seed(4)
    F_gt, _ = random_pairs(3, 5)
    x0, x1 = (torch.rand(5, 40, 2, generator=g, dtype=torch.float64) * 300 for _ in range(2))
    mask, inliers = (torch.rand(5, 40, generator=g) < 0.7 for _ in range(2))
    size0, size1 = torch.tensor([300, 400]), torch.tensor([500, 300])
    options = {"threshold": 0.05}
    rate = inlier_rate(F_gt, x0, x1, inliers, size0, size1, mask=mask, **options)
    for i in range(5):
        arrays = (v[i].numpy() for v in (F_gt, x0, x1, inliers, mask))
        expected = reference.inlier_rate(*arrays, size0.numpy(), size1.numpy(), **options)
        assert (rate.before[i].item(), rate.after[i].item()) == expected
    garbage = torch.where(mask[..., None], x0, torch.nan)
    again = inlier_rate(F_gt, garbage, x1, inliers, size0, size1, mask=mask, **options)
    wider = [torch.cat([v, v[:, :3]], 1) for v in (x0, x1, inliers)]
    padded_mask = torch.cat([mask, torch.zeros(5, 3, dtype=torch.bool)], 1)
    padded = inlier_rate(F_gt, *wider, size0, size1, mask=padded_mask, **options)
    for other in (again, padded):
        assert torch.equal(other.before, rate.before)
        assert torch.equal(other.after, rate.after)


def test_oracle() -> None:
    file = oracle("fmbench_inlier_rate.npz")
    for case in range(len(file["names"])):
        get = {k[4:]: v for k, v in file.items() if k.startswith(f"{case:03d}.")}
        F, x0, x1, kept, size0, size1 = (
            torch.from_numpy(get[k]) for k in ("F_gt", "X1", "X2", "mask_in", "size1", "size2")
        )
        assert np.array_equal(ground_truth_inliers(F, x0, x1, size0, size1).numpy(), get["mask_gt"])
        rate = inlier_rate(F, x0, x1, kept, size0, size1)
        # Both are one division of the same two integers.
        np.testing.assert_array_equal(torch.stack(rate).numpy(), get["inlier_rate"])
