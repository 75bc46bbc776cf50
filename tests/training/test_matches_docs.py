"""The training loop of the documentation runs as it stands."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest
import torch

from fmtorch.scenes import RenderedPairs
from fmtorch.scenes import dataset as rendered_dataset
from tests.training.conftest import FAMILY, TINY

PAGE = Path(__file__).resolve().parents[2] / "docs" / "guides" / "training.md"


@pytest.mark.skipif(not PAGE.is_file(), reason="the documentation is in a checkout only")
def test_the_training_loop_of_the_page_runs(
    rendered: RenderedPairs, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = PAGE.read_text(encoding="utf-8").split("## Labelled matches")[1]
    code = re.search(r"```python\n(.*?)```", section, re.DOTALL)[1]
    loop = code.partition("\n\n")[2].strip().splitlines()
    assert len(loop) == 15
    assert 'load("rendered", split="train")' in code
    monkeypatch.setenv("FMTORCH_CACHE", str(cache))
    monkeypatch.setattr(rendered_dataset, "PLANS", {("small", "train"): TINY})  # what `rendered` has drawn
    monkeypatch.setattr(rendered_dataset, "FAMILIES", {FAMILY: None})
    (tmp_path / "loop.py").write_text(code)
    torch.manual_seed(0)
    names = runpy.run_path(str(tmp_path / "loop.py"))
    assert torch.isfinite(names["loss"])
    assert len(names["matches"]) == len(rendered)
    assert any((cache / "matched").iterdir())
    first = next(iter(names["loader"]))
    assert first.label.shape == first.correspondences.mask.shape
