"""The view graph of a folder's images: which pairs were matched, and by how much they support one another."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path

from fmtorch.core.files import replacing
from fmtorch.storage.exchange.journal import Journal

GRAPH_JSON, GRAPH_CSV = "graph.json", "graph.csv"


@dataclasses.dataclass(frozen=True)
class Edge:
    """A pair. matches: those given to the estimator. significance: None where there is no F, or it was not computed."""

    image0: str
    image1: str
    matches: int
    inliers: int
    significance: float | None
    related: bool
    configuration: str


@dataclasses.dataclass(frozen=True)
class ViewGraph:
    """Names of images, in order, and the pairs that were matched; related ones connect their images."""

    images: tuple[str, ...]
    edges: tuple[Edge, ...]

    def components(self) -> list[list[str]]:
        """The images that related pairs connect, largest component first, each in the order of the images."""
        parent = {name: name for name in self.images}

        def root(name: str) -> str:
            while parent[name] != name:
                parent[name] = parent[parent[name]]
                name = parent[name]
            return name

        for edge in self.edges:
            if edge.related:
                parent[root(edge.image1)] = root(edge.image0)
        groups: dict[str, list[str]] = {}
        for name in self.images:
            groups.setdefault(root(name), []).append(name)
        return sorted(groups.values(), key=len, reverse=True)


def view_graph(journal: Journal, images: Sequence[Path], pairs: Sequence[tuple[Path, Path]]) -> ViewGraph:
    """The graph of what a journal has of these pairs, and of all these images."""
    edges = []
    for ends in pairs:
        if journal.has_pair(*ends):
            pair = journal.pair(*ends)
            significance = pair.significance if math.isfinite(pair.significance) else None
            counts = len(pair.matches), int(pair.inliers.sum())
            edges.append(Edge(pair.name0, pair.name1, *counts, significance, pair.related, pair.configuration))
    return ViewGraph(tuple(journal.name(image) for image in images), tuple(edges))


def write_view_graph(graph: ViewGraph, folder: Path) -> list[str]:
    """Write the graph as JSON, with its connected components, and its pairs as CSV; the names of the files."""
    pairs = [dataclasses.asdict(edge) for edge in graph.edges]
    content = {"images": graph.images, "components": graph.components(), "pairs": pairs}
    with replacing(folder / GRAPH_JSON) as path:
        path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    with replacing(folder / GRAPH_CSV) as path, path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in dataclasses.fields(Edge)])
        writer.writeheader()
        writer.writerows(pairs)
    return [GRAPH_JSON, GRAPH_CSV]
