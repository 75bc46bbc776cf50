"""Wrong values are named: to who gives them as an argument, and as the reason of the pair that has them."""

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import metrics
from fmtorch.core import Correspondences, collate
from tests.laws import scene

WRONG = [
    ("prior", 1.5, r"prior of match 3 of pair 1 is 1\.5; it is P\(inlier\), within \[0, 1\]"),
    ("prior", -0.1, "prior of match 3 of pair 1 is -0.1"),
    ("prior", float("nan"), "prior of match 3 of pair 1 is nan"),
    ("noise", 0.0, r"noise of match 3 of pair 1 is 0\.0; it is a standard deviation, positive"),
    ("noise", -1.0, "noise of match 3 of pair 1 is -1"),
    ("noise", float("nan"), "noise of match 3 of pair 1 is nan"),
    ("size0", 0, r"size0 is \(640, 0\); image sizes \(h, w\) are positive"),
    ("size1", -960, r"size1 is \(640, -960\); image sizes"),
]


def with_wrong(name: str, value: float) -> Correspondences:
    """Two pairs, of which the second has a wrong value of the field."""
    c = collate([scene(0, 60), scene(1, 60)]).replace(noise=torch.ones(2, 60))
    field = getattr(c, name).clone()
    field[1, 1 if name.startswith("size") else 3] = value
    return c.replace(**{name: field})


@pytest.mark.parametrize(("name", "value", "message"), WRONG)
def test_wrong_values_are_named_to_who_gives_them(name: str, value: float, message: str) -> None:
    c = with_wrong(name, value)
    given = {field: getattr(c, field) for field in ("prior", "noise", "size0", "size1")}
    with pytest.raises(ValueError, match=message):
        fmtorch.find_fundamental(c.x0, c.x1, **given)
    if not name.startswith("size"):  # what is masked means nothing
        mask = c.mask.clone()
        mask[1, 3] = False
        masked = fmtorch.find_fundamental(c.x0, c.x1, mask=mask, estimator="msac", hypotheses=50, **given)
        assert bool(masked.ok.all())


def test_sizes_of_one_image_and_points_as_opencv_stores_them_are_refused() -> None:
    c = scene(0, 60)
    for known, missing in (("size0", "size1"), ("size1", "size0")):
        with pytest.raises(ValueError, match=f"{known} is given but {missing} is not"):
            fmtorch.find_fundamental(c.x0, c.x1, **{known: c.size0})
    opencv = [x[0, :, None].numpy() for x in (c.x0, c.x1)]
    with pytest.raises(ValueError, match=r"shape \(60, 1, 2\), as OpenCV stores 60 points; give x0\[:, 0\]"):
        fmtorch.find_fundamental(*opencv)
    batch = fmtorch.find_fundamental(*opencv, mask=np.ones((60, 1), bool), estimator="msac")
    assert not bool(batch.ok.any())
    assert set(batch.reason) == {"1 matches; at least 7 are needed"}


@pytest.mark.parametrize("metric", ["sgd", "nsgd", "nsgd_released", "inlier_rate"])
@pytest.mark.parametrize("wrong", [[0, 640], [480, -640], [float("nan"), 640.0], [float("inf"), 640.0]])
def test_metrics_refuse_sizes_of_no_image(metric: str, wrong: list[float]) -> None:
    F = torch.tensor([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]).expand(3, 3, 3)
    sound = torch.tensor([[480, 640]] * 3, dtype=torch.float64)
    sizes = sound.clone()
    sizes[1] = torch.tensor(wrong)
    x = torch.rand(3, 10, 2)
    points = (F, x, x, torch.ones(3, 10, dtype=torch.bool)) if metric == "inlier_rate" else (F, F)
    function = getattr(metrics, metric)
    assert torch.isfinite(torch.as_tensor(function(*points, sound, sound)[0])).all()
    for name, given in (("size0", (sizes, sound)), ("size1", (sound, sizes))):
        with pytest.raises(ValueError, match=rf"{name} is \(.*\); image sizes \(h, w\) are positive"):
            function(*points, *given)
