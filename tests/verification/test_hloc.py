"""hloc's files verified: inliers of the public function, whatever happens on the way."""

import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

import fmtorch
from fmtorch.core import pair_key
from tests.verification.databases import SIZE, Scene, killed_and_continued, matches, scene

K = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
FILES = ("features=features.h5", "matches=matches.h5", "output=verified.h5")


def write(folder: Path, cameras: Scene) -> list[tuple[str, str]]:
    """Features and matches of all pairs of a scene, as hloc writes them; the names of the pairs."""
    rng = np.random.default_rng(1)
    names = [f"mapping/{i:03d}.jpg" for i in range(len(cameras.R))]
    with h5py.File(folder / "features.h5", "w") as file:
        for name, R, t in zip(names, cameras.R, cameras.t, strict=True):
            X = (cameras.X @ R.T + t) @ K.T
            file[f"{name}/keypoints"] = X[:, :2] / X[:, 2:] + rng.normal(0, 0.3, (len(X), 2))
            file[f"{name}/image_size"] = np.array(SIZE[::-1])
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    with h5py.File(folder / "matches.h5", "w") as file:
        for a, b in pairs:
            group = file.create_group(f"{a.replace('/', '-')}/{b.replace('/', '-')}")
            second = matches(len(cameras.X), rng)[:, 1].astype(np.int16)
            second[3] = -1
            group["matches0"], group["matching_scores0"] = second, np.full(len(second), 0.5, np.float16)
    return pairs


def contents(path: Path) -> dict[str, object]:
    """All arrays and attributes of a file."""
    entries: dict[str, object] = {}

    def visit(name: str, entry: h5py.HLObject) -> None:
        entries[name] = {key: np.asarray(value).tolist() for key, value in entry.attrs.items()}
        if isinstance(entry, h5py.Dataset):
            entries[name] = entry[()].tolist()

    with h5py.File(path) as file:
        file.visititems(visit)
    return entries


def test_inliers_and_matrices_are_those_of_find_fundamental(tmp_path: Path) -> None:
    pairs = write(tmp_path, scene(4))
    features, stored, output = (tmp_path / f"{name}.h5" for name in ("features", "matches", "verified"))
    result = fmtorch.verify(features=features, matches=stored, output=output)
    assert (result.path, result.pairs, result.configurations) == (output, 6, {"uncalibrated": 6})
    with h5py.File(features) as f, h5py.File(stored) as m, h5py.File(output) as v:
        for a, b in pairs:
            key = f"{a.replace('/', '-')}/{b.replace('/', '-')}"
            second = m[key]["matches0"][:].astype(int)
            first = np.flatnonzero(second >= 0)
            x0 = f[a]["keypoints"][:].astype(np.float32)[first]
            x1 = f[b]["keypoints"][:].astype(np.float32)[second[first]]
            estimate = fmtorch.find_fundamental(
                x0, x1, focal="unknown", size0=SIZE, size1=SIZE, key=pair_key(f"{a} {b}")
            )
            expected = np.full(len(second), -1)
            good = first[estimate.inliers[0].numpy()]
            expected[good] = second[good]
            np.testing.assert_array_equal(v[key]["matches0"][:], expected)
            np.testing.assert_array_equal(v[key].attrs["F"], estimate.F[0].double())
            np.testing.assert_array_equal(v[key].attrs["R"], estimate.R[0])
            np.testing.assert_array_equal(v[key]["matching_scores0"][:], np.where(expected < 0, 0, 0.5))
    assert sorted(os.listdir(tmp_path)) == ["features.h5", "matches.h5", "verified.h5"]


def test_keys_of_an_older_hloc_are_read(tmp_path: Path) -> None:
    """Names joined by _, which they may hold themselves."""
    write(tmp_path, scene(2))
    with h5py.File(tmp_path / "features.h5", "a") as file:
        file.move("mapping/000.jpg", "map_1/000_a.jpg")
    with h5py.File(tmp_path / "matches.h5", "a") as file:
        file.move("mapping-000.jpg/mapping-001.jpg", "map_1-000_a.jpg_mapping-001.jpg")
    paths = {f"{name}": tmp_path / f"{name}.h5" for name in ("features", "matches")}
    result = fmtorch.verify(**paths, output=tmp_path / "verified.h5")
    assert (result.configurations, result.problems) == ({"uncalibrated": 1}, ())
    with h5py.File(tmp_path / "verified.h5") as file:
        assert list(file) == ["map_1-000_a.jpg_mapping-001.jpg"]
    assert fmtorch.verify(**paths, output=tmp_path / "verified.h5").kept == 1


def test_broken_pairs_are_lines_and_stay_out(tmp_path: Path) -> None:
    pairs = write(tmp_path, scene(4))
    with h5py.File(tmp_path / "features.h5", "a") as file:
        del file["mapping/003.jpg/keypoints"]
        del file["mapping/002.jpg/image_size"]
    with h5py.File(tmp_path / "matches.h5", "a") as file:
        file["mapping-000.jpg/mapping-001.jpg/matches0"][5] = 4000
    with h5py.File(tmp_path / "matches.h5", "a") as file:
        file.copy("mapping-000.jpg/mapping-001.jpg", file, "mapping-001.jpg/mapping-000.jpg")
        file["mapping-001.jpg/mapping-000.jpg/matches0"][5] = -1
    result = fmtorch.verify(
        features=tmp_path / "features.h5", matches=tmp_path / "matches.h5", output=tmp_path / "verified.h5"
    )
    assert (result.pairs, result.verified, len(result.problems)) == (len(pairs) + 1, 1, len(pairs))
    assert any("matches0 holds -1 to 4000, but mapping/001.jpg has 150 keypoints" in line for line in result.problems)
    assert any("'mapping/002.jpg/image_size' is missing" in line for line in result.problems)
    assert any("003.jpg/keypoints' is missing" in line for line in result.problems)
    assert len(contents(tmp_path / "verified.h5")) == 4  # a group in a group, and two arrays


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["features=features.h5"], "hloc's files need features=F.h5 matches=M.h5 output=VERIFIED.h5, and no database"),
        (["a.db", *FILES], "hloc's files need"),
        (["features=no.h5", *FILES[1:]], "there is no file no.h5; give hloc's files"),
        ([*FILES[:2], "output=matches.h5"], "output=matches.h5 is one of the files that are read"),
        (["features=matches.h5", *FILES[1:]], "matches.h5 holds no keypoints; give hloc's file of features"),
        ([FILES[0], "matches=features.h5", FILES[2]], "features.h5 holds no matches0; give hloc's file of matches"),
        ([FILES[0], "matches=text.h5", FILES[2]], "text.h5: is not a valid HDF5 file"),
    ],
)
def test_what_are_no_files_to_verify(words: list[str], said: str, command: Callable[..., str], tmp_path: Path) -> None:
    write(tmp_path, scene(2))
    (tmp_path / "text.h5").write_text("matches")
    end = command("verify", *words, cwd=tmp_path)
    assert end.startswith("ended: error: ")
    assert said in end
    assert "\n" not in end
    assert not list(tmp_path.glob("verified*"))


def test_a_killed_verification_of_files_continues(tmp_path: Path) -> None:
    write(tmp_path, scene(7))
    killed_and_continued(tmp_path, tmp_path / "verified.h5", *FILES)
    fmtorch.verify(features=tmp_path / "features.h5", matches=tmp_path / "matches.h5", output=tmp_path / "truth.h5")
    assert contents(tmp_path / "verified.h5") == contents(tmp_path / "truth.h5")
