"""The same bits on an older processor: code for one with AVX2 and FMA but without AVX-512, in kernels and libraries.

The other process compiles kernels for Haswell, which are kept beside those of this processor, and has torch, MKL and
NumPy take their code for AVX2. docs/concepts/conventions.md says what is promised."""

import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fmtorch import geometry
from fmtorch.estimators.models.focal_prior import normal_quantiles
from fmtorch.geometry.levenberg_marquardt import LOSS_TABLE
from fmtorch.jit import cache, kernel
from fmtorch.matching import nearest_neighbors
from fmtorch.metrics import nsgd
from tests.laws import degenerate, scene, scenes
from tests.variants import built

REPOSITORY = Path(__file__).resolve().parents[1]
ESTIMATORS = ("fmtorch", "irls:loss=cauchy", "irls", "msac", "usac")
PRUNERS = (
    "frame_consistency", "gms", "gms:soft=true", "lpm", "lpm:soft=true", "match_noise", "one_to_one",
    "position_consistency", "ratio_prior",
)  # fmt: skip
HASWELL = (
    "64bit", "avx", "avx2", "bmi", "bmi2", "cmov", "cx16", "cx8", "f16c", "fma", "fsgsbase", "fxsr", "invpcid", "lzcnt",
    "mmx", "movbe", "pclmul", "popcnt", "rdrnd", "sahf", "sse", "sse2", "sse3", "sse4.1", "sse4.2", "ssse3", "xsave",
    "xsaveopt",
)  # fmt: skip
"""What LLVM knows of that processor."""
CODE = """
import sys, numpy, torch
from fmtorch.jit import cache
from tests.test_processors import results
print(cache.folder())
given = torch.load(sys.argv[1] + "/given.pt", weights_only=False)
numpy.savez(sys.argv[1] + "/older.npz", **results(given))
"""


def inputs() -> dict[str, Any]:
    """Synthetic pairs, points, weights and descriptors, made by this process for both."""
    rng = np.random.default_rng(0)
    points, weight, size = rng.uniform(0, 600, (2, 5, 40, 2)), rng.random((5, 40)), torch.full((5, 2), 600.0)
    return {
        "pairs": {"scenes": scenes(), "wide": scene(21, 260, 0.7, 0.6), "plane": degenerate()["one plane"]},
        "many": scene(5, 2000),
        "geometry": (*torch.from_numpy(points), torch.from_numpy(weight), size),
        "descriptors": [torch.from_numpy(rng.normal(size=(n, 32)).astype(np.float32)) for n in (300, 400)],
    }


def results(given: dict[str, Any]) -> dict[str, np.ndarray]:
    tables = {"quantiles of focal lengths": normal_quantiles(), "table of MAGSAC++": LOSS_TABLE}
    arrays = {name: torch.from_numpy(table) for name, table in tables.items()}
    for what, c in given["pairs"].items():
        for name in ESTIMATORS:
            estimate = built("estimator", name)(c, 1)
            for field in ("F", "inliers", "ok", "samples", "significance"):
                arrays[f"{name} of {what}: {field}"] = getattr(estimate, field)
    for name in PRUNERS:
        c = built("pruner", name)(given["many"])
        arrays |= {f"{name}: {field}": getattr(c, field) for field in ("mask", "prior", "noise")}
    x0, x1, weight, size = given["geometry"]
    F, other = geometry.eight_point(x0, x1, weight)[0], geometry.eight_point(x0[:, :20], x1[:, :20])[0]
    arrays |= {
        "eight_point": F,
        "seven_point": geometry.seven_point(x0[:, :7], x1[:, :7])[0],
        "sampson": geometry.sampson(F, x0, x1),
        "nsgd": nsgd(F, other, size, size),
        "distances of descriptors": nearest_neighbors(*given["descriptors"]).distance,
    }
    return {name: value.numpy() for name, value in arrays.items() if value is not None}


def older_processor() -> dict[str, str]:
    """The environment of a process that runs as on a processor without AVX-512."""
    dispatched = np._core._multiarray_umath.__cpu_dispatch__
    newer = [name for name in dispatched if name.startswith("AVX512") or name == "X86_V4"]
    return {
        "NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ",".join(f"+{name}" for name in HASWELL),
        "ATEN_CPU_CAPABILITY": "avx2", "MKL_ENABLE_INSTRUCTIONS": "AVX2", "ONEDNN_MAX_CPU_ISA": "AVX2",
        "NPY_DISABLE_CPU_FEATURES": " ".join(newer),
    }  # fmt: skip


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="for x86-64")
def test_an_older_processor_computes_the_same_bits(tmp_path: Path) -> None:
    features = pytest.importorskip("llvmlite.binding").get_host_cpu_features()
    if kernel.off() or not all(features.get(name, False) for name in ("avx2", "fma", "bmi2")):
        pytest.skip("needs kernels, and a processor with AVX2 and FMA")
    given = inputs()
    torch.save(given, tmp_path / "given.pt")
    command, environment = [sys.executable, "-c", CODE, str(tmp_path)], {**os.environ, **older_processor()}
    run = subprocess.run(command, cwd=REPOSITORY, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    folder = Path(run.stdout.strip())
    assert folder != cache.folder(), "kernels of this processor were taken"
    assert any(folder.glob("*.bin"))
    with np.load(tmp_path / "older.npz") as older:
        for name, value in results(given).items():
            np.testing.assert_array_equal(older[name], value, err_msg=name)
