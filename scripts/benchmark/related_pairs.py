"""Pairs of photographs of one scene, and of different scenes, that tell how well a verdict separates the two."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from unittest import mock

import numpy as np

from fmtorch.core.types import pair_key
from fmtorch.data import ImagePair, ImageSource, PairDataset
from fmtorch.scenes import textures
from fmtorch.scenes.dataset import RenderedPairs
from fmtorch.scenes.generate import build

UNRELATED = "unrelated"
"""What the names of families of pairs of different scenes begin with."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """The photographs of one scene, and the names of the photographs that its own surfaces show (rendered scenes)."""

    name: str
    images: tuple[ImageSource, ...]
    shows: frozenset[str]
    drawn: bool


def unrelated_pairs(pairs: Sequence[ImagePair], datasets: Sequence[PairDataset], most: int) -> list[ImagePair]:
    """Pairs of the photographs of different scenes, at most so many of each two scenes, chosen by hash.

    Args:
        pairs: related ones, whose photographs are taken. datasets: which they are from.
        most: pairs of each two scenes, each pair once, in one direction.

    Returns:
        The pairs, with an F of zeros. Rendered scenes are paired with each other where they show no photograph in
        common, and real ones with each other.
    """
    shown: dict[str, frozenset[str]] = {}
    for dataset in datasets:
        shown |= photographs_shown(dataset) if isinstance(dataset, RenderedPairs) else {}
    scenes = sorted(scenes_of(pairs, shown), key=lambda scene: scene.name)
    chosen = []
    for a, b in itertools.combinations(scenes, 2):
        if a.drawn != b.drawn or a.shows & b.shows:
            continue
        every = sorted((_pair(a, b, i, j) for i in a.images for j in b.images), key=lambda pair: pair.key)
        chosen += every[:most]
    return chosen


def _pair(a: Scene, b: Scene, image0: ImageSource, image1: ImageSource) -> ImagePair:
    family = f"{UNRELATED}, {'rendered' if a.drawn else 'real'}"
    identity = f"{a.name}/{image0.identity} | {b.name}/{image1.identity}"
    if pair_key(identity) % 2:  # either scene comes first in half of the pairs
        image0, image1 = image1, image0
    return ImagePair(identity, family, f"{a.name} | {b.name}", image0, image1, np.zeros((3, 3)))


def scenes_of(pairs: Sequence[ImagePair], shown: Mapping[str, frozenset[str]]) -> list[Scene]:
    """The scenes of these pairs; shown: what each rendered scene shows, by its name."""
    images: dict[tuple[str, str], dict[str, ImageSource]] = {}
    for pair in pairs:
        place = images.setdefault((pair.family, pair.scene), {})
        place.update({image.identity: image for image in (pair.image0, pair.image1)})
    return [
        Scene(f"{family}/{scene}", tuple(by_name[key] for key in sorted(by_name)), shown.get(scene, frozenset()),
              scene in shown)
        for (family, scene), by_name in images.items()
    ]  # fmt: skip


def photographs_shown(dataset: RenderedPairs) -> dict[str, frozenset[str]]:
    """The names of the photographs that each rendered scene is built with, whether they can be seen or not."""
    shown = {}
    for name, task in dataset._tasks.items():
        with mock.patch.object(textures, "photograph", wraps=textures.photograph) as taken:
            build(task)
        shown[name] = frozenset(str(call.args[0]) for call in taken.call_args_list)
    return shown


def in_order(pairs: Sequence[ImagePair]) -> list[ImagePair]:
    """The pairs, those that share images one after another."""
    return sorted(pairs, key=lambda pair: (pair.family, pair.scene, pair.image0.identity, pair.image1.identity))
