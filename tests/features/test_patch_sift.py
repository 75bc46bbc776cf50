import pytest

from fmtorch.features import (
    SIFT,
    ImagePyramid,
    PatchSIFT,
)
from tests.conftest import oracle


@pytest.mark.parametrize("number", ["000", "001"])
def test_resembles_opencvs_descriptors(number: str) -> None:
    file = oracle("sift.npz")
    image = file[f"{number}.image"]
    found = SIFT()(image)
    ours = PatchSIFT()(ImagePyramid(image), found.lafs)
    theirs = found.descriptors / found.descriptors.norm(dim=1, keepdim=True)
    cosine = (ours * theirs).sum(1)
    assert cosine.median() > 0.99
    assert cosine.quantile(0.05) > 0.95
