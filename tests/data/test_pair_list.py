"""Lists of pairs, and files of object arrays."""

import os
import pickle
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fmtorch.data import DataError, NpzArrays, load, read_image
from tests.data import lists
from tests.helpers import apart
from tests.reference.solvers import skew, unit

PAIRS = ((0, 1), (2, 3), (1, 5))


FORMS: dict[str, Callable[[Path], list[str]]] = {
    "superglue": lambda folder: ["# a comment", *(lists.superglue(*p) for p in PAIRS)],
    "glue_factory": lambda folder: [lists.glue_factory(*p) for p in PAIRS],
    "glue_factory_4x4": lambda folder: [lists.glue_factory(*p, True) for p in PAIRS],
    "loftr_several": lambda folder: [lists.loftr(folder / f"{i}.npz", [p]).name for i, p in enumerate(PAIRS)],
}


@pytest.mark.parametrize("form", [*FORMS, "loftr"])
def test_cameras_are_those_of_the_list(form: str, tmp_path: Path) -> None:
    file = tmp_path / ("list.npz" if form == "loftr" else "list.txt")
    written = lists.loftr(file, PAIRS) if form == "loftr" else lists.write(file, FORMS[form](tmp_path))
    dataset = load("pair_list", root=lists.images(), file=written)
    assert len(dataset) == len(PAIRS)
    for pair, (i, j) in zip(dataset, PAIRS, strict=True):
        K0, K1, T = lists.cameras()[i][0], lists.cameras()[j][0], lists.motion(lists.cameras()[i], lists.cameras()[j])
        assert pair.problem is None
        np.testing.assert_allclose(pair.K0, K0, atol=1e-9)
        np.testing.assert_allclose(pair.K1, K1, atol=1e-9)
        np.testing.assert_allclose(pair.R, T[:3, :3], atol=1e-6)  # the cameras' own rotations are rounded
        np.testing.assert_allclose(pair.t, T[:3, 3], atol=1e-9)
        assert apart(pair.F, unit(np.linalg.inv(K1).T @ skew(T[:3, 3]) @ T[:3, :3] @ np.linalg.inv(K0))) < 1e-6
        assert (pair.family, pair.scene) == ("list", "list")
        assert read_image(pair.image0).shape[:2] == cv2.imread(str(lists.images() / lists.name(i))).shape[:2]


@pytest.mark.parametrize("turns", [(1, 0), (2, 3)])
def test_f_relates_the_images_as_they_are_read(turns: tuple[int, int], tmp_path: Path) -> None:
    """Resized and turned: F is that of the originals seen through both maps, and is that of K, R and t."""
    file = lists.write(tmp_path / "list.txt", [lists.superglue(0, 1, turns)])
    (pair,) = load("pair_list", root=lists.images(), file=file, resize=400)
    shapes = [cv2.imread(str(lists.images() / lists.name(i))).shape[:2] for i in (0, 1)]
    for image, shape, turn in zip((pair.image0, pair.image1), shapes, turns, strict=True):
        pixels = read_image(image)
        assert (max(pixels.shape[:2]), image.size) == (400, shape)
        assert (pixels.shape[0] > pixels.shape[1]) == ((shape[0] > shape[1]) ^ (turn % 2 == 1))
    ends = zip((pair.image0, pair.image1), shapes, strict=True)
    A0, A1 = (image.resampling.matrix(shape) for image, shape in ends)
    (plain,) = load("pair_list", root=lists.images(), file=lists.write(tmp_path / "plain.txt", [lists.superglue(0, 1)]))
    assert apart(pair.F, unit(np.linalg.inv(A1).T @ plain.F @ np.linalg.inv(A0))) < 1e-9


def scannet(folder: Path, with_motion: bool, with_intrinsics: bool) -> tuple[Path, Path]:
    """ScanNet in LoFTR's layout, of two images of the shared scene: the images' folder and the list."""
    root, (a, b) = folder / "scans", lists.cameras()[:2]
    scene = root / "scene0707_00"
    for part in ("color", "pose", "intrinsic"):
        (scene / part).mkdir(parents=True)
    for frame, (i, (_, R, t)) in zip((15, 300), enumerate((a, b)), strict=True):
        image = cv2.imread(str(lists.images() / lists.name(i)))
        assert cv2.imwrite(str(scene / "color" / f"{frame}.jpg"), cv2.resize(image, (1296, 968)))
        world = np.linalg.inv(np.vstack([np.column_stack([R, t]), [0, 0, 0, 1]]))
        np.savetxt(scene / "pose" / f"{frame}.txt", world, fmt="%.17g")
    K = np.array([[1170, 0, 647.5], [0, 1170, 483.5], [0, 0, 1.0]])
    np.savetxt(scene / "intrinsic" / "intrinsic_color.txt", np.pad(K, (0, 1)), fmt="%.17g")
    arrays = {"name": np.array([[707, 0, 15, 300]], np.int32), "score": np.array([0.5])}
    if with_motion:
        arrays["rel_pose"] = lists.motion(a, b)[:3].reshape(1, 12)
    if with_intrinsics:
        np.savez(folder / "intrinsics.npz", scene0707_00=np.diag([577.0, 578.0, 1.0]) + np.eye(3, k=2) * 319.5)
    np.savez(folder / "test.npz", **arrays)  # type: ignore[arg-type]
    return root, folder / "test.npz"


@pytest.mark.parametrize("with_motion", [True, False])
def test_scannet_by_numbers(tmp_path: Path, with_motion: bool) -> None:
    root, file = scannet(tmp_path, with_motion, with_intrinsics=True)
    (pair,) = load("pair_list", root=root, file=file)
    T = lists.motion(*lists.cameras()[:2])
    np.testing.assert_allclose(pair.R, T[:3, :3], atol=1e-6)
    np.testing.assert_allclose(pair.t, T[:3, 3], atol=1e-6)
    assert read_image(pair.image0).shape[:2] == (480, 640)  # to which K belongs
    assert (pair.K0[0, 0], pair.scene) == (577, "test")
    (larger,) = load("pair_list", root=root, file=file, resize=[1280, 960])
    assert larger.K0[0, 0] == pytest.approx(2 * 577)
    np.savetxt(root / "scene0707_00/pose/15.txt", np.full((4, 4), -np.inf))  # one pair's problem, unless T is known
    (pair,) = load("pair_list", root=root, file=file)
    assert pair.problem == (None if with_motion else f"{file}, pair 0: the pose is not finite")


def test_scannet_by_the_scenes_own_calibration(tmp_path: Path) -> None:
    root, file = scannet(tmp_path, True, with_intrinsics=False)
    (stored,), (small,) = (load("pair_list", root=root, file=file, resize=size) for size in (None, [648, 484]))
    assert (read_image(stored.image0).shape[:2], stored.K0[0, 0]) == ((968, 1296), 1170)
    assert (small.K0[0, 0], small.K0[0, 2]) == (pytest.approx(585), pytest.approx(323.5))
    (root / "scene0707_00/intrinsic/intrinsic_color.txt").unlink()
    with pytest.raises(DataError, match=r"intrinsic_color\.txt: no such file, nor intrinsics\.npz beside the list"):
        load("pair_list", root=root, file=file)


def test_scenes_are_the_first_folder_that_differs(tmp_path: Path) -> None:
    names = ["Undistorted_SfM/0015/images/a.jpg", "Undistorted_SfM/0022/images/b.jpg"]
    line = lists.glue_factory(0, 1).split(" ", 2)[2]
    file = lists.write(tmp_path / "megadepth.txt", [f"{name} {name} {line}" for name in names])
    assert [pair.scene for pair in load("pair_list", root=tmp_path, file=file)] == ["0015", "0022"]
    flat = lists.write(tmp_path / "scannet.txt", [f"scene0711_00_frame-001680.jpg scene0711_00_frame-2.jpg {line}"])
    assert [pair.scene for pair in load("pair_list", root=tmp_path, file=flat)] == ["scene0711_00"]


def changed(line: str, at: int, word: str) -> str:
    words = line.split()
    return " ".join([*words[:at], word, *words[at + 1 :]])


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        (lambda: changed(lists.superglue(0, 1), 0, "absent.jpg"), r"list\.txt, line 2: no image .*absent\.jpg"),
        (lambda: changed(lists.superglue(0, 1), 8, "nan"), r"list\.txt, line 2: K is \[.*nan.*it must be finite"),
        (lambda: changed(lists.superglue(0, 1), 25, "inf"), r"list\.txt, line 2: the pose is not finite"),
        (lambda: changed(lists.superglue(0, 1), 22, "2"), r"list\.txt, line 2: the matrix is no rotation"),
        (lambda: lists.superglue(0, 0), r"list\.txt, line 2: t is zero"),
    ],
)
def test_one_bad_pair_has_a_problem(line: Callable[[], str], problem: str, tmp_path: Path) -> None:
    file = lists.write(tmp_path / "list.txt", [lists.superglue(0, 1), line(), lists.superglue(0, 1)])
    first, second, third = load("pair_list", root=lists.images(), file=file, resize=200)
    assert first.problem is None
    assert third.problem is None
    assert third.identity.startswith(f"{first.identity}#")
    assert re.search(problem, second.problem), second.problem


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("a.jpg b.jpg", r"list\.txt, line 2: 2 columns without cameras; it must have 38: name0 name1 turns0 turns1 K0"),
        ("a.jpg b.jpg 0 0", r"line 2: 4 columns without cameras"),
        ("a b " + "1 " * 31, r"line 2: 33 columns; it must have 38: .*; 32: .*; 36: "),
        ("a b " + "1 " * 29 + "x", r"line 2: could not convert string to float: 'x'"),
        ("a b 0 4 " + "1 " * 34, r"line 2: 4 quarter turns; it must be 0, 1, 2 or 3"),
        ("a b 0 x " + "1 " * 34, r"line 2: the number of quarter turns is 'x'"),
    ],
)
def test_lines_that_cannot_be_read_are_named(line: str, error: str, tmp_path: Path) -> None:
    file = lists.write(tmp_path / "list.txt", [lists.superglue(0, 1), line])
    with pytest.raises(DataError, match=error) as raised:
        load("pair_list", root=lists.images(), file=file)
    assert "\n" not in str(raised.value)


def test_lists_of_another_kind_are_refused(tmp_path: Path) -> None:
    root = lists.images()
    (tmp_path / "pairs.h5").write_text("x")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    np.savez(tmp_path / "wide.npz", name=np.zeros((3, 5), int))
    lists.write(tmp_path / "several.txt", ["absent.npz"])
    lists.write(tmp_path / "empty.txt", ["# nothing"])
    for name, error in {
        "pairs.h5": r"pairs\.h5: a list must be a text file \(\.txt\) or an \.npz; this one ends in \.h5",
        "other.npz": r"other\.npz: neither pair_infos \(MegaDepth\) nor name \(ScanNet\) among its arrays, x",
        "wide.npz": r"wide\.npz: 'name' is int64 \(3, 5\); it must hold four whole numbers a pair",
        "several.txt": r"several\.txt, line 1: no file .*absent\.npz",
        "empty.txt": r"empty\.txt: holds no pairs",
        "absent.txt": r"absent\.txt: no such file; dataset\.file must be the list of pairs",
    }.items():
        with pytest.raises(DataError, match=error):
            load("pair_list", root=root, file=tmp_path / name)
    with pytest.raises(DataError, match=r"pair_list needs file: dataset\.file=FILE"):
        load("pair_list", root=root, file=None)
    with pytest.raises(DataError, match=r"no such folder; dataset\.root must be the folder of the images"):
        load("pair_list", root=tmp_path / "absent", file=lists.write(tmp_path / "a.txt", [lists.superglue(0, 1)]))
    with pytest.raises(DataError, match=r"resize=\[1, 2, 3\]; it must be one length of the longer side, or"):
        load("pair_list", root=root, file=lists.write(tmp_path / "a.txt", [lists.superglue(0, 1)]), resize=[1, 2, 3])


def test_pairs_of_megadepth_that_do_not_fit_are_named(tmp_path: Path) -> None:
    file = lists.loftr(tmp_path / "a.npz", [(0, 99)])
    with pytest.raises(DataError, match=r"a\.npz, pair 0: images 1 and 100; there are 11"):
        load("pair_list", root=lists.images(), file=file)
    (pair,) = load("pair_list", root=lists.images(), file=lists.loftr(tmp_path / "b.npz", [(0, -1)]))
    assert pair.problem.startswith(f"{tmp_path / 'b.npz'}, pair 0: no image")


def objects() -> np.ndarray:
    """What LoFTR's files hold: matrices, texts, None, tuples of arrays and numbers of NumPy."""
    array = np.full(6, None, object)
    array[1], array[2] = np.arange(9, dtype=np.float32).reshape(3, 3), "Undistorted_SfM/0015/a.jpg"
    array[3] = (np.array([3, 7]), np.float64(0.25), np.asfortranarray(np.arange(6.0).reshape(2, 3)))
    array[4], array[5] = np.array(["ab", "c"]), [1, 2.5, np.array([None, 1], object)]
    return array


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return a.shape == b.shape and a.dtype == b.dtype and all(map(same, a.ravel().tolist(), b.ravel().tolist()))
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return bool(a == b)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_objects_are_those_that_numpy_loads(tmp_path: Path, protocol: int) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as file, file.open("x.npy", "w") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": (6,)})
        pickle.dump(objects(), stream, protocol)
    loaded = np.load(path, allow_pickle=True)["x"]
    assert same(NpzArrays(path)["x"], loaded)


def test_plain_arrays_are_those_that_numpy_loads(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    columns = np.asfortranarray(np.random.default_rng(0).random((3, 2)))
    arrays = {"a": np.arange(12).reshape(3, 4), "b": columns, "c": np.array(["x", "yz"])}
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
    read = NpzArrays(path)
    assert set(read.names) == set(arrays)
    assert "a" in read
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
    with pytest.raises(DataError, match=r"a\.npz: no array 'd'; it has a, b, c"):
        read["d"]


class _Command:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def test_a_pickle_that_runs_code_is_refused(tmp_path: Path) -> None:
    ran, path = tmp_path / "ran", tmp_path / "a.npz"
    np.savez(path, x=np.array([_Command(ran), None], object))
    said = r"a\.npz: 'x' holds objects that are not read here \(.*mkdir\).*allow_pickle"
    with pytest.raises(DataError, match=said) as error:
        NpzArrays(path)["x"]
    assert not ran.exists()
    assert "\n" not in str(error.value)
    np.load(path, allow_pickle=True)["x"]
    assert ran.exists()  # the file does run code where it is trusted


class _Pointers:
    """An array of objects given by the bytes of their addresses, of a dtype whose flags deny that it holds objects."""

    def __reduce__(self) -> tuple[Any, ...]:
        reconstruct, arguments, _ = np.zeros(1).__reduce__()  # type: ignore[misc]
        return reconstruct, arguments, (1, (1,), _Objects(), False, b"A" * 8)


class _Objects:
    def __reduce__(self) -> tuple[Any, ...]:
        return np.dtype, ("O8", False, True), (3, "|", None, None, None, -1, -1, 0)


def test_addresses_of_objects_are_refused(tmp_path: Path) -> None:
    """NumPy's own functions, all of them names that arrays need, take the bytes for addresses: the process crashes."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as file, file.open("x.npy", "w") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": (1,)})
        pickle.dump(_Pointers(), stream)
    with pytest.raises(DataError, match=r"a\.npz: 'x' cannot be read"):
        NpzArrays(path)["x"]


@pytest.mark.parametrize("damage", [slice(0, 60), slice(0, -40)])
def test_damaged_files_say_so(tmp_path: Path, damage: slice) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, x=objects())
    path.write_bytes(path.read_bytes()[damage])
    with pytest.raises(DataError, match=r"a\.npz: "):
        NpzArrays(path)["x"]
