"""A journal in memory: what a worker found for an export, to be written by the one that asked."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from fmtorch.io.match_store import MatchStore, StoredImage, StoredPair


@dataclasses.dataclass(frozen=True)
class CollectedMatches(MatchStore):
    """Images and pairs by their paths, which are below `start` where they are relative; nothing is read or written."""

    start: Path = dataclasses.field(default_factory=Path.cwd)
    images: dict[Path, StoredImage] = dataclasses.field(default_factory=dict)
    pairs: dict[tuple[Path, Path], StoredPair] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, journal: MatchStore) -> CollectedMatches:
        """An empty one for the images of a journal."""
        return cls(journal.folder, journal.root.absolute())

    def name(self, image: Path) -> str:
        """Under what name an image is exported."""
        return (self.start / image).relative_to(self.root).as_posix()

    def has_image(self, image: Path) -> bool:
        """Whether an image has been added."""
        return image in self.images

    def has_pair(self, image0: Path, image1: Path) -> bool:
        """Whether a pair has been added."""
        return (image0, image1) in self.pairs

    def add_image(self, image: Path, value: StoredImage) -> None:
        """Add an image."""
        self.images[image] = value

    def image(self, image: Path) -> StoredImage:
        """An image that was added."""
        return self.images[image]

    def add_pair(self, image0: Path, image1: Path, value: StoredPair) -> None:
        """Add a pair."""
        self.pairs[image0, image1] = value

    def pair(self, image0: Path, image1: Path) -> StoredPair:
        """A pair that was added."""
        return self.pairs[image0, image1]

    def write(self, journal: MatchStore) -> None:
        """Add all of it to a journal that does not have it; a pair after its images."""
        for image, value in self.images.items():
            if not journal.has_image(image):
                journal.add_image(image, value)
        for ends, pair in self.pairs.items():
            if not journal.has_pair(*ends):
                journal.add_pair(*ends, pair)
