"""The road of a pair: few files from `find_fundamental` to the solver, and little else in the process."""

import re
from pathlib import Path

from scripts import house

PAGE = Path(house.ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
MAX_FILES, MAX_MODULES = 6, 92
ELSEWHERE = (
    "PIL", "cv2", "hydra", "kornia", "matplotlib", "omegaconf", "onnxruntime", "pyarrow", "scipy.sparse", "skimage"
)  # fmt: skip


def test_the_road_of_a_pair_is_the_files_that_the_page_names() -> None:
    paragraph = PAGE[PAGE.index("**The road of a pair**") :].split("\n\n")[0]
    road = [file.removeprefix("fmtorch/") for file in house.road()]
    assert road == re.findall(r"`([\w/]+\.py)`", paragraph)
    assert len(road) <= MAX_FILES


def test_a_process_that_estimates_loads_what_that_needs() -> None:
    modules = house.loaded()
    assert [name for name in ELSEWHERE if name in modules] == []
    assert len([name for name in modules if name.partition(".")[0] == "fmtorch"]) <= MAX_MODULES
