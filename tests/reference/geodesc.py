"""GeoDesc (Luo et al., ECCV 2018, arXiv 1807.06294) from its definitions: one match after the other."""

import math
from collections.abc import Mapping, Sequence

from numpy import dot

Vector = Sequence[float]
Vectors = Sequence[Sequence[float]]


def angle(a: Vector, b: Vector) -> float:
    cosine = dot(a, b) / math.sqrt(dot(a, a) * dot(b, b))
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def patch_similarity(point: Vector, normal: Vector, centre0: Vector, centre1: Vector) -> float:
    """Section 3.3: S_patch of a world point with its normal, seen from two camera centres."""
    to0, to1 = ([c - p for c, p in zip(centre, point, strict=True)] for centre in (centre0, centre1))
    intersection = angle(to0, to1)
    incidence = angle(to0, normal) - angle(to1, normal)
    return math.exp(-(intersection**2) / (2 * 15.0**2)) * math.exp(-(incidence**2) / (2 * 20.0**2))


def match_sets(
    shown: Mapping[tuple[int, int], float], matches: int, max_similarity: float
) -> dict[tuple[int, int], tuple[list[tuple[int, int]], float]]:
    """Sections 3.3 and 3.4: of each pair of views its matches, as patches, and S_image.
    shown: S_patch of each two patches that match, named (view, point) as one integer: 1000 view + point."""
    sets: dict[tuple[int, int], list[tuple[tuple[int, int], float]]] = {}
    for (a, b), similarity in shown.items():
        first, second = sorted((a, b), key=lambda patch: patch // 1000)
        sets.setdefault((first // 1000, second // 1000), []).append(((first, second), similarity))
    kept = {}
    for views, members in sets.items():
        image = sum(s for _, s in members) / len(members)
        if len(members) >= matches and image <= max_similarity:
            kept[views] = sorted(patches for patches, _ in members), image
    return kept


def structured(a: Vectors, b: Vectors, ratio: float) -> float:
    """E_1, section 3.5, of one match set."""
    n, total = len(a), 0.0
    s = [[dot(x, y) for y in b] for x in a]
    level = [[s[i][j] - (ratio * s[i][i] if i == j else 0.0) for j in range(n)] for i in range(n)]
    for i in range(n):
        for j in range(n):
            total += max(0.0, level[i][j] - level[i][i]) + max(0.0, level[i][j] - level[j][j])
    return total / (n * (n - 1))


def geometric(a: Vectors, b: Vectors, similarity: Vector) -> float:
    """E_2, section 3.5, by the number of matches."""
    total = 0.0
    for x, y, s in zip(a, b, similarity, strict=True):
        margin = 0.7 if s >= 0.5 else 0.5 if s >= 0.2 else 0.2
        total += max(0.0, margin - dot(x, y))
    return total / len(a)
