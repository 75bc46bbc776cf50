"""What networks see of matches: known values, missing information, padding."""

import math

import pytest
import torch

from fmtorch.core import Correspondences
from fmtorch.pruning import MatchInputs
from tests.laws import scene

SIDE = ("ratio", "mutual", "scale", "rotation", "agreement")


def one_match(**changes: object) -> Correspondences:
    """A match from (10, 20) to (30, 50); the frame doubles in size and turns by 30 degrees."""
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    lafs0 = torch.tensor([[[[3.0, 0, 10], [0, 3, 20]]]])
    lafs1 = torch.tensor([[[[6 * c, -6 * s, 30], [6 * s, 6 * c, 50]]]])
    return Correspondences(
        lafs0[..., 2], lafs1[..., 2], torch.ones(1, 1, dtype=torch.bool), ratio=torch.tensor([[0.7]]),
        lafs0=lafs0, lafs1=lafs1, size0=torch.tensor([[100, 200]]), size1=torch.tensor([[400, 100]]),
        K0=torch.tensor([[[100.0, 2, 50], [0, 50, 40], [0, 0, 1]]]), K1=torch.eye(3)[None],
        mutual=torch.tensor([[False]]),
    ).replace(**changes)  # fmt: skip


def test_coordinates_by_size() -> None:
    x, mask = MatchInputs("size")(one_match())
    expected = [(10 - 100) / 200, (20 - 50) / 200, (30 - 50) / 400, (50 - 200) / 400]
    torch.testing.assert_close(x, torch.tensor(expected)[None, :, None])
    assert mask.all()


def test_coordinates_by_calibration_are_the_inverse_of_K() -> None:
    c = one_match()
    x, _ = MatchInputs("K")(c)
    ray = torch.linalg.inv(c.K0[0]) @ torch.tensor([10.0, 20, 1])
    torch.testing.assert_close(x[0, :, 0], torch.tensor([float(ray[0]), float(ray[1]), 30, 50]))


def test_side_information() -> None:
    inputs = MatchInputs("size", SIDE)
    x, _ = inputs(one_match())
    assert inputs.channels == x.shape[1] == 10
    expected = [0.7, -1, math.log(2), math.cos(math.radians(30)), math.sin(math.radians(30)), -1]
    torch.testing.assert_close(x[0, 4:, 0], torch.tensor(expected))


@pytest.mark.parametrize("angle", [179.0, 181.0, -1.0, 359.0])
def test_rotation_has_no_jump(angle: float) -> None:
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    lafs1 = torch.tensor([[[[c, -s, 30], [s, c, 50]]]])
    x, _ = MatchInputs("size", ("rotation",))(one_match(lafs1=lafs1))
    torch.testing.assert_close(x[0, 4:, 0], torch.tensor([c, s]))


def test_what_is_not_known_is_zero() -> None:
    bare = one_match(lafs0=None, lafs1=None, ratio=None, mutual=None)
    assert not MatchInputs("size", SIDE)(bare)[0][:, 4:].any()
    flat = one_match(lafs0=torch.zeros(1, 1, 2, 3), ratio=torch.tensor([[torch.nan]]))
    assert torch.isfinite(MatchInputs("size", SIDE)(flat)[0]).all()


@pytest.mark.parametrize("coordinates", ["size", "K"])
def test_padding_is_zero_and_not_finite_matches_are_masked(coordinates: str) -> None:
    K = torch.tensor([[[500.0, 0, 480], [0, 500, 320], [0, 0, 1]]])
    c = scene(1, count=20).replace(K0=K, K1=K)
    mask = c.mask.clone()
    mask[0, 15:] = False
    expected, _ = MatchInputs(coordinates, SIDE)(c.keep(mask).compact())
    garbage = {
        "x0": torch.where(mask[..., None], c.x0, torch.nan), "ratio": torch.where(mask, c.ratio, torch.inf),
        "lafs0": torch.where(mask[..., None, None], c.lafs0, torch.nan),
    }  # fmt: skip
    x, input_mask = MatchInputs(coordinates, SIDE)(c.replace(mask=mask, **garbage))
    assert torch.equal(x[..., :15], expected)
    assert not x[..., 15:].any()
    assert torch.equal(input_mask, mask)
    x, input_mask = MatchInputs(coordinates, SIDE)(c.replace(**garbage))
    assert torch.equal(input_mask, mask)
    assert torch.isfinite(x).all()


@pytest.mark.parametrize(("coordinates", "missing"), [("size", ("size0", "size1")), ("K", ("K1",))])
def test_what_is_missing_is_named(coordinates: str, missing: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=f"coordinates={coordinates} needs `{missing[0]}`"):
        MatchInputs(coordinates)(one_match(**dict.fromkeys(missing)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coordinates": "pixels"}, "coordinates=pixels; there are: size, K"),
        ({"side": ("ratio", "angle")}, "each at most once of ratio"),
        ({"side": ("ratio", "ratio")}, "each at most once of ratio"),
    ],
)
def test_unknown_options(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MatchInputs(**options)  # type: ignore[arg-type]
