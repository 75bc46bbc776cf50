"""torchmetrics classes give over batches what the functions give over all pairs; a clear error without the extra."""

import importlib
import importlib.util
import sys

import pytest
import torch

from fmtorch import metrics
from tests.metrics.test_nsgd import VGA, random_pairs


def test_says_which_extra_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchmetrics", None)
    monkeypatch.delitem(sys.modules, "fmtorch.metrics.torchmetrics", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'fmtorch\[metrics\]'"):
        importlib.import_module("fmtorch.metrics.torchmetrics")


def test_accumulates_over_batches() -> None:
    classes = importlib.import_module("fmtorch.metrics.torchmetrics")
    F_gt, F_est = random_pairs(0, 7)
    sizes, key = VGA.expand(7, 2), torch.arange(7)
    values = metrics.nsgd(F_gt, F_est, sizes, sizes, key=key, samples=50)
    values[3] = torch.nan
    mean, recall, mean_recall = classes.NSGD(samples=50), classes.Recall(threshold=0.1), classes.MeanRecall(maximum=0.1)
    for part in (slice(0, 4), slice(4, 4), slice(4, 7)):
        mean.update(F_gt[part], F_est[part], sizes[part], sizes[part], key[part])
        recall.update(values[part])
        mean_recall.update(values[part])
    expected = metrics.nsgd(F_gt, F_est, sizes, sizes, key=key, samples=50).mean()
    # Two sums in another order.
    torch.testing.assert_close(mean.compute(), expected, rtol=1e-14, atol=0)
    torch.testing.assert_close(recall.compute(), metrics.recall(values, 0.1), rtol=1e-14, atol=0)
    torch.testing.assert_close(mean_recall.compute(), metrics.mean_recall(values, 0.1), rtol=1e-14, atol=0)
    recall.reset()
    with pytest.warns(UserWarning, match="before the ``update`` method"):
        assert recall.compute().isnan()


def test_pose_errors_accumulate_over_batches() -> None:
    classes = importlib.import_module("fmtorch.metrics.torchmetrics")
    errors = torch.tensor([0.5, 3.0, torch.nan, 7.0, 12.0, 18.0, 40.0], dtype=torch.float64)
    parts = (errors[:4], errors[4:4], errors[4:])
    for metric, expected in (
        (classes.PoseAUC(), metrics.pose_auc(errors)),
        (classes.PoseAUC(thresholds=(7.5, 3)), metrics.pose_auc(errors, (7.5, 3))),
        (classes.PoseMAA(), metrics.pose_maa(errors)),
        (classes.PoseMAP(threshold=20), metrics.pose_map(errors, (20,))[0]),
    ):
        for part in parts:
            metric.update(part)
        torch.testing.assert_close(metric.compute(), expected, rtol=1e-14, atol=0)
        metric.reset()
        with pytest.warns(UserWarning, match="before the ``update`` method"):
            assert metric.compute().isnan().all()
