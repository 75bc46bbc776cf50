"""Damaged files: told, computed anew, or of no consequence; never another result, never a crash."""

import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from fmtorch.core import NetworkFileError, models_dir, onnx_session, pair_key
from fmtorch.data import ImageError, read_image
from fmtorch.runs import ArrayCache, PairRow, RunFolder, RunFolderError
from tests.processes import run_command
from tests.reliability.images import NO_IMAGES, SOUND

BOUNDED, WHOLE = 40, 2000  # damages to each kind of file
Property = Callable[[str, object], None]
PILLOWS_WARNINGS = pytest.mark.filterwarnings("ignore:Corrupt EXIF data|Tag data larger than file:UserWarning")
DAMAGED = ("grey.jpg", "progressive.jpg", "16 bit.png", "palette.png", "alpha.webp", "16 bit.tiff", "animated.gif")


def damages(data: bytes, count: int) -> Iterator[bytes]:
    """The file cut short, with a bit turned, bytes overwritten, a block lost or doubled, or zeros at its end."""
    rng = np.random.default_rng(0)
    yield b""
    for _ in range(count - 1):
        at, end = np.sort(rng.integers(0, len(data), 2))
        kind = rng.integers(0, 6)
        if kind == 0:
            yield data[:at]
        elif kind <= 2:
            bits = bytearray(data)
            bits[at] ^= 1 << int(rng.integers(0, 8))
            yield bytes(bits)
        elif kind == 3:
            yield data[:at] + rng.bytes(min(64, len(data) - int(at))) + data[at + 64 :]
        elif kind == 4:
            yield data[:at] + data[end:] if rng.random() < 0.5 else data[:end] + data[at:]
        else:
            yield data[:at] + bytes(len(data) - int(at))


def damaged(file: Path, count: int) -> Iterator[bool]:
    """Damage a file so often; whether it is as it was."""
    data = file.read_bytes()
    for damage in damages(data, count):
        file.write_bytes(damage)
        yield damage == data


def run_folder(path: Path) -> RunFolder:
    run = RunFolder.open(path, {"pipeline": "sift", "seed": 0, "pruner": [{"ratio": {"threshold": 0.8}}]})
    names = [f"a/{i}" for i in range(8)]
    run.append([PairRow(n, pair_key(n), "a", "b", True, nsgd=0.01 * i, F=[0.1 * i] * 9) for i, n in enumerate(names)])
    return run


def damaged_parts(path: Path, count: int) -> int:
    """Damage a part of a run; it is told every time."""
    run, reported = run_folder(path), 0
    truth, part = run.read(), next((path / "pairs").iterdir())
    for same in damaged(part, count):
        if same:
            assert run.read() == truth
            continue
        for use in (run.read, run.done):
            with pytest.raises(RunFolderError, match=rf"{part.name} cannot be read .*delete it"):
                use()
        reported += 1
    return reported


def damaged_identities(path: Path, count: int) -> int:
    """Damage run.json: it is told, or it is of no consequence."""
    run = run_folder(path)
    file, config, reported = path / "run.json", run.config, 0
    for _ in damaged(file, count):
        try:
            assert RunFolder.load(path).config == config
        except RunFolderError as error:
            assert str(file) in str(error)  # noqa: PT017
            reported += 1
    return reported


def damaged_features(path: Path, count: int) -> int:
    """Damage a file of the feature cache: it counts as absent."""
    cache = ArrayCache(path)
    arrays = {"lafs": np.random.default_rng(0).normal(size=(9, 2, 3)), "seconds": np.array(0.5)}
    cache.write("section", "name", arrays)
    file, reported = next(path.glob("*/*.npz")), 0
    for _ in damaged(file, count):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            cached = cache.read("section", "name")
        if cached is None:
            assert any(str(file) in str(warning.message) for warning in said)
            reported += 1
        else:
            assert all(np.array_equal(cached[name], arrays[name]) for name in arrays)
    return reported


TRIALS = {"parts": damaged_parts, "run.json": damaged_identities, "features": damaged_features}


@pytest.mark.parametrize("count", [BOUNDED, pytest.param(WHOLE, marks=pytest.mark.reliability)])
@pytest.mark.parametrize("kind", TRIALS)
def test_damaged_files(kind: str, count: int, tmp_path: Path, record_property: Property) -> None:
    told = TRIALS[kind](tmp_path / "here", count)
    assert told > count / 2
    record_property(f"damaged {kind}, told", told)


def damaged_networks(folder: Path, count: int) -> Counter[str]:
    """Open a network that is damaged so often and, where it opens, run it; what came of it."""
    outcomes, source = Counter[str](), models_dir() / "lc_e.onnx"
    inputs = onnx_session(source, 1, "").get_inputs()
    shapes = {each.name: [size if isinstance(size, int) else 20 for size in each.shape] for each in inputs}
    feed = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    file = folder / "damaged.onnx"
    for damage in damages(source.read_bytes(), count):
        file.write_bytes(damage)
        try:
            session = onnx_session(file, 1, "the command that makes it")
        except NetworkFileError as error:
            assert str(file) in str(error)  # noqa: PT017
            outcomes["told"] += 1
            continue
        try:
            session.run(None, feed)
            outcomes["runs"] += 1
        except RuntimeError:  # which becomes the reason of the pairs that need it
            outcomes["told when it runs"] += 1
    return outcomes


@pytest.mark.parametrize("count", [12, pytest.param(400, marks=pytest.mark.reliability)])
def test_damaged_networks(count: int, tmp_path: Path, record_property: Property) -> None:
    """In a process of its own, which a fault of the runtime would end."""
    call = f"test_damage.damaged_networks(test_damage.Path({str(tmp_path)!r}), {count})"
    done = run_command("-c", f"from tests.reliability import test_damage; print({call})", cwd=tmp_path, patience=7200)
    assert done.returncode == 0, f"{done.returncode}: {done.stdout[-500:]} {done.stderr[-2000:]}"
    assert "'told'" in done.stdout
    record_property("damaged networks", done.stdout)


@pytest.mark.parametrize("name", SOUND)
def test_images_of_any_kind(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(SOUND[name]())
    image = read_image(path)
    assert image.dtype == np.uint8
    assert image.ndim == 2 or image.shape[2] == 3
    assert image.std() > 10 or image.shape[0] == 1  # it is the picture


@PILLOWS_WARNINGS
@pytest.mark.parametrize("name", NO_IMAGES)
def test_files_that_are_no_image(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(NO_IMAGES[name]())
    with pytest.raises(ImageError, match=rf"{path}: .*(it must|copy it again)"):
        read_image(path)


@PILLOWS_WARNINGS
@pytest.mark.parametrize("count", [140, pytest.param(7000, marks=pytest.mark.reliability)])
def test_damaged_images(count: int, tmp_path: Path, record_property: Property) -> None:
    """An image of some kind, or an error. (GIF, TIFF and WebP have no checksums.)"""
    refused = read = 0
    for name in DAMAGED:
        file = tmp_path / name
        file.write_bytes(SOUND[name]())
        for _ in damaged(file, count // len(DAMAGED)):
            try:
                image = read_image(file)
            except ImageError as error:
                assert str(file) in str(error)  # noqa: PT017
                refused += 1
                continue
            assert image.dtype == np.uint8
            read += 1
    assert refused > read
    record_property("damaged images, refused and read", (refused, read))
