import csv
import itertools
import json
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from fmtorch.evaluation.curves import MAX_THUMBNAILS, spectral_order, view_graph_svg
from fmtorch.io import Edge, MatchStore, StoredPair, ViewGraph, view_graph, write_view_graph

SVG = "{http://www.w3.org/2000/svg}"


def edge(image0: str, image1: str, inliers: int = 50, related: bool = True) -> Edge:
    return Edge(image0, image1, 2 * inliers, inliers, 3.5 if related else None, related, "")


def test_of_a_journal(tmp_path: Path) -> None:
    images = [tmp_path / name for name in ("a.png", "b.png", "c.png")]
    for image in images:
        image.write_text(image.name)
    journal = MatchStore(tmp_path / "export", tmp_path)
    matches, scores, inliers = np.zeros((3, 2), np.int32), np.ones(3, np.float32), np.array([True, True, False])
    verdict = {"significance": 12.5, "pair_type": "planar"}
    given = StoredPair("a.png", "b.png", matches, scores, inliers, np.eye(3), **verdict)
    journal.add_pair(*images[:2], given)
    journal.add_pair(images[0], images[2], StoredPair(
        "a.png", "c.png", matches, scores, ~inliers, np.zeros((3, 3)), False, significance=-math.inf))  # fmt: skip
    pairs = [(images[0], images[1]), (images[0], images[2]), (images[1], images[2])]
    graph = view_graph(journal, images, pairs)
    assert graph.images == ("a.png", "b.png", "c.png")
    assert graph.edges == (
        Edge("a.png", "b.png", 3, 2, 12.5, True, "planar"), Edge("a.png", "c.png", 3, 1, None, False, ""),
    )  # fmt: skip
    assert write_view_graph(graph, tmp_path) == ["graph.json", "graph.csv"]
    content = json.loads((tmp_path / "graph.json").read_text())
    assert content["components"] == [["a.png", "b.png"], ["c.png"]]
    assert content["pairs"][0]["pair_type"] == "planar"
    with (tmp_path / "graph.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["image1"], row["inliers"], row["significance"]) for row in rows] == [
        ("b.png", "2", "12.5"), ("c.png", "1", ""),
    ]  # fmt: skip


def test_components_are_those_that_related_pairs_connect() -> None:
    edges = (edge("b", "d"), edge("d", "e"), edge("a", "b", related=False), edge("c", "f"))
    graph = ViewGraph(tuple("abcdefg"), edges)
    assert graph.components() == [["b", "d", "e"], ["c", "f"], ["a"], ["g"]]


def test_a_walk_is_laid_out_as_it_was_walked() -> None:
    walk = [f"{i:02d}" for i in range(12)]
    shuffled = [walk[i] for i in np.random.default_rng(0).permutation(12)]
    order = spectral_order(shuffled, [edge(a, b) for a, b in itertools.pairwise(walk)])
    assert order in (walk, walk[::-1])
    assert spectral_order(["b", "a"], []) == ["b", "a"]


@pytest.mark.parametrize("count", [1, 3, MAX_THUMBNAILS + 1, 200])
def test_a_picture_of_any_number_of_images(count: int) -> None:
    names = tuple(f"folder/<{i}>&.jpg" for i in range(count))
    edges = tuple(edge(a, b, inliers=10 * i + 1) for i, (a, b) in enumerate(itertools.pairwise(names)))
    unrelated = (edge(names[0], names[-1], related=False),)
    asked = []

    def read(name: str) -> np.ndarray | None:
        asked.append(name)
        return np.full((30, 40, 3) if len(asked) % 2 else (40, 30), 90, np.uint8) if len(asked) != 2 else None

    root = ElementTree.fromstring(view_graph_svg(ViewGraph(names, edges + unrelated), read))
    lines = root.findall(f"{SVG}line")
    assert len(lines) == count - 1
    widths = [float(line.get("stroke-width", "nan")) for line in lines]
    assert widths == sorted(widths)
    shown = count if count <= MAX_THUMBNAILS else 0
    assert len(asked) == shown
    assert len(root.findall(f"{SVG}g/{SVG}image")) == max(shown - (shown > 1), 0)
    titles = [title.text for title in root.iter(f"{SVG}title")]
    assert all(name in titles for name in names)
    for node in root.findall(f"{SVG}circle"):
        assert 0 < float(node.get("cx", "nan")) < 900
        assert 0 < float(node.get("cy", "nan")) < 900
