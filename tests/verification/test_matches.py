"""Matches alone verified: what the public function finds, of one pair and of many, in npz and HDF5 files."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import fmtorch
from fmtorch import presets
from fmtorch.core import Correspondences, Estimate, pair_key
from fmtorch.jobs import Execution
from fmtorch.verification import verify as verification
from tests.helpers import write_file
from tests.verification import databases
from tests.verification.databases import SIZE, Scene, killed_and_continued, matches, plain, read, scene

K = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
SIZES = {"size0": np.array(SIZE), "size1": np.array(SIZE)}
CALIBRATIONS = {"K0": K, "K1": K}
HLOC = {"features": "features.h5", "matches": "matches.h5", "output": "verified.h5"}
FILES = [f"{argument}={name}" for argument, name in HLOC.items()]


def points(count: int = 2, kind: str = "general") -> list[tuple[np.ndarray, np.ndarray]]:
    rng, cameras = np.random.default_rng(0), scene(count, kind=kind)
    images = []
    for R, t in zip(cameras.R, cameras.t, strict=True):
        X = (cameras.X @ R.T + t) @ K.T
        images.append(X[:, :2] / X[:, 2:] + rng.normal(0, 0.3, (len(X), 2)))
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    matched = [(matches(len(cameras.X), rng).astype(int), *pair) for pair in pairs]
    return [(images[i][m[:, 0]], images[j][m[:, 1]]) for m, i, j in matched]


def arrays_of(pairs: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    return {f"{i}/{key}": x for i, pair in enumerate(pairs) for key, x in zip(("x0", "x1"), pair, strict=True)}


def save(path: Path, arrays: dict[str, Any]) -> Path:
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    else:
        with h5py.File(path, "w") as file:
            for key, value in arrays.items():
                file[key] = value
    return path


def load(path: Path) -> dict[str, Any]:
    """All arrays of a file; attributes of HDF5 groups as arrays of them."""
    if path.suffix == ".npz":
        with np.load(path) as file:
            return {key: value.tolist() for key, value in file.items()}
    with h5py.File(path) as file:
        found = [file]
        file.visititems(lambda _, entry: found.append(entry))
        attributes = {f"{e.name}/{key}": np.asarray(value).tolist() for e in found for key, value in e.attrs.items()}
        arrays = {entry.name: entry[()].tolist() for entry in found if isinstance(entry, h5py.Dataset)}
    return {name.lstrip("/"): value for name, value in {**attributes, **arrays}.items()}


@pytest.mark.parametrize(
    ("known", "endings"),
    [
        ({}, (".npz", ".npz")), (SIZES, (".h5", ".h5")), (CALIBRATIONS, (".npz", ".hdf5")),
        ({**SIZES, **CALIBRATIONS}, (".npz", ".npz")), ({**SIZES, "K0": K}, (".h5", ".h5")),
    ],
)  # fmt: skip
def test_one_pair_is_that_of_find_fundamental(known: dict[str, Any], endings: tuple[str, str], tmp_path: Path) -> None:
    """By what is known: without sizes F and H alone, with sizes a pose too, with K a calibrated one."""
    (x0, x1), output = points()[0], tmp_path / f"verified{endings[1]}"
    path = save(tmp_path / f"matches{endings[0]}", {"x0": x0, "x1": x1, **known})
    kind = "calibrated" if "K1" in known else "uncalibrated"
    result = fmtorch.verify(matches=path, output=output)
    assert (result.path, result.pairs, result.configurations, result.problems) == (output, 1, {kind: 1}, ())
    cameras = dict(known)
    if "K1" in known:
        cameras |= SIZES
    elif known:
        cameras["focal"] = None if "K0" in known else "unknown"
    x0, x1 = x0.astype(np.float32), x1.astype(np.float32)
    estimate = fmtorch.find_fundamental(x0, x1, key=pair_key("x0 x1"), **cameras)
    verified = load(output)
    assert verified["configuration"] == kind
    assert verified["inliers"] == estimate.inliers[0].tolist()
    np.testing.assert_array_equal(verified["F"], estimate.F[0].double())
    assert set(verified) == {"configuration", "inliers", "H", "F"} | ({"E", "R", "t"} if known else set())
    if known:
        np.testing.assert_array_equal(verified["R"], estimate.R[0])
        np.testing.assert_array_equal(verified["t"], estimate.t[0])
    assert sorted(os.listdir(tmp_path)) == sorted([path.name, output.name])


@pytest.mark.parametrize("ending", [".npz", ".h5"])
def test_pairs_of_different_knowledge_do_not_meet(ending: str, tmp_path: Path) -> None:
    """Each is as it would be in a file of its own; a pair that turned is panoramic."""
    knowledge: list[dict[str, Any]] = [{}, SIZES, CALIBRATIONS, {**SIZES, "K1": K}, SIZES, {}]
    arrays: dict[str, Any] = {}
    for i, ((x0, x1), known) in enumerate(zip(points(4), knowledge, strict=True)):
        arrays |= {f"walk/{i}/{key}": value for key, value in {"x0": x0, "x1": x1, **known}.items()}
    ((x0, x1),) = points(2, "rotation")
    arrays |= {"turn/x0": x0, "turn/x1": x1, **{f"turn/{key}": value for key, value in CALIBRATIONS.items()}}
    path, output = save(tmp_path / f"matches{ending}", arrays), tmp_path / f"verified{ending}"
    result = fmtorch.verify(matches=path, output=output)
    assert result.configurations == {"uncalibrated": 5, "calibrated": 1, "panoramic": 1}
    together = load(output)
    for pair in [f"walk/{i}" for i in range(6)] + ["turn"]:
        alone = {key: value for key, value in arrays.items() if key.startswith(f"{pair}/")}
        fmtorch.verify(matches=save(path, alone), output=output, force=True)
        for key, value in load(output).items():
            assert together[key] == value, key
    assert "turn/F" not in together
    assert together["turn/t"] == [0, 0, 0]


def test_broken_pairs_are_lines_and_stay_out(tmp_path: Path) -> None:
    x0, x1 = points()[0]
    good = {"x0": x0, "x1": x1, **SIZES}
    broken: dict[str, dict[str, Any]] = {
        "a": good, "b": {**good, "x1": x1[:-1]}, "c": {**good, "x0": x0[:, :1]}, "d": {**good, "K0": K[:2]},
        "e": {**good, "size1": np.array([0, 640])}, "f": {**good, "x0": x0 > 0}, "g": {"x0": x0, "x1": x1, "K0": K},
        "h": {**good, "K0": 0 * K}, "i": {**good, "x0": np.array([None])}, "j": {"x0": x0}, "k": {"x1": x1},
    }  # fmt: skip
    arrays = {f"{pair}/{key}": value for pair, entries in broken.items() for key, value in entries.items()}
    result = fmtorch.verify(matches=save(tmp_path / "matches.npz", arrays), output=tmp_path / "verified.npz")
    assert (result.pairs, result.verified) == (11, 1)
    said = (
        f"x0 has {len(x0)} points and x1 has {len(x1) - 1}; they must have as many",
        f"c/x0 has shape ({len(x0)}, 1); it must be (n, 2)",
        "d/K0 has shape (2, 3); it must be (3, 3)",
        "size1 is [0.0, 640.0]; it must be the height and width of the image",
        "f/x0 is of bool; it must hold real numbers",
        *("K0 alone needs the image sizes", "K0", "i/x0 cannot be read", "j/x1 is missing", "k/x0 is missing"),
    )
    for line, pair, words in zip(sorted(result.problems), "bcdefghijk", said, strict=True):
        assert line.startswith(f"{pair}/x0, {pair}/x1: {words}")
    assert {key.partition("/")[0] for key in load(tmp_path / "verified.npz")} == {"a"}


class FailsOnFew:
    """Somebody's estimator, which raises where a pair has fewer matches than these."""

    def __init__(self, minimum: int) -> None:
        self.minimum = minimum

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate | None:
        if int(c.count().min()) < self.minimum:
            raise ZeroDivisionError("too few")
        return presets.build("estimator", "lmeds")(c, seed) if self.minimum else None


def test_what_an_estimator_raises_is_of_its_pair_alone(tmp_path: Path) -> None:
    write_file(tmp_path / "estimator" / "mine.yaml", f"_target_: {__name__}.FailsOnFew\nminimum: 50\n")
    x0, x1 = points()[0]
    arrays = {"a/x0": x0, "a/x1": x1, "b/x0": x0[:40], "b/x1": x1[:40]}
    output = tmp_path / "verified.npz"
    given: dict[str, Any] = {"output": output, "estimator": "mine", "config_dir": tmp_path}
    result = fmtorch.verify(matches=save(tmp_path / "matches.npz", arrays), **given)
    assert result.verified == 1
    assert [text.partition(" (")[0] for text in result.problems] == ["b/x0, b/x1: ZeroDivisionError: too few"]
    assert [trace.count('raise ZeroDivisionError("too few")') for trace in result.tracebacks] == [1]
    for minimum, said in ((1000, "ZeroDivisionError: too few"), (0, "FailsOnFew returned None; it must return")):
        result = fmtorch.verify(matches=tmp_path / "matches.npz", minimum=minimum, force=True, **given)
        assert [said in line for line in result.problems] == [True, True]
        assert not load(output)
        assert {path.name for path in tmp_path.iterdir()} == {"estimator", "matches.npz", output.name}
    output.unlink()
    paths = verification.VerifyPaths(None, None, tmp_path / "matches.npz", output)
    with pytest.raises(ZeroDivisionError, match="too few"):
        verification.verify_by(lambda: FailsOnFew(1000), {}, paths, verification.VerifyMode(debug=True), print)
    refused = (("fmtorch", -0.6, "it is lambda in half diagonals"), ("lmeds", -0.1, "lens needs an"))
    for estimator, lens, said in refused:
        with pytest.raises(ValueError, match=said):
            fmtorch.verify(matches=tmp_path / "matches.npz", output=output, estimator=estimator, lens=lens)


def test_the_checks_are_those_of_the_functions(tmp_path: Path) -> None:
    """Crops are taken; normalised points, with K in pixels too, and sizes as (w, h) are lines, not geometries."""
    x0, x1 = points()[0]
    n0, n1 = (((x - K[:2, 2]) / 600).astype(np.float16) for x in (x0, x1))
    crop = K - [[0, 0, 330], [0, 0, 0], [0, 0, 0]]
    inside = (x0[:, 0] >= 0) & (x0[:, 0] < 310) & (x1[:, 0] >= 330)
    y0, y1 = x0[inside], x1[inside] - [330, 0]
    given: dict[str, dict[str, Any]] = {
        "crop": {"x0": y0, "x1": y1, "K0": K, "K1": crop, "size0": np.array([480, 310]), "size1": np.array([480, 500])},
        "normalised": {"x0": n0, "x1": n1}, "units": {"x0": n0, "x1": n1, **CALIBRATIONS},
        "sizes": {"x0": x0, "x1": x1, "size0": np.array(SIZE[::-1]), "size1": np.array(SIZE[::-1])},
        "few": {"x0": x0[:5], "x1": x1[:5]},
        "resolution": {"x0": x0, "x1": x1, **SIZES, "K0": K / [[4], [4], [1]], "K1": K / [[4], [4], [1]]},
    }  # fmt: skip
    arrays = {f"{pair}/{key}": value for pair, entries in given.items() for key, value in entries.items()}
    path, output = save(tmp_path / "matches.npz", arrays), tmp_path / "verified.npz"
    result = fmtorch.verify(matches=path, output=output)
    said = sorted(result.problems)
    assert [line.partition("/")[0] for line in said] == ["normalised", "sizes", "units"]
    for line, expected in zip(said, ("no pixels", "sizes are (h, w)", "K0 is in pixels"), strict=True):
        assert expected in line
    (warning,) = result.warnings
    assert warning.startswith("resolution/x0, resolution/x1: far more matches agree without the calibration")
    verified = load(output)
    pose = fmtorch.find_essential(y0, y1, K, crop)
    np.testing.assert_allclose(verified["crop/R"], pose.R[0], atol=2e-3)
    assert verified["few/reason"] == "5 matches; at least 7 are needed"
    assert "another resolution" in verified["resolution/warning"]


@pytest.mark.parametrize("ending", [".npz", ".h5"])
def test_a_complete_output_is_left_as_it_is(ending: str, command: Callable[..., str], tmp_path: Path) -> None:
    path, output = tmp_path / f"matches{ending}", tmp_path / f"verified{ending}"
    x0, x1 = points()[0]
    save(path, {"a/x0": x0, "a/x1": x1})
    fmtorch.verify(matches=path, output=output)
    before = output.read_bytes()
    again = fmtorch.verify(matches=path, output=output)
    assert (again.path, again.pairs, again.kept, dict(again.configurations)) == (output, 1, 1, {})
    assert output.read_bytes() == before
    said = command("verify", f"matches={path.name}", f"output={output.name}", cwd=tmp_path)
    assert f"nothing to do: {output.name} has a geometry of each pair (1);" in said
    save(path, {"a/x0": x0, "a/x1": x1, "b/x0": x0, "b/x1": x1})
    with pytest.raises(ValueError, match="exists; name another file"):
        fmtorch.verify(matches=path, output=output)
    save(path, {"a/x0": x0 / 1000, "a/x1": x1 / 1000})
    said = command("verify", f"matches={path.name}", f"output={output.name}", "force=true", cwd=tmp_path)
    assert said.endswith("ended: error: no pair has a geometry")
    assert "a/x0, a/x1: x0 runs from" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["matches=matches.npz"], "matches alone need an output: matches=FILE.npz output=VERIFIED.npz"),
        (["matches=no.npz", "output=v.npz"], "there is no file no.npz; give matches alone: matches=FILE.npz"),
        (["matches=text.npz", "output=v.npz"], "text.npz: is not a valid npz file"),
        (["matches=empty.npz", "output=v.npz"], "empty.npz: is not a valid npz file"),
        (["matches=array.npz", "output=v.npz"], "array.npz: is a single array; write x0 and x1 by numpy.savez"),
        (["matches=text.h5", "output=v.npz"], "text.h5: is not a valid HDF5 file"),
        (["matches=matches.txt", "output=v.npz"], "matches=matches.txt must end in .npz, .h5, .hdf5"),
        (["matches=matches.npz", "output=v.txt"], "output=v.txt must end in .npz, .h5, .hdf5"),
        (["matches=matches.npz", "output=matches.npz"], "output=matches.npz is one of the files that are read"),
        (["matches=other.npz", "output=v.npz"], "other.npz holds no x0 and x1; give matches x0, x1 (n, 2)"),
        (["features=features.h5"], "hloc's files need features=F.h5 matches=M.h5 output=VERIFIED.h5, and no database"),
        (["a.db", *FILES], "hloc's files need"),
        (["features=no.h5", *FILES[1:]], "there is no file no.h5; give hloc's files"),
        ([*FILES[:2], "output=matches.h5"], "output=matches.h5 is one of the files that are read"),
        (["features=matches.h5", *FILES[1:]], "matches.h5 holds no keypoints; give hloc's file of features"),
        ([FILES[0], "matches=features.h5", FILES[2]], "features.h5 holds no matches0; give hloc's file of matches"),
        ([FILES[0], "matches=text.h5", FILES[2]], "text.h5: is not a valid HDF5 file"),
        (["a.db", "matches=matches.npz", "output=v.npz"], "hloc's files need"),
    ],
)
def test_what_are_no_files_to_verify(words: list[str], said: str, command: Callable[..., str], tmp_path: Path) -> None:
    write(tmp_path, scene(2))
    x0, x1 = points()[0]
    save(tmp_path / "matches.npz", {"x0": x0, "x1": x1})
    save(tmp_path / "other.npz", {"x0": x0})
    with (tmp_path / "array.npz").open("wb") as file:
        np.save(file, x0)
    for name in ("text.npz", "text.h5", "matches.txt", "empty.npz"):
        (tmp_path / name).write_text("matches" * (name != "empty.npz"))
    end = command("verify", *words, cwd=tmp_path)
    assert end.startswith("ended: error: ")
    assert said in end
    assert "\n" not in end
    assert not list(tmp_path.glob("v*.*"))


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


def hloc(folder: Path) -> dict[str, Path]:
    return {argument: folder / file for argument, file in HLOC.items()}


def test_inliers_and_matrices_are_those_of_find_fundamental(tmp_path: Path) -> None:
    pairs = write(tmp_path, scene(3))
    features, stored, output = hloc(tmp_path).values()
    result = fmtorch.verify(**hloc(tmp_path))
    assert (result.path, result.pairs, result.configurations) == (output, 3, {"uncalibrated": 3})
    with h5py.File(features) as f, h5py.File(stored) as m, h5py.File(output) as v:
        for a, b in pairs:
            key = f"{a.replace('/', '-')}/{b.replace('/', '-')}"
            second = m[key]["matches0"][:].astype(int)
            first = np.flatnonzero(second >= 0)
            x0 = f[a]["keypoints"][:].astype(np.float32)[first]
            x1 = f[b]["keypoints"][:].astype(np.float32)[second[first]]
            estimate = fmtorch.find_fundamental(x0, x1, focal="unknown", **SIZES, key=pair_key(f"{a} {b}"))
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
    result = fmtorch.verify(**hloc(tmp_path))
    assert (result.configurations, result.problems) == ({"uncalibrated": 1}, ())
    with h5py.File(tmp_path / "verified.h5") as file:
        assert list(file) == ["map_1-000_a.jpg_mapping-001.jpg"]
    assert fmtorch.verify(**hloc(tmp_path)).kept == 1


def test_broken_hloc_pairs_are_lines_and_stay_out(tmp_path: Path) -> None:
    pairs = write(tmp_path, scene(4))
    with h5py.File(tmp_path / "features.h5", "a") as file:
        del file["mapping/003.jpg/keypoints"]
        del file["mapping/002.jpg/image_size"]
    with h5py.File(tmp_path / "matches.h5", "a") as file:
        file["mapping-000.jpg/mapping-001.jpg/matches0"][5] = 4000
    with h5py.File(tmp_path / "matches.h5", "a") as file:
        file.copy("mapping-000.jpg/mapping-001.jpg", file, "mapping-001.jpg/mapping-000.jpg")
        file["mapping-001.jpg/mapping-000.jpg/matches0"][5] = -1
    result = fmtorch.verify(**hloc(tmp_path))
    assert (result.pairs, result.verified, len(result.problems)) == (len(pairs) + 1, 1, len(pairs))
    assert any("matches0' names keypoint 4000, but the second image has 150" in line for line in result.problems)
    assert any("'mapping/002.jpg/image_size' is missing" in line for line in result.problems)
    assert any("003.jpg/keypoints' is missing" in line for line in result.problems)
    assert {key.rpartition("/")[0] for key in load(tmp_path / "verified.h5")} == {"mapping-001.jpg/mapping-000.jpg"}


@pytest.mark.parametrize(
    "names", [{"matches": "m.npz", "output": "v.npz"}, {"matches": "m.h5", "output": "v.h5"}, HLOC]
)
def test_a_killed_verification_of_files_continues(names: dict[str, str], tmp_path: Path) -> None:
    if names is HLOC:
        write(tmp_path, scene(6))
    else:
        save(tmp_path / names["matches"], arrays_of(points(6)))
    output = tmp_path / names["output"]
    truth = output.with_stem("truth")
    killed_and_continued(tmp_path, output, *(f"{argument}={name}" for argument, name in names.items()))
    fmtorch.verify(**{argument: tmp_path / name for argument, name in names.items()} | {"output": truth})
    assert load(output) == load(truth)


@pytest.fixture
def _small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fmtorch.verification.verify.BATCH", 2)


@pytest.mark.usefixtures("_small_batches")
def test_processes_find_what_threads_find(tmp_path: Path) -> None:
    path, other = tmp_path / "database.db", tmp_path / "other.db"
    databases.write(path, scene(5))
    shutil.copy(path, other)
    reports: list[tuple[int, int]] = []
    fmtorch.verify(path)
    result = fmtorch.verify(other, execution=Execution("processes", 2), report=lambda *c: reports.append(c))
    assert ((result.pairs, result.verified), reports[0]) == ((10, 10), (0, 10))
    assert (reports[-1], plain(read(other))) == ((10, 10), plain(read(path)))


@pytest.mark.usefixtures("_small_batches")
@pytest.mark.parametrize("output", [False, True])
def test_shards_are_merged(output: bool, tmp_path: Path) -> None:
    path, unsharded = tmp_path / "database.db", tmp_path / "whole.db"
    databases.write(path, scene(5))
    shutil.copy(path, unsharded)
    fmtorch.verify(unsharded)
    before = path.read_bytes()
    end = {"output": tmp_path / "verified.db"} if output else {}
    results = [fmtorch.verify(path, shard=f"{i}/3", **end) for i in (1, 3)]
    assert [result.pairs for result in results] == [3, 4]
    assert path.read_bytes() == before  # the database itself is only read
    again = fmtorch.verify(path, shard="3/3", **end)
    assert (again.kept, again.verified) == (4, 0)
    merged = fmtorch.verify(path, **end)  # the second shard was never run
    assert (merged.pairs, merged.verified, merged.kept) == (10, 10, 7)
    assert plain(read(merged.path)) == plain(read(unsharded))
    assert not results[0].path.exists()


@pytest.mark.usefixtures("_small_batches")
def test_shards_of_other_settings_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    databases.write(path, scene(3))
    fmtorch.verify(path, shard="1/2")
    with pytest.raises(ValueError, match=r"holds geometries of other settings; .*: seed: 0 -> 1\. Give the same, or"):
        fmtorch.verify(path, shard="2/2", seed=1)
    with pytest.raises(ValueError, match=r"shard=3/2; it must be i/n"):
        fmtorch.verify(path, shard="3/2")


@pytest.mark.usefixtures("_small_batches")
def test_shards_of_matches_alone(tmp_path: Path) -> None:
    arrays = arrays_of(points(4))
    path = save(tmp_path / "matches.npz", arrays)
    unsharded = fmtorch.verify(matches=path, output=tmp_path / "whole.npz")
    for shard in ("1/2", "2/2"):
        fmtorch.verify(matches=path, output=tmp_path / "merged.npz", shard=shard)
    merged = fmtorch.verify(matches=path, output=tmp_path / "merged.npz")
    assert (merged.pairs, merged.kept) == (6, 6)
    assert load(merged.path) == load(unsharded.path)
    save(path, {**arrays, "5/x0": arrays["5/x0"] + 1})
    fmtorch.verify(matches=path, output=tmp_path / "new.npz", shard="1/2")
    save(path, arrays)
    with pytest.raises(ValueError, match=r"holds geometries of other settings; what differs .*: files: "):
        fmtorch.verify(matches=path, output=tmp_path / "new.npz", shard="2/2")
