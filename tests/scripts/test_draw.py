"""The pictures of docs/gallery.md are drawn, here of smaller scenes, and the page shows those that there are."""

import re
from pathlib import Path

import pytest

from fmtorch.data import read_image
from fmtorch.data.pairs import ImageSource
from fmtorch.scenes import Plan
from fmtorch.scenes import dataset as rendered_dataset
from scripts import draw
from tests.conftest import own_cache

PAGE = Path(__file__).resolve().parents[2] / "docs" / "gallery.md"
SMALL = Plan(scenes=2, shots=4, pairs=2, scale=0.5)


@pytest.mark.slow
def test_the_pictures_are_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FMTORCH_CACHE", str(own_cache(tmp_path)))
    monkeypatch.setattr(rendered_dataset, "PLANS", {("small", "test"): SMALL})
    draw.main(["gallery", "--output", str(tmp_path / "gallery")])
    shown = re.findall(r"\(gallery/(\w+\.jpg)\)", PAGE.read_text(encoding="utf-8"))
    assert sorted(shown) == sorted(path.name for path in (tmp_path / "gallery").iterdir())
    for name in shown:
        image = read_image(ImageSource(name, tmp_path / "gallery" / name))
        assert image.shape[1] == draw.GALLERY_WIDTH
        assert image.std() > 10
    assert "matches; NSGD" in capsys.readouterr().out
