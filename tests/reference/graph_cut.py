"""The labelling of Graph-Cut RANSAC by a maximum flow, and by looking at every labelling there is."""

import itertools

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

CAPACITY_UNIT = 2.0**-16  # capacities are rounded to multiples of it, because the flow is one of integers


def energy(labels: np.ndarray, kernel: np.ndarray, edges: list[tuple[int, int]], coherence: float) -> float:
    """E(L) of Barath & Matas (CVPR 2018), section 3, term by term; labels are 1 for inliers."""
    total = sum(1 - K if label else K for label, K in zip(labels, kernel, strict=True))
    for p, q in edges:
        mean = (kernel[p] + kernel[q]) / 2
        total += coherence * (1 if labels[p] != labels[q] else 1 - mean if labels[p] else mean)
    return float(total)


def least_by_enumeration(kernel: np.ndarray, edges: list[tuple[int, int]], coherence: float) -> float:
    """The least energy of all 2^n labellings."""
    labellings = itertools.product((0, 1), repeat=len(kernel))
    return min(energy(np.array(labels), kernel, edges, coherence) for labels in labellings)


def least_cut(kernel: np.ndarray, edges: list[tuple[int, int]], coherence: float) -> np.ndarray:
    """The labelling of least energy and fewest inliers: a least cut of a graph whose cuts cost what labellings cost.

    Terminals as Kolmogorov & Zabih (PAMI 2004) place them: a pair's cost [[A, B], [C, D]] is A + (C - A) L_p
    + (D - C) L_q + (B + C - A - D) (1 - L_p) L_q. Source: label 0; sink: label 1.
    """
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


def fixed_point(
    kernel: np.ndarray, edges: list[tuple[int, int]], coherence: float, label: int, sweeps: int
) -> np.ndarray:
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
