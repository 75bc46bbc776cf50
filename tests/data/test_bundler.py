"""The reader of Bundler files, on one written from the manual, and on damaged ones."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fmtorch.data import DataError, ImageError, load, read_image
from tests.data.native import SIZE, write_bundler


def manuals_pixels(camera: dict[str, np.ndarray], h: int, w: int, distorted: bool) -> np.ndarray:
    """``P = R X + t, p = -P / P.z, p' = f r(p) p`` about the image's middle, y up; as pixels with y down."""
    P = camera["points"] @ camera["R"].T + camera["t"]
    p = -P[:, :2] / P[:, 2:]
    r2 = (p**2).sum(1, keepdims=True)
    factor = 1 + camera["k"][0] * r2 + camera["k"][1] * r2**2 if distorted else 1.0
    return camera["f"] * factor * p * [1, -1] + [(w - 1) / 2, (h - 1) / 2]


def test_points_are_where_the_manual_puts_them(tmp_path: Path) -> None:
    folder, truth = write_bundler(tmp_path / "Set/scene")
    dataset = load("bundler", root=folder, pairs=None)
    views = dataset.scenes[0].views  # type: ignore[attr-defined]
    assert [view.image.path.name for view in views] == ["0.png", "1.png", "2.png", "4.png"]  # 3 was not registered
    for view, camera in zip(views, [truth[i] for i in (0, 1, 2, 4)], strict=True):
        h, w = view.image.size
        assert read_image(view.image).shape == (h, w)
        X = camera["points"] @ view.R.T + view.t
        assert (X[:, 2] > 0).all()
        assert np.linalg.det(view.R) == pytest.approx(1)
        ideal = X @ view.K.T
        ideal = ideal[:, :2] / ideal[:, 2:]
        np.testing.assert_allclose(ideal, manuals_pixels(camera, h, w, distorted=False), atol=1e-9)
        np.testing.assert_allclose(
            view.image.lens.distort(ideal), manuals_pixels(camera, h, w, distorted=True), atol=1e-9
        )
    assert views[3].image.size == (SIZE[0] + 8, SIZE[1])


def edit(line: int, change: Callable[[str], str]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        lines = (folder / "gt_bundle.out").read_text().splitlines()
        lines[line - 1] = change(lines[line - 1])
        (folder / "gt_bundle.out").write_text("\n".join(lines) + "\n")

    return apply


def cut(folder: Path) -> None:
    text = (folder / "gt_bundle.out").read_text().splitlines()
    (folder / "gt_bundle.out").write_text("\n".join(text[:40]) + "\n")


DAMAGE = {
    "version": (edit(1, lambda _: "# Bundle file v0.2"), r"gt_bundle\.out, line 1: '# Bundle file v0\.2'; it must be"),
    "counts": (edit(2, lambda _: "5"), r"line 2: 1 columns; it must hold the numbers of cameras and of points"),
    "cameras": (edit(2, lambda _: "4 12"), r"line 2: 4 cameras and .*list\.txt has 5 images; both must agree"),
    "no number": (edit(2, lambda _: "5 many"), r"line 2: the number of points is 'many'; it must be a whole number"),
    "cut": (cut, r"gt_bundle\.out ends at line 40; 5 cameras and 12 points need 63: truncated\?"),
    "focal": (edit(3, lambda s: "-" + s), r"line 3: focal length -40; it must be positive"),
    "rotation": (edit(5, lambda _: "0 2 0"), r"line 3: the matrix is no rotation"),
    "nan": (edit(7, lambda _: "nan 0 0"), r"line 7: a number that is not finite; it must hold t"),
    "columns": (edit(8, lambda s: s.split()[0]), r"line 8: 1 columns; it must have 3: f k1 k2"),
    "view list": (edit(30, lambda s: s + " 7"), r"line 30: 6 columns; it must hold n and n times camera key x y"),
    "no view list": (edit(30, lambda _: ""), r"line 30: 0 columns; it must hold n and n times"),
    "no file": (lambda f: (f / "gt_bundle.out").unlink(), r"scene: no Bundler file; it must hold one of"),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_named_with_their_lines(damage: str, tmp_path: Path) -> None:
    folder, _ = write_bundler(tmp_path / "scene")
    change, message = DAMAGE[damage]
    change(folder)
    with pytest.raises(DataError, match=message) as raised:
        load("bundler", root=folder, candidates="points")
    assert "\n" not in str(raised.value)


def test_a_missing_or_damaged_image_spoils_its_pairs_alone(tmp_path: Path) -> None:
    folder, _ = write_bundler(tmp_path / "scene")
    (folder / "images/1.png").unlink()
    (folder / "images/2.png").write_text("no image")
    pairs = {p.identity.rpartition("/")[2]: p for p in load("bundler", root=folder, pairs=None)}
    assert "gt_bundle.out, line 8: no image" in str(pairs["0-1"].problem)
    assert pairs["0-3"].problem is None
    with pytest.raises(ImageError, match=r"2\.png: no image that can be decoded"):
        read_image(pairs["0-2"].image1)


def test_nothing_registered_is_told(tmp_path: Path) -> None:
    folder, _ = write_bundler(tmp_path / "scene")
    for camera in range(5):
        edit(3 + 5 * camera, lambda _: "0 0 0")(folder)
    with pytest.raises(DataError, match="no camera has a focal length; none was registered"):
        load("bundler", root=folder)
