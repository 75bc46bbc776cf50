"""Learned files: others' checkpoints converted, refusals."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from fmtorch.core import Correspondences
from fmtorch.pruning import LC, LearnedPruner
from scripts.make_models import ngransac_state
from tests.conftest import oracle, shared_path

SCRIPT = Path(__file__).resolve().parents[3] / "scripts" / "make_models.py"


def convert(checkpoint: Path, out: Path) -> None:
    """Run the script. Raises SystemExit where that fails."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(SCRIPT), "ngransac", str(checkpoint), str(out)])
        runpy.run_path(str(SCRIPT), run_name="__main__")


def test_a_checkpoint_of_neural_guided_ransac_becomes_a_pruner(tmp_path: Path) -> None:
    """As the authors' .net and as .npz: the same file, whose P(inlier) gives the authors' sampling probabilities."""
    weights = oracle("weights_ngransac_F_r1.00.npz")
    net = tmp_path / "weights.net"
    torch.save({key: torch.from_numpy(value) for key, value in weights.items()}, net)
    for source in (net, shared_path("oracles/weights_ngransac_F_r1.00.npz")):
        convert(source, tmp_path / f"{source.suffix[1:]}.safetensors")
    assert (tmp_path / "net.safetensors").read_bytes() == (tmp_path / "npz.safetensors").read_bytes()
    data = oracle("ngransac_net.npz")
    x0, x1, ratio, size0, size1 = (
        torch.from_numpy(data[f"001.{name}"])[None] for name in ("X1", "X2", "ratio", "size1", "size2")
    )
    mask = torch.ones(x0.shape[:2], dtype=torch.bool)
    c = Correspondences(x0, x1, mask, ratio=ratio.double(), size0=size0, size1=size1)
    p = LearnedPruner(LC(side=["ratio"]), file=tmp_path / "net.safetensors").probability(c)[0].double()
    expected = data["001.logprob_F_r1.00"].astype(np.float64)
    computed = (p / p.sum()).log().numpy()
    np.testing.assert_allclose(computed, expected, rtol=0, atol=4e-4)  # of both float32 against float64: 2e-4 each


def test_what_is_no_such_checkpoint_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"conv1\.weight is no parameter of a network of neural-guided RANSAC"):
        ngransac_state({"conv1.weight": torch.zeros(3)})
    torch.save({"conv1.weight": torch.zeros(3)}, tmp_path / "other.net")
    with pytest.raises(SystemExit, match=r"error: .*conv1\.weight is no parameter"):
        convert(tmp_path / "other.net", tmp_path / "out.safetensors")
    assert not (tmp_path / "out.safetensors").exists()
