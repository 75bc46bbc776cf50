"""What `find_fundamental` and `find_essential` are told of cameras."""

from typing import Any

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch.two_view.arguments import camera_fields
from tests.reference import known_cameras as reference

INF = float("inf")
K = torch.from_numpy(reference.K0)
SCENE = reference.scene(0)
SIZES = {"size0": reference.SIZE, "size1": reference.SIZE}


@pytest.mark.parametrize(
    ("arguments", "focal"),
    [
        ({"focal": (800, 0.05)}, [[800, 0.05], [800, 0.05]]),
        ({"focal": ((800, 0), (900, 0.1))}, [[800, 0], [900, 0.1]]),
        ({"focal": ((800, 0), None)}, [[800, 0], [1, INF]]),
        ({"focal": np.ones((3, 2, 2))}, np.ones((3, 2, 2)).tolist()),
        ({"focal": "unknown"}, [[1, INF], [1, INF]]),
        ({"focal": "shared"}, [[1, INF], [1, INF]]),
        ({"K0": K, "K1": K}, [[1, 0], [1, 0]]),
        ({"K0": K, "K1": K, "focal": 0.05}, [[1, 0.05], [1, 0.05]]),
        ({"K0": K, "K1": K, "focal": (0, 0.1)}, [[1, 0], [1, 0.1]]),
        ({"K0": K, "K1": K, "focal": np.full((3, 2), 0.1)}, [[[1, 0.1], [1, 0.1]]] * 3),
        ({"K0": K}, [[1, 0], [1, INF]]),
        ({"K1": K, "focal": 0.1}, [[1, INF], [1, 0.1]]),
        ({"K0": K, "K1": K, "focal": "shared"}, [[1, INF], [1, INF]]),
    ],
)
def test_forms_of_what_is_known(arguments: dict[str, Any], focal: list[Any]) -> None:
    fields = camera_fields(arguments.get("K0"), arguments.get("K1"), arguments.get("focal"), True)
    assert fields["focal"].tolist() == focal
    said = arguments.get("focal")
    assert ("shared_focal" in fields) == (isinstance(said, str) and said == "shared")
    assert {name for name in ("K0", "K1") if name in fields} == arguments.keys() - {"focal"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"focal": "same"}, "focal is 'same'; it must be None, 'unknown', 'shared'"),
        ({"focal": 800.0}, "focal has shape"),
        ({"focal": (-800.0, 0.1)}, "focal of image 0 of pair 0 is"),
        ({"focal": ((800.0, 0.1), (800.0, -0.1))}, "focal of image 1 of pair 0 is"),
        ({"focal": (800.0, float("nan"))}, "focal of image 0"),
        ({"focal": (800.0, 0.1), "size0": None, "size1": None}, "focal needs the image sizes"),
        ({"K0": K, "size0": None, "size1": None}, "K0 alone needs the image sizes"),
        ({"K0": K, "K1": K, "focal": (800, 0.1, 2)}, "focal has shape"),
        ({"K0": K, "K1": K, "focal": -0.1}, "a relative deviation is not negative"),
        ({"K0": torch.eye(2), "K1": K}, "K0 has shape"),
        ({"K0": K, "K1": 0 * K}, "K1 is singular"),
        ({"K0": K / torch.tensor([[100.0], [100], [1]]), "K1": K}, "K0 has a focal length of 5.09902"),
    ],
)
def test_wrong_arguments_are_named(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=r"^") as error:
        fmtorch.find_fundamental(SCENE.x0, SCENE.x1, **(SIZES | arguments))
    assert str(error.value).startswith(said) or said in str(error.value)


def test_a_name_that_is_none_has_a_near_one() -> None:
    with pytest.raises(ValueError, match=r"^focal is 'shraed'; it must be .*; did you mean 'shared'\?"):
        fmtorch.find_fundamental(SCENE.x0, SCENE.x1, focal="shraed")


def test_homographies_have_no_essential_matrix() -> None:
    with pytest.raises(ValueError, match="needs one that gives fundamental matrices"):
        fmtorch.find_essential(SCENE.x0, SCENE.x1, K, K, estimator="homography")


def test_calibrations_come_in_any_form() -> None:
    """One for all pairs or one each, lists of pairs, whole numbers."""
    x0, x1 = SCENE.x0, SCENE.x1
    alone = fmtorch.find_essential(x0, x1, K, reference.K1)
    both = fmtorch.find_essential([x0, x0[:90]], [x1, x1[:90]], [K, K], reference.K1)
    batch = fmtorch.find_essential(np.stack([x0, x0]), np.stack([x1, x1]), K.expand(2, 3, 3), reference.K1)
    for other in (both, batch):
        assert torch.equal(other.R[:1], alone.R)
        assert other.focals.shape == (2, 2)
    as_lists = fmtorch.find_essential(x0, x1, [[500, 2, 310], [0, 520, 250], [0, 0, 1]], reference.K1)
    assert torch.equal(as_lists.R, alone.R)
