"""`find_*` within compiled models, on busy machines, and as an editor sees them."""

from __future__ import annotations

import subprocess
import sys
import typing

import cv2
import pytest
import torch
from torch import Tensor

import fmtorch
from fmtorch.two_view import estimation
from tests.laws import scene


def test_a_compiled_model_may_estimate() -> None:
    c = scene(0, 60)
    x1 = c.x1.clone().requires_grad_()

    def loss(x0: Tensor, x1: Tensor) -> Tensor:
        return fmtorch.find_fundamental(x0 * 1.0, x1 + 0.0).F.square().sum(-1).sum()

    expected = torch.autograd.grad(loss(c.x0, x1), x1)[0]
    compiled = torch.compile(loss, backend="eager")
    for _ in range(2):
        assert torch.equal(torch.autograd.grad(compiled(c.x0, x1), x1)[0], expected)


def test_the_compiler_is_not_imported_for_those_who_do_not_compile() -> None:
    program = "import sys, fmtorch; fmtorch.find_fundamental; assert 'torch._dynamo' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_a_list_of_pairs_computes_with_one_thread_of_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine threads of torch wait for one another; pairs have threads of their own."""
    seen = []
    estimated = estimation.estimated_by

    def spied(*arguments: object) -> fmtorch.Estimate:
        seen.append(torch.get_num_threads())
        return estimated(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(estimation, "estimated_by", spied)
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        c = scene(0, 60)
        fmtorch.find_fundamental([c.x0[0]] * 3, [c.x1[0]] * 3)
        assert torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(before)
    assert seen == [1]


def test_an_editor_knows_that_a_pose_is_there() -> None:
    kind = typing.get_type_hints(fmtorch.find_essential)["return"]
    assert kind is fmtorch.PoseEstimate
    assert all(type(None) not in typing.get_args(hint) for hint in map(typing.get_type_hints(kind).get, "ERt"))
    c, K = scene(0, 60), torch.tensor([[800.0, 0, 480], [0, 800, 320], [0, 0, 1]])
    estimate = fmtorch.find_essential(c.x0, c.x1, K, K)
    assert isinstance(estimate[0].to("cpu"), fmtorch.PoseEstimate)
    assert isinstance(fmtorch.find_essential([], [], K, K), fmtorch.PoseEstimate)


def test_keypoints_of_opencv_and_arrays_that_are_shared_are_points() -> None:
    class Shared:
        """An array of another library: DLPack alone."""

        def __init__(self, value: Tensor) -> None:
            self.value = value

        def __dlpack__(self, **options: object) -> object:
            return self.value.__dlpack__(**options)  # type: ignore[arg-type]

        def __dlpack_device__(self) -> object:
            return self.value.__dlpack_device__()

    c = scene(0, 60)
    ends = c.x0[0].float(), c.x1[0].float()
    expected = fmtorch.find_fundamental(*ends).F
    keypoints = [[cv2.KeyPoint(float(x), float(y), 3.0) for x, y in points] for points in ends]
    assert torch.equal(fmtorch.find_fundamental(*keypoints).F, expected)
    assert torch.equal(fmtorch.find_fundamental([keypoints[0]] * 2, [keypoints[1]] * 2).F[1:], expected)
    assert torch.equal(fmtorch.find_fundamental(*map(Shared, ends)).F, expected)
