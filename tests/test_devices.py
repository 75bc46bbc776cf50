"""On a CUDA device batched functions, pruners, priors and estimators give there what they give on the CPU."""

import pytest
import torch
from torch import Tensor

from fmtorch.matching import nearest_neighbors
from tests import laws
from tests.test_function_laws import FUNCTIONS, differentiated, pairs
from tests.test_laws import PLAIN

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
SINGLE = ("convmatch", "dfe", "lc", "oanet")  # networks, which compute in float32
ERRATIC = ("clnet", "ncmnet")  # untrained, whose neighbours by features change with the last bit, on the CPU as well


def assert_there(value: Tensor, expected: Tensor, what: str, near: float = 1e-6) -> None:
    assert value.is_cuda, f"{what} is not on the device"
    assert value.dtype == expected.dtype, what
    scale = float(expected.nan_to_num(posinf=0, neginf=0).abs().max()) if expected.is_floating_point() else 0.0
    limits = {"rtol": near, "atol": near * scale, "equal_nan": True}
    torch.testing.assert_close(value.cpu(), expected, **limits, msg=lambda text: f"{what}: {text}")


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_and_their_gradients(name: str) -> None:
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -3, 2], [3, 0, -1], [-2, 1, 0]]).double() / 2000)
    p = pairs()._replace(R=pairs().R @ turn, t=pairs().t @ turn)  # of no error at all there is no derivative
    expected, own = differentiated(name, p, slice(None))
    values, gradients = differentiated(name, p.map(Tensor.cuda), slice(None))
    for value, other in zip(values, expected, strict=True):
        assert_there(value, other, name)
    for field, gradient in own.items():
        assert_there(gradients[field], gradient, f"{name}, gradient by {field}")


def test_nearest_neighbours_where_products_of_floats_are_rounded_to_11_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    integers = torch.randint(0, 200, (2, 500, 128), generator=torch.Generator().manual_seed(0)).float()
    expected = nearest_neighbors(*integers)
    monkeypatch.setattr("torch.backends.cuda.matmul.allow_tf32", True)
    assert all(map(torch.equal, [value.cpu() for value in nearest_neighbors(*integers.cuda())], expected))


@pytest.mark.parametrize("subject", PLAIN, ids=[s.name for s in PLAIN])
def test_pruners_priors_and_estimators(subject: laws.Subject) -> None:
    c = laws.scenes()
    preset = subject.name.partition("=")[2]
    expected, values = subject.run(c), subject.run(c.to("cuda"))
    for name, value in values.items():
        if preset.startswith(ERRATIC):
            assert value.is_cuda
            assert value.dtype == expected[name].dtype
            assert bool(((value >= 0) & (value <= 1)).all())
        else:
            assert_there(value, expected[name], f"{subject.name}, {name}", 1e-3 if preset.startswith(SINGLE) else 1e-6)
