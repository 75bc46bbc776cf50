"""Files of matches to verify: hloc's features and matches, or x0, x1 alone; and files of what was verified."""

import contextlib
import functools
import hashlib
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fmtorch.core.files import replacing
from fmtorch.data.files import Array, DataError, Indices, Matrix
from fmtorch.io import h5, predictions
from fmtorch.io.colmap import DatabaseImage
from fmtorch.io.match_store import MATRICES, PairGeometry

MEMORY = 256  # images whose keypoints are kept
Names = tuple[str, str]
OpenFiles = TypeVar("OpenFiles", bound="_OpenFiles")


class _OpenFiles:
    """Files of matches that are read, closed on leaving, and know no geometry; images are read when asked for."""

    def __init__(self, files: Sequence[Path], output: Path) -> None:
        self.files, self._output, self._open = files, output, contextlib.ExitStack()
        self.image = functools.lru_cache(maxsize=MEMORY)(self._image)

    def __enter__(self: OpenFiles) -> OpenFiles:
        return self

    def __exit__(self, *error: object) -> None:
        self._open.close()

    def identity(self) -> dict[str, Any]:
        digest = hashlib.blake2b(digest_size=16)
        for path in self.files:
            h5.add_to_digest(digest, path)
        return {"files": digest.hexdigest()}

    def has_geometry(self, pair: Names) -> bool:
        return False

    def name(self, image_id: str) -> str:
        return image_id

    def _image(self, image_id: str) -> DatabaseImage:
        raise NotImplementedError


class HlocMatches(_OpenFiles):
    """The pairs of two files; output: the file of matches that is written.
    Raises DataError where one of the files is no HDF5 file, or holds no keypoints or no matches."""

    def __init__(self, features: Path, matches: Path, output: Path) -> None:
        super().__init__((features, matches), output)
        with contextlib.ExitStack() as stack:
            self._features, self._matches = (stack.enter_context(h5.opened(path)) for path in (features, matches))
            images = h5.groups_with(self._features, "keypoints")
            if not images:
                raise DataError(f"{features} holds no keypoints; give hloc's file of features")
            self._stored = {name.replace("/", "-"): name for name in images}
            self._keys = {self._named(key): key for key in h5.groups_with(self._matches, "matches0")}
            if not self._keys:
                raise DataError(f"{matches} holds no matches0; give hloc's file of matches")
            self._open = stack.pop_all()

    def pairs(self) -> list[Names]:
        return sorted(self._keys)

    def finished(self) -> int:
        """How many pairs the output has, if it has all of them; else 0."""
        with h5.opened(self._output) as written:
            return len(self._keys) if all(h5.holds(written, key) for key in self._keys.values()) else 0

    def matches(self, pair: Names) -> Indices:
        """The matches of a pair, keypoints (n, 2). Raises DataError where there are no such keypoints."""
        counts = [len(self.image(name).points) for name in pair]
        first, second, _ = predictions.read_matches(self._matches[self._keys[pair]], counts)
        return np.stack([first, second], -1)

    def write(self, geometries: Iterable[tuple[Names, PairGeometry]]) -> None:
        with replacing(self._output) as temporary, h5.imported().File(temporary, "w") as file:
            for pair, geometry in geometries:
                group = file.create_group(self._keys[pair])
                second = np.full(len(self.image(pair[0]).points), predictions.NO_MATCH, np.int32)
                second[geometry.inliers[:, 0]] = geometry.inliers[:, 1]
                group["matches0"] = second
                key = f"{self._keys[pair]}/matching_scores0"
                if h5.holds(self._matches, key):
                    scores = h5.numbers(self._matches, key, None)
                    group["matching_scores0"] = np.where(second == predictions.NO_MATCH, 0, scores).astype(np.float32)
                group.attrs.update({**geometry.texts, **geometry.matrices})

    def _named(self, key: str) -> Names:
        """The names of a pair's images; of an image without features that in the key."""
        first, _, second = key.rpartition("/")
        if not first:  # an older hloc joins names by _, which may also stand in them
            ends = ((key[:i], key[i + 1 :]) for i, sign in enumerate(key) if sign == "_")
            first, second = next((both for both in ends if self._stored.keys() >= set(both)), (first, second))
        return self._stored.get(first, first), self._stored.get(second, second)

    def _image(self, name: str) -> DatabaseImage:
        points = h5.numbers(self._features, f"{name}/keypoints", None, 2).astype(np.float32)
        size = predictions.size_under(self._features, f"{name}/image_size")
        return DatabaseImage(name, -1, size, np.eye(3), np.inf, points, points)


NPZ = ".npz"
SUFFIXES = (NPZ, *h5.SUFFIXES)

Ids = tuple[str, str]  # keys of the points of both images, which end in x0 and x1


class ArrayFile(NamedTuple):
    """The keys of a file's arrays, such as ``a/x0``, and what reads one, or raises DataError."""

    keys: list[str]
    read: Callable[[str], Array]


class MatchFile(_OpenFiles):
    """The pairs of one file; each has matches of its own. output: the file of geometries that is written.
    A file holds ``x0, x1`` (n, 2), pixels with (0, 0) at the centre of the first one, and perhaps ``K0, K1`` (3, 3) and
    ``size0, size1`` (h, w): of one pair, or of each pair below a name of its own (``a/x0``; in HDF5 a group). Raises
    DataError where the file is of another kind or holds no such pair."""

    def __init__(self, path: Path, output: Path) -> None:
        super().__init__((path,), output)
        with contextlib.ExitStack() as stack:
            self._file = stack.enter_context(_arrays(path))
            self._keys = set(self._file.keys)
            self._pairs = sorted({key[:-2] for key in self._keys if key.rpartition("/")[2] in ("x0", "x1")})
            if not any({f"{pair}x0", f"{pair}x1"} <= self._keys for pair in self._pairs):
                wanted = "matches x0, x1 (n, 2), alone or of each pair in a group, or hloc's features=F.h5 as well"
                raise DataError(f"{path} holds no x0 and x1; give {wanted}")
            self._open = stack.pop_all()

    def pairs(self) -> list[Ids]:
        return [(f"{pair}x0", f"{pair}x1") for pair in self._pairs]

    def finished(self) -> int:
        """How many pairs the output has, if it has all of them; else 0."""
        with _arrays(self._output) as written:
            keys = set(written.keys)
        return len(self._pairs) if all(f"{pair}inliers" in keys for pair in self._pairs) else 0

    def matches(self, pair: Ids) -> Indices:
        """Point i with point i. Raises DataError where x0 and x1 have different lengths."""
        counts = [len(self.image(side).points) for side in pair]
        if counts[0] != counts[1]:
            raise DataError(f"x0 has {counts[0]} points and x1 has {counts[1]}; they must have as many")
        return np.repeat(np.arange(counts[0])[:, None], 2, 1)

    def write(self, geometries: Iterable[tuple[Ids, PairGeometry]]) -> None:
        """Write the file: which matches are inliers, configuration, reason, warning and matrices."""
        with replacing(self._output) as temporary:
            entries = (self._entries(*pair) for pair in geometries)
            (_write_npz if self._output.suffix == NPZ else _write_h5)(temporary, entries)

    def _entries(self, ids: Ids, geometry: PairGeometry) -> dict[str, Array]:
        pair = ids[0].removesuffix("x0")
        inliers = np.zeros(len(self.image(ids[0]).points), bool)
        inliers[geometry.inliers[:, 0]] = True
        matrices = {f"{pair}{name}": value for name, value in geometry.matrices.items()}
        texts = {f"{pair}{name}": np.array(value) for name, value in geometry.texts.items()}
        return {f"{pair}inliers": inliers, **texts, **matrices}

    def _image(self, image_id: str) -> DatabaseImage:
        pair, i = image_id[:-2], int(image_id[-1])
        points = self._numbers(image_id, (None, 2)).astype(np.float32)
        wanted = ((f"{pair}K{i}", (3, 3)), (f"{pair}size{i}", (2,)))
        K, size = (self._numbers(key, shape) if key in self._keys else None for key, shape in wanted)
        if size is not None and not (np.isfinite(size).all() and (size >= 1).all()):
            raise DataError(f"size{i} is {size.tolist()}; it must be the height and width of the image")
        known = None if size is None else (int(size[0]), int(size[1]))
        return DatabaseImage(image_id, i, known, K, np.inf if K is None else 0.0, points, points)

    def _numbers(self, key: str, shape: tuple[int | None, ...]) -> Matrix:
        if key not in self._keys:
            raise DataError(f"{key} is missing; a pair has x0 and x1")
        values = self._file.read(key)
        if values.dtype.kind not in "fiu":
            raise DataError(f"{key} is of {values.dtype}; it must hold real numbers")
        if not h5.fits(values, shape):
            wanted = ", ".join("n" if n is None else str(n) for n in shape)
            raise DataError(f"{key} has shape {values.shape}; it must be ({wanted})")
        return values.astype(np.float64)


def expect_suffix(name: str, path: Path) -> None:
    """Raise ValueError where a file of matches ends otherwise than in .npz, .h5 or .hdf5."""
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{name}={path} must end in {', '.join(SUFFIXES)}")


@contextlib.contextmanager
def _arrays(path: Path) -> Iterator[ArrayFile]:
    if path.suffix != NPZ:
        with h5.opened(path) as file:
            yield ArrayFile(h5.keys(file, deep=True), functools.partial(h5.array, file))
        return
    try:
        npz = np.load(path)
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise DataError(f"{path}: is not a valid npz file; write it by numpy.savez") from error
    if not isinstance(npz, np.lib.npyio.NpzFile):
        raise DataError(f"{path}: is a single array; write x0 and x1 by numpy.savez")

    def read(key: str) -> Array:
        try:
            return np.asarray(npz[key])
        except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
            raise DataError(f"{key} cannot be read ({str(error).partition(chr(10))[0]})") from error

    with npz:
        yield ArrayFile(list(npz.files), read)


def _write_npz(path: Path, pairs: Iterable[Mapping[str, Array]]) -> None:
    """As `numpy.savez` writes it, with one pair in memory."""
    with zipfile.ZipFile(path, "w") as archive:
        for entries in pairs:
            for key, value in entries.items():
                with archive.open(f"{key}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asarray(value), allow_pickle=False)


def _write_h5(path: Path, pairs: Iterable[Mapping[str, Array]]) -> None:
    """`inliers` as a data set of each pair's group, the others as its attributes."""
    with h5.imported().File(path, "w") as file:
        for entries in pairs:
            for key, value in entries.items():
                pair, _, name = key.rpartition("/")
                group = file.require_group(pair or "/")
                if name == "inliers":
                    group[name] = value
                else:
                    group.attrs[name] = value if name in MATRICES else str(value)
