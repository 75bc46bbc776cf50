"""Pairs of reconstructions: COLMAP models and Bundler files."""

import contextlib
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from fmtorch.data import DataError, DepthDataset, ImageError, load, read_image, read_model
from tests.conftest import shared_path
from tests.data.native import SIZE, to_binary, write_bundler, write_colmap, write_image
from tests.helpers import apart


def test_real_images_have_the_f_and_the_pixels_of_the_fmbench_file() -> None:
    """The FM-Bench copy was undistorted from the same originals; it is JPEG, hence grey levels differ by its loss."""
    native = {p.identity.rpartition("/")[2]: p for p in load("colmap", root=_real(), pairs=None)}
    copy = load("fmbench", root=shared_path("data/PhotoTourism"))
    assert (len(native), len(copy)) == (45, 34)
    for pair in copy:
        assert apart(native[pair.identity.rpartition("/")[2]].F, pair.F) < 1e-6
    source, theirs = native["6-8"].image1, read_image(copy[29].image1).astype(int)
    assert copy[29].identity.endswith("/6-8")
    assert np.abs(read_image(source) - theirs).mean() < 2
    assert np.abs(read_image(dataclasses.replace(source, lens=None)) - theirs).mean() > 4


def test_real_model_is_that_of_pycolmap(tmp_path: Path) -> None:
    """Text as it stands, and the binary files that COLMAP itself writes of it."""
    pycolmap = pytest.importorskip("pycolmap")
    reconstruction = pycolmap.Reconstruction(str(_real() / "sparse"))
    reconstruction.write_binary(str(tmp_path))
    text, binary = read_model(_real() / "sparse"), read_model(tmp_path)
    assert text.cameras == binary.cameras
    theirs = {image.name: image for image in reconstruction.images.values()}
    for a, b in zip(text.images, binary.images, strict=True):
        matrix = theirs[a.name].cam_from_world().matrix()
        seen = [point.point3D_id for point in theirs[a.name].points2D if point.has_point3D()]
        for image in (a, b):
            np.testing.assert_allclose(np.column_stack([image.R, image.t]), matrix, atol=1e-12)
            assert image.points.tolist() == seen


def _real() -> Path:
    return shared_path("data/native/colmap_sacre_coeur")


def test_candidates_share_points(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "scene", ("PINHOLE",) * 5)
    assert len(load("colmap", root=folder, pairs=None)) == 10
    dataset = load("colmap", root=folder, pairs=None, candidates="points", shared=3)
    numbers = [int(view.image.path.stem) for view in dataset.scenes[0].views]
    seen = {frozenset((numbers[i], numbers[j])) for i, j in dataset.scenes[0].candidates.at(np.arange(len(dataset)))}
    assert seen == {frozenset((i, j)) for i in range(5) for j in range(i) if i - j <= 2}  # share 5 - |i - j| points


def test_pairs_of_different_sizes_and_undistorted_images(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "set/scene")
    pair = next(p for p in load("colmap", root=tmp_path / "set", sequences=["scene"]) if p.image1.path.stem == "02")
    assert (pair.family, pair.scene, pair.problem) == ("set", "scene", None)
    assert pair.image0.lens is None
    assert pair.image1.lens is not None
    photographed = read_image(pair.image1.path)
    assert not np.array_equal(read_image(pair.image1), photographed)
    assert np.array_equal(read_image(dataclasses.replace(pair.image1, as_photographed=True)), photographed)
    write_image(folder / "images/02.png", size=(48, 64))
    with pytest.raises(ImageError, match=r"02\.png: 64 x 48 px, but its camera is of 32 x 24 px; it must be the image"):
        read_image(pair.image1)


def test_the_model_is_looked_for_where_colmap_puts_it(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "set/scene")
    first = load("colmap", root=folder, pairs=None)
    (folder / "sparse/0").rename(tmp_path / "model")
    (folder / "sparse").rmdir()
    (tmp_path / "model").rename(folder / "sparse")
    assert load("colmap", root=folder, pairs=None)[0].identity == first[0].identity
    (folder / "sparse").rename(folder / "other")
    with pytest.raises(DataError, match="scene: no COLMAP model in sparse/0, sparse, dense/sparse,"):
        load("colmap", root=tmp_path / "set", sequences=["scene"])
    assert len(load("colmap", root=tmp_path / "set", sequences=["scene"], model="other", pairs=None)) == 3
    with pytest.raises(DataError, match=r"no sequence 'Panther'; there are: scene\."):
        load("colmap", root=tmp_path / "set")


def test_binary_files_cut_anywhere_are_refused(tmp_path: Path) -> None:
    sparse = write_colmap(tmp_path / "scene") / "sparse/0"
    to_binary(sparse)
    for name, record in (("cameras.bin", "camera 3 of 3"), ("images.bin", "image 3 of 3")):
        intact = (sparse / name).read_bytes()
        for length in {0, 5, 8, 20, *range(30, len(intact), 31), len(intact) - 1}:
            (sparse / name).write_bytes(intact[:length])
            with pytest.raises(DataError, match=rf"{name}: damaged or truncated, its {length} bytes end within"):
                read_model(sparse)
        (sparse / name).write_bytes(intact + b"\0" * 3)
        with pytest.raises(DataError, match=f"damaged, 3 bytes are left after {record}; copy it again"):
            read_model(sparse)
        (sparse / name).write_bytes(intact)


def test_damaged_bytes_never_make_a_traceback(tmp_path: Path) -> None:
    sparse = write_colmap(tmp_path / "scene") / "sparse/0"
    to_binary(sparse)
    rng = np.random.default_rng(0)
    for number in range(40):
        path = sparse / ("cameras.bin" if number % 2 else "images.bin")
        intact = path.read_bytes()
        data = bytearray(intact)
        data[rng.integers(len(data))], data[rng.integers(len(data))] = rng.integers(0, 256, 2).tolist()
        path.write_bytes(data)
        with contextlib.suppress(DataError):
            assert all(np.isfinite(image.t).all() for image in read_model(sparse).images)
        path.write_bytes(intact)


def _write_depth(path: Path, depth: np.ndarray) -> None:
    """As the scripts of COLMAP write it: columns, rows and channels, the first varying fastest."""
    path.parent.mkdir(parents=True, exist_ok=True)
    h, w = depth.shape
    path.write_bytes(f"{w}&{h}&1&".encode() + depth.T.astype("<f4").tobytes(order="F"))


def test_depth_is_that_of_the_dense_reconstruction(tmp_path: Path) -> None:
    """Maps of half the size: their pixel (2, 1) covers the photograph's (4, 2) to (5, 3)."""
    maps = write_colmap(tmp_path / "scene", ("PINHOLE",) * 3) / "stereo" / "depth_maps"
    h, w = SIZE[0] // 2, SIZE[1] // 2
    depth = np.arange(h * w, dtype=float).reshape(h, w) + 0.5
    depth[0, 0], depth[0, 1] = 0, -1
    _write_depth(maps / "00.png.geometric.bin", depth)
    _write_depth(maps / "00.png.photometric.bin", depth + 1000)
    _write_depth(maps / "night walk" / "01.png.photometric.bin", np.ones(SIZE))
    dataset = load("colmap", root=tmp_path, sequences=["scene"], pairs=None)
    assert isinstance(dataset, DepthDataset)
    by_path = {image.path.name: image for pair in dataset for image in (pair.image0, pair.image1)}
    points = np.array([[4.0, 2.0], [5.4, 3.4], [5.6, 2.0], [0.0, 0.0], [3.0, 1.0], [-1.0, 5.0], [np.nan, 1.0]])
    sampled = dataset.depth(by_path["00.png"], points)
    np.testing.assert_array_equal(sampled, [depth[1, 2], depth[1, 2], depth[1, 3], *[np.nan] * 4])
    assert (dataset.depth(by_path["01.png"], points[:2]) == 1).all()
    assert np.isnan(dataset.depth(by_path["02.png"], points)).all()  # it has no map
    assert not isinstance(load("colmap", root=tmp_path, sequences=["scene"], depth=False), DepthDataset)
    write_colmap(tmp_path / "other")
    assert not isinstance(load("colmap", root=tmp_path, sequences=["scene", "other"]), DepthDataset)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"P5 16 12", "must be a depth map of COLMAP"),
        (b"16&12&3&" + bytes(12 * 16 * 12), "must be a depth map of COLMAP"),
        (b"16&12&1&" + bytes(4 * 16 * 11), "704 bytes of depth; 16 x 12 px have 768: is it truncated"),
        (b"16&16&1&" + bytes(4 * 16 * 16), r"\(16, 16\) px; its photograph has \(24, 32\)"),
        (b"64&48&1&" + bytes(4 * 64 * 48), r"\(48, 64\) px; its photograph has \(24, 32\)"),
    ],
)
def test_damaged_depth_is_named(content: bytes, message: str, tmp_path: Path) -> None:
    maps = write_colmap(tmp_path / "scene") / "stereo" / "depth_maps"
    maps.mkdir(parents=True)
    (maps / "00.png.geometric.bin").write_bytes(content)
    dataset = load("colmap", root=tmp_path, sequences=["scene"], pairs=None)
    image = next(image for pair in dataset for image in (pair.image0, pair.image1) if image.path.name == "00.png")
    with pytest.raises(ImageError, match=rf"00\.png\.geometric\.bin: .*{message}"):
        dataset.depth(image, np.zeros((1, 2)))


def manuals_pixels(camera: dict[str, np.ndarray], h: int, w: int, distorted: bool) -> np.ndarray:
    """``P = R X + t, p = -P / P.z, p' = f r(p) p`` about the image's middle, y up; as pixels with y down."""
    P = camera["points"] @ camera["R"].T + camera["t"]
    p = -P[:, :2] / P[:, 2:]
    r2 = (p**2).sum(1, keepdims=True)
    factor = 1 + camera["k"][0] * r2 + camera["k"][1] * r2**2 if distorted else 1.0
    return camera["f"] * factor * p * [1, -1] + [(w - 1) / 2, (h - 1) / 2]


def test_points_are_where_the_manual_puts_them(tmp_path: Path) -> None:
    folder, truth = write_bundler(tmp_path / "Set/scene")
    views = load("bundler", root=folder, pairs=None).scenes[0].views  # type: ignore[attr-defined]
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
        seen = view.image.lens.distort(ideal)
        np.testing.assert_allclose(seen, manuals_pixels(camera, h, w, distorted=True), atol=1e-9)
    assert views[3].image.size == (SIZE[0] + 8, SIZE[1])


def test_a_missing_or_damaged_image_spoils_its_pairs_alone(tmp_path: Path) -> None:
    folder, _ = write_bundler(tmp_path / "scene")
    (folder / "images/1.png").unlink()
    (folder / "images/2.png").write_text("no image")
    pairs = {p.identity.rpartition("/")[2]: p for p in load("bundler", root=folder, pairs=None)}
    assert "gt_bundle.out, line 8: no image" in str(pairs["0-1"].problem)
    assert pairs["0-3"].problem is None
    with pytest.raises(ImageError, match=r"2\.png: no image that can be decoded"):
        read_image(pairs["0-2"].image1)
