"""Images of 8192 x 8192 pixels, in a process of its own for its peak of memory."""

import subprocess
import sys
from pathlib import Path

import pytest

GROWTH = """
import sys, time
import cv2, numpy as np, torch
from fmtorch import presets

def peak():  # not ru_maxrss, which a process inherits from the one that started it
    return 1024 * int(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))

torch.set_num_threads(1)
name, options = sys.argv[1], {"max_features": 500}
extract = presets.build("features", name, **options)
noise = np.random.default_rng(0).integers(0, 256, (512, 512)).astype(np.uint8)
extract(noise)  # what is read and made on first use is not counted
image = cv2.resize(noise, (8192, 8192), interpolation=cv2.INTER_CUBIC)
before = peak()
found = extract(image)
assert len(found) == 500, len(found)
assert found.image_size.tolist() == [8192, 8192]
assert bool(torch.isfinite(found.lafs).all())
x = found.lafs[:, :, 2]
assert float(x.max()) > 6000  # keypoints all over the image, in its own pixels
print(peak() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
@pytest.mark.parametrize(("name", "bound"), [("sift", 4.0e9), pytest.param("hesaffnet", 2.5e9, marks=pytest.mark.slow)])
def test_8k_images_within_the_stated_memory(name: str, bound: float) -> None:
    """As docs/benchmarks/features.md states: SIFT sees at most 16 million pixels, the Hessian all 67 million."""
    result = subprocess.run([sys.executable, "-c", GROWTH, name], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) < bound, f"{int(result.stdout) / 1e9:.2f} GB"
