"""A folder of images: which pairs of them to match, and the work that can be resumed."""

from __future__ import annotations

import itertools
import json
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from fmtorch.core.files import replacing
from fmtorch.core.threads import available, one_thread
from fmtorch.pipeline.exporting import keep_described, keep_match
from fmtorch.pipeline.photograph_cameras import PhotographCameras
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.pipeline.two_images import Described, describe, relate
from fmtorch.storage.exchange.journal import Journal
from fmtorch.storage.runs import canonical

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
EXHAUSTIVE = "exhaustive"
MEMORY = 64  # images whose features are kept for pairs to come
MAX_THREADS = 8  # that describe images: each holds an image and its scale space


def images_below(folder: Path) -> list[Path]:
    """The images of a folder, at any depth, by name. Raises ValueError where there are fewer than two."""
    if not folder.is_dir():
        raise ValueError(f"images={folder} is no folder")
    images = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    if len(images) < 2:
        raise ValueError(f"images={folder} holds {len(images)} images ({', '.join(SUFFIXES)}); a pair needs two")
    return images


def chosen_pairs(folder: Path, images: Sequence[Path], pairs: Path | None) -> list[tuple[Path, Path]]:
    """All pairs of the images, or those of a file with the names of two images a line, below the folder.

    An empty line and one that begins with # is left out, and a pair that stands there again. Raises ValueError naming
    file and line for what is no pair.
    """
    if pairs is None or str(pairs) == EXHAUSTIVE:
        return list(itertools.combinations(images, 2))
    if not pairs.is_file():
        raise ValueError(f"pairs={pairs}: no such file; it must be {EXHAUSTIVE}, or a file with two names a line")
    known = {path.relative_to(folder).as_posix(): path for path in images}
    selected: dict[frozenset[Path], tuple[Path, Path]] = {}
    for number, line in enumerate(pairs.read_text(encoding="utf-8").splitlines(), start=1):
        names = line.split()
        if not names or names[0].startswith("#"):
            continue
        where = f"{pairs}, line {number}"
        if len(names) != 2 or names[0] == names[1]:
            raise ValueError(f"{where}: {line.strip()!r}; it must be the names of two images")
        missing = [name for name in names if name not in known]
        if missing:
            raise ValueError(f"{where}: no image {missing[0]} in {folder}")
        pair = known[names[0]], known[names[1]]
        selected.setdefault(frozenset(pair), pair)
    if not selected:
        raise ValueError(f"{pairs} names no pair")
    return list(selected.values())


def open_folder(output: Path, identity: Mapping[str, Any]) -> Path:
    """The folder for what is found of pairs, in `output`; the identity is kept beside it.

    Raises ValueError where the output holds results of another identity.
    """
    output.mkdir(parents=True, exist_ok=True)
    file = output / "export.json"
    wanted = json.loads(canonical(identity))
    if file.exists():
        try:
            stored = json.loads(file.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{file} is not valid JSON ({error}); delete {output} and run again") from error
        if stored != wanted:
            differing = [key for key in {**stored, **wanted} if stored.get(key) != wanted.get(key)]
            raise ValueError(
                f"{output} holds matches of other settings ({', '.join(sorted(differing))} differ); "
                "choose another output, or delete the folder"
            )
    else:
        with replacing(file) as temporary:
            temporary.write_text(json.dumps(wanted, indent=2) + "\n", encoding="utf-8")
    return output / "export"


class FolderMatches:
    """Matches pairs of images one after another, into a journal; what it has already is taken from there.

    done, taken, related: pairs matched now, taken from the journal, and of either those that show one scene. troubles:
    what went wrong with images or pairs, which are tried again the next time.
    """

    def __init__(
        self, pipeline: Pipeline, journal: Journal, longest_side: int, orient: bool, seed: int,
        cameras: PhotographCameras | None = None,
    ) -> None:  # fmt: skip
        self.pipeline, self.journal, self.cameras = pipeline, journal, cameras or PhotographCameras()
        self.longest_side, self.orient, self.seed = longest_side, orient, seed
        self.done = self.taken = self.related = 0
        self.troubles: list[str] = []
        self._described: OrderedDict[Path, Described | None] = OrderedDict()
        self._begun: dict[Path, Future[Described]] = {}

    def each(self, pairs: Sequence[tuple[Path, Path]]) -> Iterator[None]:
        """Match the pairs, and yield after each; on a CPU images are described ahead, as many at a time as threads."""
        threads = min(available(), MAX_THREADS) if self.pipeline.device.type == "cpu" else 1
        if threads == 1:
            for pair in pairs:
                self.match(*pair)
                yield
            return
        ahead = self._images_ahead(pairs)
        with ThreadPoolExecutor(threads) as pool:
            try:
                for pair in pairs:
                    for image in itertools.islice(ahead, threads + 1 - len(self._begun)):
                        self._begun[image] = pool.submit(self._computed_alone, image)
                    self.match(*pair)
                    yield
            finally:
                pool.shutdown(wait=True, cancel_futures=True)

    def match(self, image0: Path, image1: Path) -> None:
        """Match one pair."""
        if self.journal.has_pair(image0, image1):
            self.taken += 1
        else:
            ends = self._describe(image0), self._describe(image1)
            if ends[0] is None or ends[1] is None:
                return
            try:
                known = self.cameras.given((image0, image1), (ends[0].size, ends[1].size))
                result = relate(self.pipeline, ends[0], ends[1], self.seed, **known)
                keep_match(self.journal, (image0, image1), result)
            except Exception as error:  # one pair does not end the work on the others
                names = f"{self.journal.name(image0)}, {self.journal.name(image1)}"
                self.troubles.append(f"{names}: {type(error).__name__}: {error}".splitlines()[0])
                return
            self.done += 1
        self.related += self.journal.pair(image0, image1).related

    def _describe(self, image: Path) -> Described | None:
        """An image's features, which the journal then has too; None where it cannot be read, which is said once."""
        if image not in self._described:
            begun = self._begun.pop(image, None)
            try:
                value: Described | None = self._computed(image) if begun is None else begun.result()
                assert value is not None
                if not self.journal.has_image(image):
                    keep_described(self.journal, image, value, self.cameras.of(image, value.size))
            except Exception as error:  # nor does one image
                self.troubles.append(f"{type(error).__name__}: {error}".splitlines()[0])
                value = None
            self._described[image] = value
        self._described.move_to_end(image)
        while len(self._described) > MEMORY:
            self._described.popitem(last=False)
        return self._described[image]

    def _images_ahead(self, pairs: Sequence[tuple[Path, Path]]) -> Iterator[Path]:
        """The images of pairs that are to be matched, each once, in the order in which they are needed."""
        seen: set[Path] = set()
        for pair in pairs:
            if not self.journal.has_pair(*pair):
                for image in pair:
                    if image not in seen:
                        seen.add(image)
                        yield image

    def _computed(self, image: Path) -> Described:
        return describe(self.pipeline, self.cameras.read(image, self.orient), self.longest_side)

    def _computed_alone(self, image: Path) -> Described:
        with one_thread(self.pipeline.device):
            return self._computed(image)
