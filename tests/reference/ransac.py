"""Parts of RANSAC from the definitions: scores, samples, support, graph cuts; one draw or match at a time."""

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from tests.reference.refine import magsac_loss

Edges = list[tuple[int, int]]
REACH = 5  # scales, from which on the gain of Geman & McClure is zero
CAPACITY_UNIT = 2.0**-16  # capacities are rounded to multiples of it, because the flow is one of integers


def inlier(r: float) -> float:
    return 1.0 if r <= 1 else 0.0


def truncated_square(r: float) -> float:
    return 1 - r * r if r < 1 else 0.0


def geman_mcclure(r: float) -> float:
    """(1 / (1 + r^2) - e) / (1 - e), e the value at REACH scales; beyond it zero."""
    end = 1 / (1 + REACH**2)
    return (1 / (1 + r * r) - end) / (1 - end) if r < REACH else 0.0


def magsac(r: float) -> float:
    """1 - rho(r) / rho(k sigma_max) of MAGSAC++."""
    loss, max_loss = magsac_loss(np.array([min(r, 1.0) ** 2, 1.0]), 1.0)
    return float(1 - loss / max_loss)


def rounded(value: float, bits: int) -> float:
    return round(value * 2**bits) / 2**bits


def summed(gains: Sequence[float], weights: Sequence[float], bits: int) -> float:
    return sum(rounded(g * w, bits) for g, w in zip(gains, weights, strict=True))


def saturated(gains: Sequence[float], weights: Sequence[float], cells: np.ndarray, bits: int) -> float:
    """Over both images and their cells, given for each match (2, n), the sum of the root of its matches' `summed`."""
    total = 0.0
    for cell in cells:
        for occupied in set(cell.tolist()):
            members = [i for i in range(len(gains)) if cell[i] == occupied]
            total += rounded(math.sqrt(summed([gains[i] for i in members], [weights[i] for i in members], bits)), bits)
    return total


def lower_median(values: Sequence[float]) -> float:
    return sorted(values)[(len(values) + 1) // 2 - 1]


def draws_for_confidence(inlier_ratio: float, size: int, confidence: float) -> float:
    """How many samples until one is all inliers with this probability."""
    return math.log1p(-confidence) / math.log1p(-(inlier_ratio**size))


def weighted_sample(weights: Sequence[int], numbers: Sequence[int]) -> list[int]:
    """A match a number of 63 bits, each drawn by weight from those not drawn yet, which lie side by side on a line."""
    left, sample = list(range(len(weights))), []
    for number in numbers:
        position = (number >> 31) * sum(weights[i] for i in left) >> 32
        for i in left:
            if position < weights[i]:
                break
            position -= weights[i]
        left.remove(i)
        sample.append(i)
    return sample


def quantised(prior: Sequence[float], largest: int) -> list[int]:
    return [max(round(p * largest), 1) for p in prior]


def prosac_growth(total: int, size: int, draws: int) -> tuple[list[int], list[Fraction]]:
    """T'_n for n = 1 .. N, and what T_n grew by (Chum & Matas, CVPR 2005, equations 3 and 4); T_N: `draws`."""
    shares = ((Fraction(max(n - i, 0), total - i) for i in range(size)) for n in range(total + 1))
    T = [draws * math.prod(each, start=Fraction(1)) for each in shares]
    grown = [T[n] - T[n - 1] for n in range(1, total + 1)]
    table: list[int] = []
    for n in range(1, total + 1):
        table.append(0 if n < size else 1 if n == size else table[-1] + math.ceil(grown[n - 1]))
    return table, grown


def prosac_sample(table: Sequence[int], t: int, numbers: Sequence[int]) -> list[int]:
    """Ranks in the t-th sample, t from 1: m - 1 of those before the n-th, and that one, n the least with T'_n >= t."""
    n = next(n for n, last in enumerate(table, 1) if last >= t)
    return [*weighted_sample([1] * (n - 1), numbers), n - 1]


def priority_sample(prior: Sequence[float], numbers: Sequence[int], count: int) -> list[int]:
    """The matches of the greatest prior / (number + 1), ascending (Duffield, Lund & Thorup, J. ACM 2007)."""
    order = sorted(range(len(prior)), key=lambda i: -Fraction(prior[i]) / (numbers[i] + 1))
    return sorted(order[:count])


def shuffled(index: Sequence[int], numbers: Sequence[int], count: int) -> list[int]:
    return sorted(index, key=lambda i: numbers[i])[:count]


def degenerate_support(points: np.ndarray, minimal: int, rounding: float) -> str:
    """Why matches (n, 4) determine no model; empty where they may. rounding: of a coordinate, absolute."""
    different = np.unique(points, axis=0)
    if len(different) < minimal:
        return f"the best model has {len(different)} different inliers; at least {minimal} are needed"
    flat = [i for i in (0, 1) if on_line(different[:, 2 * i : 2 * i + 2], rounding)]
    if flat:
        return f"the inliers of the best model lie on one line in {' and '.join(f'image {i}' for i in flat)}"
    return ""


def on_line(x: np.ndarray, rounding: float) -> bool:
    """Whether points (n, 2) are no farther from their best line than rounding explains."""
    across, along = np.linalg.svd(x - x.mean(0), compute_uv=False)[::-1]
    return bool(across <= np.sqrt(len(x)) * max(4 * rounding, 2.0**-22 * along))


def energy(labels: np.ndarray, kernel: np.ndarray, edges: Edges, coherence: float) -> float:
    """E(L) of Barath & Matas (CVPR 2018), section 3, term by term; labels are 1 for inliers."""
    total = sum(1 - K if label else K for label, K in zip(labels, kernel, strict=True))
    for p, q in edges:
        mean = (kernel[p] + kernel[q]) / 2
        total += coherence * (1 if labels[p] != labels[q] else 1 - mean if labels[p] else mean)
    return float(total)


def least_cut(kernel: np.ndarray, edges: Edges, coherence: float) -> np.ndarray:
    """The labelling of least energy and fewest inliers: a least cut of a graph whose cuts cost what labellings cost.
    Terminals as Kolmogorov & Zabih (PAMI 2004) place them: a pair's cost [[A, B], [C, D]] is A + (C - A) L_p + (D - C)
    L_q + (B + C - A - D) (1 - L_p) L_q. Source: label 0; sink: label 1."""
    n = len(kernel)
    cost_of_one = 1 - 2 * np.asarray(kernel, dtype=np.float64)
    links = []
    for p, q in edges:
        A = coherence * (kernel[p] + kernel[q]) / 2
        B = C = coherence
        D = coherence * (1 - (kernel[p] + kernel[q]) / 2)
        cost_of_one[p] += C - A
        cost_of_one[q] += D - C
        links.append((p, q, B + C - A - D))  # cut where p is on the source's side (0) and q on the sink's (1)
    source, sink = n, n + 1
    for p, cost in enumerate(cost_of_one):
        links.append((source, p, cost) if cost > 0 else (p, sink, -cost))
    rows, columns, costs = zip(*links, strict=True)
    capacities = np.round(np.array(costs) / CAPACITY_UNIT).astype(np.int32)
    graph = coo_array((capacities, (rows, columns)), shape=(n + 2, n + 2)).tocsr()
    graph.sum_duplicates()
    residual = (graph - maximum_flow(graph, source, sink).flow).tocsr()
    residual.eliminate_zeros()
    labels = np.zeros(n, dtype=np.int64)
    reaching = breadth_first_order(residual.T.tocsr(), sink, return_predecessors=False)
    labels[reaching[reaching < n]] = 1
    return labels


def fixed_point(kernel: np.ndarray, edges: Edges, coherence: float, label: int, sweeps: int) -> np.ndarray:
    """Labels of one kind, then, all at once, the best given their neighbours', an outlier where both are as good."""
    n = len(kernel)
    labels = np.full(n, label)
    of = [[(p, q) for p, q in edges if i in (p, q)] for i in range(n)]
    for _ in range(sweeps):
        before = labels.copy()
        for i in range(n):
            costs = []
            for value in (0, 1):
                changed = before.copy()
                changed[i] = value
                others = sum(1 - kernel[j] if changed[j] else kernel[j] for j in range(n) if j != i)
                costs.append(energy(changed, kernel, of[i], coherence) - others)
            labels[i] = costs[1] < costs[0]
    return labels
