"""Arrays of pickled objects, read without running what the pickle names."""

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmtorch.data import DataError
from fmtorch.data.files import NpzArrays


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
    arrays = {
        "a": np.arange(12).reshape(3, 4),
        "b": np.asfortranarray(np.random.default_rng(0).random((3, 2))),
        "c": np.array(["x", "yz"]),
    }
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
    with pytest.raises(
        DataError, match=r"a\.npz: 'x' holds objects that are not read here \(.*mkdir\).*allow_pickle"
    ) as error:
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
