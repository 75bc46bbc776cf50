"""`OANetPairs`: labelled matches of files of OANet's layout, of which a pair is read when it is asked for."""

import functools
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.core.types import Correspondences, pair_key
from fmtorch.data import DataError, ImagePair, PairDataset
from fmtorch.data.cameras import Camera, fundamental, line_distance
from fmtorch.data.files import Matrix
from fmtorch.io import h5, oanet, predictions
from fmtorch.training import labelled
from fmtorch.training.stored_matches import ARRAYS, Shard, StoredMatches

MAX_CAMERAS = 1 << 16  # pairs of a file whose cameras are kept once they were read, about a kilobyte each


class OANetShard(Shard):
    """A file of OANet's layout in the place of a shard."""

    def __init__(self, path: Path, labels: labelled.Rule, family: str) -> None:
        self.path, self.labels, self.family = path, labels, family
        self._access = oanet.RandomAccess(path)
        self._keys = oanet.keys(self._access.file)
        self._geometry = functools.lru_cache(MAX_CAMERAS)(functools.partial(_geometry, self._access))

    def __len__(self) -> int:
        return len(self._keys)

    def index(self) -> dict[str, list[Any]]:
        """As of `Shard`, without the counts of inliers and outliers, for which all would have to be read."""
        group, count, scene = self._access.file["xs"], len(self), self.path.stem
        identities = [f"{scene}/{key}" for key in self._keys]
        matches = [h5.shape(group, key)[-2:][0] for key in self._keys]
        reasons = ["" if n else f"{self.path}: 'xs/{key}' is empty" for n, key in zip(matches, self._keys, strict=True)]
        return {
            "key": [pair_key(identity) for identity in identities], "identity": identities,
            "family": [self.family] * count, "scene": [scene] * count, "reason": reasons, "matches": matches,
        }  # fmt: skip

    def read(self, row: int, names: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
        """The arrays of a pair; of these names alone, where that saves time.
        Raises DataError, naming file and key, for what is missing or damaged."""
        file, key = self._access.file, self._keys[row]
        if names and self.labels == "geodesic":
            label = self._geodesic(key, h5.shape(file["xs"], key)[-2:][0])
            ratio = oanet.figures(file, "ratios", key, len(label))
            return {"label": label} if ratio is None else {"label": label, "ratio": ratio.astype(np.float32)}
        cameras, F = self._geometry(key)
        (K0, K1), (size0, size1) = cameras.K, (np.array(size) for size in cameras.sizes)
        x0, x1, ratio, mutual = oanet.arrays(file, key, cameras)
        by_pixels = self.labels == "pixels"
        label = labelled.by_line(line_distance(F, x0, x1)) if by_pixels else self._geodesic(key, len(x0))
        values = {"x0": x0, "x1": x1, "ratio": ratio, "mutual": mutual, "label": label}
        known = {name: x.astype(ARRAYS[name][0]) for name, x in values.items() if x is not None}
        if not (np.isfinite(x0).all() and np.isfinite(x1).all()):
            inside = np.isfinite(x0).all(1) & np.isfinite(x1).all(1)
            known = {name: x[inside] for name, x in known.items()}
        return {**known, "F": F, "K0": K0, "K1": K1, "size0": size0, "size1": size1}

    def _geodesic(self, key: str, count: int) -> labelled.Labels:
        distance = oanet.figures(self._access.file, "ys", key, count)
        if distance is None:
            raise DataError(f"{self.path}: 'ys' is missing, which labels=geodesic needs; give labels=pixels")
        return labelled.by_geodesic(distance)


def _geometry(access: oanet.RandomAccess, key: str) -> tuple[oanet.Cameras, Matrix]:
    """The cameras of a pair and its F. Nine small entries take longer to read than the matches."""
    cameras = oanet.cameras(access.file, key)
    if not cameras.t.any():
        raise DataError(f"{access.path}: 'ts/{key}' is zero, which leaves no F")
    K0, K1 = cameras.K
    return cameras, fundamental(Camera(K0, np.eye(3), np.zeros(3)), Camera(K1, cameras.R, cameras.t))


class OANetPairs(StoredMatches):
    """The labelled matches of files of OANet's layout; each item is a batch of one pair, as of `StoredMatches`.

    A file is opened by each process for itself, and a pair is read when it is asked for. `pairs` says nothing of how
    many inliers there are. Coordinates are pixels: networks and losses with coordinates=K have the file's own.

    Args:
        root: a file, or a folder of some; each is a scene.
        labels: geodesic: a match is an inlier where the first column of ``ys`` is below 1e-4 (OANet); pixels: by its
            distance to the epipolar lines, as of `MatchedPairs`.
        before: pruners whose matches alone are given, each a function of correspondences.
        augmentation, seed: as of `StoredMatches`.

    Raises DataError, naming the file, for a file that is missing, damaged, empty or of another layout.
    """

    def __init__(
        self, root: str | Path, *, labels: labelled.Rule = "geodesic",
        augmentation: labelled.Augmentation | None = None, seed: int = 0,
        before: Sequence[Callable[[Correspondences], Correspondences]] = (),
    ) -> None:  # fmt: skip
        self.folder = Path(root).expanduser().resolve()
        self.labels, self.before = labels, list(before)
        self._read_index(h5.files(self.folder), augmentation, seed)
        if not self.pairs:
            raise DataError(f"{self.folder}: holds no pairs")

    def expect_ratios(self, remedy: str) -> None:
        """Raises DataError, naming the file, where one has no ratios."""
        for path in self._paths:
            with h5.opened(path) as file:
                if not h5.holds(file, "ratios"):
                    raise DataError(f"{path}: 'ratios' is missing; {remedy}")

    def _reader(self, path: Path) -> Shard:
        oanet_file = path.suffix in h5.SUFFIXES  # or a shard of a data set that was joined
        return OANetShard(path, self.labels, self.folder.stem) if oanet_file else super()._reader(path)

    @functools.cached_property
    def _contents(self) -> bytes:
        digest = hashlib.blake2b(f"{self.labels} {labelled.VERSION}".encode(), digest_size=16)
        for path in self._paths:
            h5.add_to_digest(digest, path)
        return digest.digest()

    @property
    def digest(self) -> str:
        """Of the files, the labels and which pairs there are."""
        keys = np.array([about["key"] for about in self.pairs]).tobytes()
        return hashlib.blake2b(self._contents + keys, digest_size=16).hexdigest()

    def stored(self, index: int) -> labelled.LabelledMatches:
        matches = super().stored(index)
        if not self.before:
            return matches
        c = matches.correspondences
        for pruner in self.before:
            c = pruner(c)
        return matches.replace(correspondences=c).compact()


class NamedPairs(PairDataset):
    """The pairs of `OANetPairs` by their names, without geometry."""

    name = "h5"

    def __init__(self, matches: OANetPairs) -> None:
        self.matches, self.digest = matches, matches.digest

    def __len__(self) -> int:
        return len(self.matches)

    def __getitem__(self, index: int) -> ImagePair:
        about = self.matches.pairs[index]
        image = predictions.image(about["family"], about["scene"], about["identity"], None)
        return ImagePair(about["identity"], about["family"], about["scene"], image, image, np.zeros((3, 3)))


def write_oanet(matches: StoredMatches, pairs: Iterable[ImagePair], folder: Path) -> list[Path]:
    """Write the matches of pairs of known cameras into a folder, a file of OANet's layout for each scene; the files."""
    cameras = {pair.key: pair for pair in pairs}
    scenes: dict[str, list[int]] = {}
    for i, about in enumerate(matches.pairs):
        scenes.setdefault(about["scene"], []).append(i)
    paths = [folder / f"{name.replace('/', '-')}.hdf5" for name in scenes]
    for path, members in zip(paths, scenes.values(), strict=True):
        oanet.write(path, (_entry(matches.stored(i), cameras[matches.pairs[i]["key"]]) for i in members))
    return paths


def _entry(matches: labelled.LabelledMatches, pair: ImagePair) -> Mapping[str, NDArray[Any] | None]:
    c = matches.correspondences
    ratios, mutuals = (None if values is None else values[0].numpy() for values in (c.ratio, c.mutual))
    x0, x1 = (x[0].numpy().astype(np.float64) for x in (c.x0, c.x1))
    if c.size0 is None or c.size1 is None or pair.K0 is None or pair.K1 is None or pair.R is None or pair.t is None:
        raise ValueError(f"OANet's layout needs cameras and image sizes, which pair {pair.identity} does not have")
    (h0, w0), (h1, w1) = c.size0[0].tolist(), c.size1[0].tolist()
    cameras = oanet.Cameras((pair.K0, pair.K1), pair.R, pair.t, ((h0, w0), (h1, w1)))
    return oanet.entry(cameras, x0, x1, ratios, mutuals)
