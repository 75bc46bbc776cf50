"""Which stored image or pair is which of a data set: others name images by their path, or by its end."""

from __future__ import annotations

from collections.abc import Iterator

from fmtorch.data.pairs import ImagePair, ImageSource

DEPTH = 4  # parts of a path that a name may hold


def names_of(image: ImageSource) -> list[str]:
    """Under what names others may know an image, the most telling first.

    Its identity, then ever shorter ends of its path; each with the suffix and without.
    """
    suffix = image.path.suffix
    ends = ["/".join(image.path.parts[-n:]) for n in range(min(DEPTH, len(image.path.parts)), 0, -1)]
    names = [name for end in ends for name in (end, end.removesuffix(suffix))]
    return list(dict.fromkeys([image.identity + suffix, image.identity, *names]))


def pair_keys(pair: ImagePair) -> Iterator[tuple[str, bool]]:
    """Under what keys others may have stored a pair, and whether its images are then in the other order.

    ``a/b``, as hloc and glue-factory write it with hyphens for slashes within names, and ``a_b``.
    """
    for swapped in (False, True):
        image, other = (pair.image1, pair.image0) if swapped else (pair.image0, pair.image1)
        for a, b in zip(names_of(image), names_of(other), strict=False):
            for key in _keys(a, b):
                yield key, swapped


def hloc_keys(name0: str, name1: str) -> Iterator[tuple[str, bool]]:
    """The keys of hloc's matches of two images of these names, and whether the images are in the other order."""
    for swapped, (a, b) in ((False, (name0, name1)), (True, (name1, name0))):
        for key in _keys(a, b):
            yield key, swapped


def pair_key_of(name0: str, name1: str) -> str:
    """hloc's key of a pair."""
    return next(_keys(name0, name1))


def _keys(name0: str, name1: str) -> Iterator[str]:
    a, b = name0.replace("/", "-"), name1.replace("/", "-")
    yield f"{a}/{b}"
    yield f"{a}_{b}"
