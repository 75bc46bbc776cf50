"""FMTORCH_KERNELS=off: estimators and pruners run as plain Python, for debugging, and find the same."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from fmtorch import presets
from fmtorch.jit.kernel import SWITCH
from tests.laws import few, scene
from tests.variants import built

PROGRAM = """
import sys
import numpy as np
from tests.estimators.test_interpreted import estimates
np.savez(sys.argv[1], **estimates())
"""


def estimates() -> dict[str, np.ndarray]:
    """F and inliers of a pair of few matches, and what pruners make of these."""
    c, arrays = scene(1, 40), {}
    for name in ("msac", "fmtorch"):
        estimate = presets.build("estimator", name, **few(presets.load("estimator", name), 40, 40))(c)
        assert bool(estimate.ok[0])
        arrays |= {f"{name}.F": estimate.F[0].numpy(), f"{name}.inliers": estimate.inliers[0].numpy()}
    for name in ("frame_consistency", "position_consistency", "gms", "gms:soft=true", "lpm", "lpm:soft=true"):
        pruned = built("pruner", name)(c)
        arrays |= {f"{name}.mask": pruned.mask.numpy(), f"{name}.prior": pruned.prior.numpy()}
    return arrays


def test_the_same_without_compiling(tmp_path: Path) -> None:
    file = tmp_path / "interpreted.npz"
    environment = os.environ | {SWITCH: "off"}
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(file)], env=environment, capture_output=True, text=True, check=False,
        cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert "compiling" not in ended.stderr
    with np.load(file) as interpreted:
        for name, value in estimates().items():
            # Fused products round differently in the last bits, which refinement to convergence does not carry on.
            np.testing.assert_allclose(interpreted[name], value, rtol=0, atol=1e-9, err_msg=name)
