import pytest
import torch

from fmtorch.core import Features, collate
from fmtorch.matching import NearestNeighborMatcher, nearest_neighbors


def features(seed: int, n: int) -> Features:
    generator = torch.Generator().manual_seed(seed)
    return Features(
        lafs=100 * torch.rand(n, 2, 3, generator=generator),
        scores=torch.rand(n, generator=generator),
        descriptors=torch.randint(0, 60, (n, 32), generator=generator).float(),
        image_size=torch.tensor([100 + seed, 200]),
    )


def test_slots_are_the_features_of_image_0() -> None:
    f0, f1 = features(1, 9), features(2, 7)
    neighbors = nearest_neighbors(f0.descriptors, f1.descriptors)
    matches = NearestNeighborMatcher()(f0, f1)
    assert torch.equal(matches.x0[0], f0.keypoints)
    assert torch.equal(matches.x1[0], f1.keypoints[neighbors.nearest])
    assert torch.equal(matches.lafs1[0], f1.lafs[neighbors.nearest])
    assert torch.equal(matches.ratio[0], neighbors.ratio)
    assert matches.mask.all()
    assert matches.size0.tolist() == [[101, 200]]
    assert matches.size1.tolist() == [[102, 200]]


def test_mutual_masks_one_sided_matches() -> None:
    f0, f1 = features(1, 30), features(2, 20)
    neighbors = nearest_neighbors(f0.descriptors, f1.descriptors)
    assert torch.equal(NearestNeighborMatcher(mutual=True)(f0, f1).mask[0], neighbors.mutual)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        NearestNeighborMatcher()(collate([features(1, 3)]), features(2, 3))
