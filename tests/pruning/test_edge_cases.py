"""Every pruner preset on input from the edges: sound results, no exception, bounded memory."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from fmtorch.core import Correspondences
from tests.laws import calibrated, quick_pruner, scene
from tests.variants import built, variants

PRUNERS = variants("pruner")
PER_MATCH = ("x0", "x1", "ratio", "prior", "lafs0", "lafs1", "mutual")
H, W = 640, 960


def edge_cases() -> dict[str, Correspondences]:
    c, single = scene(0, 300), scene(0, 1)
    right, bottom = float(W - 1), float(H - 1)
    inside = [[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]]
    border = torch.tensor([*inside, [right + 1, bottom + 1], [-0.5, -0.5], [right + 50, 7.0], [3.0, -90.0]])
    on_border = border.repeat(40, 1)[:300][None]
    one_cell = c.x0 / 100 + 200
    return {
        "no slots": single.replace(**{f: getattr(single, f)[:, :0] for f in ("mask", *PER_MATCH)}),
        "one cell": c.replace(x0=one_cell, x1=one_cell + 5),
        "on and outside the border": c.replace(x0=on_border, x1=on_border.flip(1)),
    }  # fmt: skip


@pytest.mark.parametrize("name", PRUNERS)
@pytest.mark.parametrize("case", edge_cases())
def test_edge_case(name: str, case: str) -> None:
    c = edge_cases()[case]
    pruned = quick_pruner(name)(calibrated(c))
    assert pruned.mask.shape == c.mask.shape
    assert not (pruned.mask & ~c.mask).any()
    if pruned.prior is not None and pruned.prior is not c.prior:
        assert ((pruned.prior >= 0) & (pruned.prior <= 1)).all()
        assert not pruned.prior[~c.mask].any()


@pytest.mark.parametrize("name", ["gms", "lpm", "gms:soft=true", "lpm:soft=true", "position_consistency"])
def test_matches_that_all_move_alike_in_one_cell_are_kept(name: str) -> None:
    c = edge_cases()["one cell"].replace(ratio=None, lafs0=None, lafs1=None, prior=None)
    pruned = built("pruner", name)(c)
    assert pruned.mask.all()
    if name not in ("gms", "lpm"):
        assert pruned.prior.min() > 0.5


MOST = [name for name in PRUNERS if name != "code"]  # its soft form does the same work
MANY = """
import sys, torch
from tests.laws import calibrated, quick_pruner, scene
torch.set_num_threads(1)
many = calibrated(scene(1, 50_000))
for name in sys.argv[1:]:
    stage = quick_pruner(name)
    framed = {} if name == "frame_consistency" else {"lafs0": None, "lafs1": None}  # the scene's frames are random
    pruned = stage(many.replace(**framed))
    assert 0 < int(pruned.mask.sum()) <= 50_000, name
    assert pruned.prior is None or bool(torch.isfinite(pruned.prior).all()), name
    # Not ru_maxrss, which a process inherits from the one that started it.
    print(name, next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
def test_many_matches_in_bounded_memory() -> None:
    """50,000 matches: a table of pairs of matches would take 2.5 GB even at a byte each."""
    result = subprocess.run([sys.executable, "-c", MANY, *MOST], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    peaks = {line.split()[0]: int(line.split()[1]) * 1024 for line in result.stdout.splitlines()}
    assert list(peaks) == MOST
    assert max(peaks.values()) < 1.5e9, peaks
