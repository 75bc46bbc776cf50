"""Caches of features and of arrays."""

import dataclasses
import multiprocessing
import os
import pickle
import re
import runpy
import signal
import sys
import time
import warnings
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from fmtorch import presets
from fmtorch.core import Features
from fmtorch.pipeline import load_pipeline
from fmtorch.runs import ArrayCache, CachedFeatures, cached, configuration, image_digest
from fmtorch.runs import fingerprint as configuration_module
from tests.helpers import full_disk, in_threads, same, write_file


def picture(seed: int = 0, shape: tuple[int, ...] = (120, 160)) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).uniform(0, 255, (shape[0] // 8, shape[1] // 8, *shape[2:]))
    return np.kron(noise, np.ones((8, 8, *(1 for _ in shape[2:])))).astype(np.uint8)


@dataclasses.dataclass(frozen=True)
class Detector:
    step: int = 8
    threads: int = dataclasses.field(default=1, compare=False)


@dataclasses.dataclass(frozen=True)
class TwoSteps:
    """Frames on a grid, described by the grey levels at their centres; says what it does."""

    detector: Detector = Detector()
    gain: float = 0.5
    log: list[str] = dataclasses.field(default_factory=list, compare=False)

    @property
    def detection(self) -> object:
        return self.detector

    def detect(self, image: NDArray[np.uint8]) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]:
        self.log.append("detect")
        y, x = np.mgrid[0 : image.shape[0] : self.detector.step, 0 : image.shape[1] : self.detector.step].reshape(2, -1)
        lafs = torch.zeros(len(x), 2, 3)
        lafs[:, 0, 0] = lafs[:, 1, 1] = 4
        lafs[:, :, 2] = torch.from_numpy(np.stack([x, y], 1)).float()
        return lafs, torch.from_numpy(image[y, x]).float() / 255

    def describe(self, image: NDArray[np.uint8], lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]:
        self.log.append("describe")
        x, y = lafs[..., 2].long().T.numpy()
        return self.gain * torch.from_numpy(image[y, x]).float()[:, None].repeat(1, 4)

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        lafs, scores = self.detect(image)
        return Features(lafs, scores, self.describe(image, lafs), torch.tensor(image.shape[:2]))


@pytest.mark.parametrize(("shape", "root"), [((240, 320), False), ((240, 320, 3), True), ((8, 8), False)])
def test_bit_equal_with_and_without(tmp_path: Path, shape: tuple[int, ...], root: bool) -> None:
    sift = presets.build("features", "sift", max_features=300, root=root)
    image = picture(shape=shape)
    first, second = (CachedFeatures(sift, ArrayCache(tmp_path)) for _ in range(2))
    truth = sift(image)
    assert shape == (8, 8) or len(truth) > 50
    assert same(first(image), truth)
    assert same(second(image), truth)
    assert ((first.computed, first.found), (second.computed, second.found)) == ((1, 0), (0, 1))


def test_every_float_survives(tmp_path: Path) -> None:
    @dataclasses.dataclass(frozen=True)
    class Odd:
        descriptors: Tensor

        def __call__(self, image: NDArray[np.uint8]) -> Features:
            n = len(self.descriptors)
            return Features(torch.zeros(n, 2, 3), torch.zeros(n), self.descriptors, torch.tensor([1, 1]))

    integral = torch.arange(256.0)[:, None]
    special = torch.tensor([[-0.0], [256.0], [-1.0], [0.5], [torch.nan], [torch.inf], [1e30], [3.0]])
    for descriptors in (integral, special, special.double(), special.half(), integral[:0], integral.double()):
        kept = CachedFeatures(Odd(descriptors), ArrayCache(tmp_path))
        for _ in range(2):
            read = kept(picture()).descriptors
            assert read.dtype == descriptors.dtype
            assert read.numpy().tobytes() == descriptors.numpy().tobytes()
        assert kept.found == 1


def test_extractors_with_the_same_detection_share_it(tmp_path: Path) -> None:
    cache, image = ArrayCache(tmp_path), picture()
    half_gain, double_gain, coarse = TwoSteps(gain=0.5), TwoSteps(gain=2.0), TwoSteps(Detector(step=16))
    both, equal_options = ["detect", "describe"], TwoSteps(Detector(threads=2))
    for extractor, expected in (
        (half_gain, both), (double_gain, ["describe"]), (coarse, both), (equal_options, []),
    ):  # fmt: skip
        truth = dataclasses.replace(extractor, log=[])(image)
        for _ in range(2):
            assert same(CachedFeatures(extractor, cache)(image), truth)
        assert extractor.log == expected
    assert len(list(cache.files())) == 5


def test_another_option_image_or_shape_is_another_file(tmp_path: Path) -> None:
    cache = ArrayCache(tmp_path)
    sift = CachedFeatures(presets.build("features", "sift"), cache)
    images = [picture(0), picture(1), picture(0).reshape(160, 120), picture(0)[:, ::-1]]
    assert len({image_digest(image) for image in images}) == len(images)
    assert image_digest(images[3]) == image_digest(np.ascontiguousarray(images[3]))
    for image in images:
        sift(image)
    assert sift.computed == 4
    other = CachedFeatures(presets.build("features", "sift", edge_threshold=9.0), cache)
    other(images[0])
    assert other.computed == 1


def test_a_failure_is_not_kept(tmp_path: Path) -> None:
    kept = CachedFeatures(presets.build("features", "sift"), ArrayCache(tmp_path))
    for _ in range(2):
        with pytest.raises(ValueError, match="non-empty"):
            kept(np.zeros((0, 4), np.uint8))
    assert not list(kept.cache.files())


def test_off_and_where(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FMTORCH_CACHE", str(tmp_path / "home"))
    sift = presets.build("features", "sift")
    assert cached(sift, "off") is sift
    assert cached(sift, False) is sift
    default, own = cached(sift, None, 1.5), cached(sift, str(tmp_path / "own"))
    assert (default.cache.folder, default.cache.limit) == (tmp_path / "home" / "features", 1_500_000_000)
    assert (own.cache.folder, own.cache.limit) == (tmp_path / "own", None)
    assert load_pipeline("sift_gms").extractor == sift  # a library call leaves nothing on disk
    kept = load_pipeline("sift_gms", overrides=[f"cache={tmp_path}/there", "cache_limit=1"]).extractor
    assert kept.cache.folder == tmp_path / "there"


def test_an_extractor_that_does_not_say_what_it_is_stays_uncached(tmp_path: Path) -> None:
    class Mine:
        def __call__(self, image: NDArray[np.uint8]) -> Features:
            raise NotImplementedError

    @dataclasses.dataclass(frozen=True)
    class Network(Mine):
        file: Path

    silent, absent = (Mine(), "Mine does not say what defines its results"), (Network(tmp_path / "a.onnx"), "a.onnx")
    for extractor, said in (silent, absent):
        with pytest.warns(UserWarning, match=f"not cached: .*{said}"):
            assert cached(extractor, tmp_path / "cache") is extractor


def test_configuration_of_files_tensors_networks_and_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclasses.dataclass(frozen=True)
    class Part:
        value: object

    class Named:
        identity = ("hardnet", 3)

    def of(value: object) -> str:
        return str(configuration(Part(value)))

    file, copy = tmp_path / "a.onnx", tmp_path / "b.onnx"
    file.write_bytes(b"one")
    copy.write_bytes(b"one")
    before = of(file)
    assert before == of(copy)
    file.write_bytes(b"two")
    os.utime(file, (1, 1))
    assert of(file) != before
    with pytest.raises(FileNotFoundError):
        of(tmp_path / "absent")
    assert of(torch.zeros(3)) == of(torch.zeros(3)) != of(torch.zeros(3, 1))
    assert of(torch.zeros(3)) != of(torch.ones(3))
    network = torch.nn.Linear(2, 2)
    before = of(network)
    with torch.no_grad():
        network.weight[0, 0] += 1
    assert of(network) != before
    assert "hardnet" in of(Named())
    assert of({"a": [1, None]}) != of({"a": [1, 0]})
    with pytest.raises(TypeError, match="function does not say"):
        of(lambda: None)

    sift = presets.build("features", "sift")
    code = configuration(sift)["code"]
    edited = write_file(tmp_path / "package" / "sift.py", "edited")
    monkeypatch.setattr(sys.modules["fmtorch.features.sift"], "__file__", str(edited))
    configuration_module.code_digest.cache_clear()
    assert configuration(sift)["code"] != code
    configuration_module.code_digest.cache_clear()


def test_the_command_lists_what_is_there(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FMTORCH_CACHE", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "argv", ["runs"])
    CachedFeatures(TwoSteps(), ArrayCache(tmp_path / "features"))(picture())
    (tmp_path / "rendered" / "orbit").mkdir(parents=True)
    (tmp_path / "rendered" / "orbit" / "00.jpg").write_bytes(bytes(1_500_000))
    runpy.run_module("fmtorch.runs", run_name="__main__")
    listed = r"(?s)features/TwoSteps-.*features/detection-.*rendered/orbit\s+│\s+1 │\s+1\.5 │ \d{4}-"
    assert re.search(listed, capsys.readouterr().out)


def write_many(cache: ArrayCache, count: int, start: int = 0) -> None:
    """Write files of 40 kB in a row, and read others back."""
    warnings.simplefilter("error")
    for i in range(start, start + count):
        cache.write("some", f"{i % 50}", {"a": np.full(5_000, i % 50)})
        found = cache.read("some", f"{(i * 7) % 50}")
        assert found is None or (found["a"] == (i * 7) % 50).all()


def writer(folder: Path, limit: int = 0, count: int = 1_000_000) -> BaseProcess:
    cache = ArrayCache(folder, limit or None)
    process = multiprocessing.get_context("fork").Process(target=write_many, args=(cache, count))
    process.start()
    return process


def expect_sound(folder: Path) -> int:
    """How many files there are, all of which can be read, without a warning."""
    names = [path.stem for path, _ in ArrayCache(folder).files()]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all((ArrayCache(folder).read("some", name)["a"] == int(name)).all() for name in names)
    return len(names)


def test_a_changed_byte_never_goes_unnoticed_and_never_crashes(tmp_path: Path) -> None:
    cache = ArrayCache(tmp_path)
    values = np.arange(40, dtype=np.uint8)
    cache.write("some", "name", {"a": values})
    path = tmp_path / "some" / "name.npz"
    sound = path.read_bytes()
    for i in range(len(sound)):
        path.write_bytes(sound[:i] + bytes([sound[i] ^ 0x55]) + sound[i + 1 :])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cached = cache.read("some", "name")
        # Some bytes of a zip file mean nothing (time stamps, attributes, an entry's name).
        assert cached is None or "a" not in cached or np.array_equal(cached["a"], values)


def test_a_pickle_is_not_opened(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.mkdir, (str(tmp_path / "executed"),)

    cache = ArrayCache(tmp_path)
    (tmp_path / "some").mkdir()
    with (tmp_path / "some" / "pickled.npz").open("wb") as file:
        np.savez(file, a=np.array([Bomb()], dtype=object))
    (tmp_path / "some" / "plain.npz").write_bytes(pickle.dumps(Bomb()))
    for name in ("pickled", "plain"):
        with pytest.warns(UserWarning, match="damaged"):
            assert cache.read("some", name) is None
    assert not (tmp_path / "executed").exists()


def test_the_least_recently_used_files_go(tmp_path: Path) -> None:
    size = 8 * 1000
    cache = ArrayCache(tmp_path, limit=20 * size)
    for i in range(12):
        cache.write("some", f"{i}", {"a": np.full(1000, i)})
        os.utime(tmp_path / "some" / f"{i}.npz", (1000 + i, 1000 + i))
    assert cache.read("some", "0") is not None  # used again, so 1 is the oldest
    for i in range(12, 40):
        cache.write("other", f"{i}", {"a": np.full(1000, i)})
        time.sleep(0.002)  # file systems' clocks tick in milliseconds
        assert sum(status.st_size for _, status in cache.files()) <= 1.05 * 20 * size
        if i == 24:
            assert cache.read("some", "0") is not None
            assert cache.read("some", "1") is None
    kept = {path.stem for path, _ in cache.files()}
    assert "39" in kept
    assert "12" not in kept


def test_dead_writers_leftovers_are_removed_and_live_ones_kept(tmp_path: Path) -> None:
    (tmp_path / "some").mkdir()
    dead, live = tmp_path / "some" / "a.npz.1.tmp", tmp_path / "some" / "b.npz.2.tmp"
    for path in (dead, live):
        path.write_bytes(b"half")
    before = time.time() - 7200
    os.utime(dead, (before, before))
    ArrayCache(tmp_path).write("some", "c", {"a": np.zeros(1)})
    assert not dead.exists()
    assert live.exists()


def test_a_killed_writer_leaves_no_broken_file(tmp_path: Path) -> None:
    for kill in range(2):
        process = writer(tmp_path)
        deadline = time.monotonic() + 60
        while len(list(tmp_path.glob("some/*.npz"))) < 3 + kill and time.monotonic() < deadline:
            time.sleep(0.002)
        process.kill()
        process.join(60)
        assert process.exitcode == -signal.SIGKILL
    assert expect_sound(tmp_path) >= 3


@pytest.mark.parametrize("limit", [0, 500_000])
def test_processes_share_a_cache(tmp_path: Path, limit: int) -> None:
    processes = [writer(tmp_path, limit, 55) for _ in range(2)]
    for process in processes:
        process.join(120)
        assert process.exitcode == 0
    total = sum(status.st_size for _, status in ArrayCache(tmp_path).files())
    assert expect_sound(tmp_path) == 50 if limit == 0 else total <= 1.1 * limit + 2 * 40_500
    assert not list(tmp_path.glob("some/*.tmp"))


def test_threads_share_a_cache(tmp_path: Path) -> None:
    cache = ArrayCache(tmp_path, limit=500_000)
    in_threads(4, lambda number: write_many(cache, 60, 7 * number))


def test_what_cannot_be_written_is_reported_and_harms_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("numpy.savez", full_disk)
    cache = ArrayCache(tmp_path)
    with pytest.warns(UserWarning, match="No space left on device"):
        cache.write("some", "name", {"a": np.zeros(1)})
    assert cache.read("some", "name") is None
    assert not list(tmp_path.glob("some/*"))


def test_bad_arguments(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file"):
        ArrayCache(tmp_path / "file")
    with pytest.raises(ValueError, match="must be positive"):
        ArrayCache(tmp_path, limit=0)


@pytest.mark.parametrize("change", ["value", "shape", "name", "another image's", "no digest"])
def test_a_sound_file_of_wrong_content_is_absent(tmp_path: Path, change: str) -> None:
    cache = ArrayCache(tmp_path)
    cache.write("s", "a", {"x": np.arange(6.0), "seconds": np.array(1.0)})
    cache.write("s", "b", {"x": np.arange(9.0), "seconds": np.array(1.0)})
    path = tmp_path / "s" / "a.npz"
    with np.load(path) as file:
        arrays = dict(file)
    if change == "another image's":
        path.write_bytes((tmp_path / "s" / "b.npz").read_bytes())
    else:
        changed = {
            "value": {**arrays, "x": arrays["x"] + np.eye(6)[0]}, "shape": {**arrays, "x": arrays["x"].reshape(2, 3)},
            "name": {"y": arrays["x"], "seconds": arrays["seconds"], "digest": arrays["digest"]},
            "no digest": {"x": arrays["x"], "seconds": arrays["seconds"]},
        }[change]  # fmt: skip
        np.savez(path, **changed)
    said = "'digest'" if change == "no digest" else "it is not what was written there"
    with pytest.warns(UserWarning, match=f"a.npz is damaged .{said}.; it is computed anew"):
        assert cache.read("s", "a") is None
    cache.write("s", "a", {"x": np.arange(6.0), "seconds": np.array(1.0)})
    again = cache.read("s", "a")
    np.testing.assert_array_equal(again["x"], np.arange(6.0))


def test_a_truncated_file_is_computed_anew(tmp_path: Path) -> None:
    kept = CachedFeatures(presets.build("features", "sift"), ArrayCache(tmp_path))
    truth = kept(picture())
    ((path, status),) = kept.cache.files()
    for size in (0, status.st_size // 2, status.st_size - 1):
        path.write_bytes(path.read_bytes()[:size])
        with pytest.warns(UserWarning, match=rf"{path.name} is damaged"):
            assert same(kept(picture()), truth)
        assert same(kept(picture()), truth)
    assert (kept.computed, kept.found) == (4, 3)
