"""Losses and figures of patch descriptors and GeoDesc (Luo et al., ECCV 2018, arXiv 1807.06294), one pair at a time."""

import math
from collections.abc import Mapping, Sequence

Vector = Sequence[float]
Vectors = Sequence[Sequence[float]]


def dot(a: Vector, b: Vector) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def angle(a: Vector, b: Vector) -> float:
    """Between two directions, in degrees."""
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

    shown: S_patch of each two patches that match, named (view, point) as one integer: 1000 view + point.
    """
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


def distance(a: Sequence[float], b: Sequence[float]) -> float:
    return math.sqrt(sum((x - y) ** 2 for x, y in zip(a, b, strict=True)))


def hardest_triplet(a: Vectors, b: Vectors, margin: float, squared: bool) -> float:
    """Mishchuk et al., NIPS 2017, section 3.1: the hardest negative of a_i among b and of b_i among a."""
    total, n = 0.0, len(a)
    for i in range(n):
        negatives = [distance(a[i], b[j]) for j in range(n) if j != i] + [
            distance(a[j], b[i]) for j in range(n) if j != i
        ]
        hinge = max(0.0, margin + distance(a[i], b[i]) - min(d for d in negatives if d >= 0.008))
        total += hinge**2 if squared else hinge
    return total / n


def relative_distance(a: Vectors, b: Vectors, compactness: float) -> float:
    """Tian, Fan, Wu, CVPR 2017, eq. 3 to 5 and 8 to 9 (by the number of pairs and of dimensions)."""
    n, total = len(a), 0.0
    s = [[math.exp(2 - distance(a[i], b[j])) for j in range(n)] for i in range(n)]
    for i in range(n):
        total -= math.log(s[i][i] / sum(s[i])) / 2 + math.log(s[i][i] / sum(row[i] for row in s)) / 2
    return total / n + compactness * (_correlation(a) + _correlation(b)) / 2


def _correlation(x: Vectors) -> float:
    columns = list(zip(*x, strict=True))
    centred = [[v - sum(c) / len(c) for v in c] for c in columns]
    total = 0.0
    for i, c in enumerate(centred):
        for j, d in enumerate(centred):
            if i != j:
                r = sum(p * q for p, q in zip(c, d, strict=True))
                total += r * r / (sum(p * p for p in c) * sum(q * q for q in d))
    return total / 2 / len(columns)


def fpr_at_recall(positive: Sequence[float], negative: Sequence[float], recall: float) -> float:
    """The least threshold that accepts the share `recall` of the positives, and what it accepts of the negatives."""
    for threshold in sorted(positive):
        if sum(d <= threshold for d in positive) >= recall * len(positive) - 1e-9:
            return sum(d <= threshold for d in negative) / len(negative)
    raise ValueError("no positives")


def mean_average_precision(a: Vectors, b: Vectors) -> float:
    """Each a_i asks for b_i: one right answer, so its average precision is one over its rank (ties against it)."""
    total = 0.0
    for i in range(len(a)):
        total += 1 / sum(distance(a[i], other) <= distance(a[i], b[i]) for other in b)
    return total / len(a)
