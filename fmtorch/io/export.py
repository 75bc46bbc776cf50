"""A journal's images and pairs as hloc's two files, and as a COLMAP database."""

import csv
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmtorch.core.files import replacing, write_whole
from fmtorch.io import colmap, h5, predictions
from fmtorch.io.match_store import MatchStore, StoredImage

KINDS = ("h5", "colmap")
FEATURES, MATCHES, DATABASE = "features.h5", "matches.h5", "database.db"


def export_kinds(value: str | Sequence[str] | None) -> tuple[str, ...]:
    """The kinds of a list, or of a text with commas. Raises ValueError naming those there are."""
    words = [word.strip() for word in value.split(",")] if isinstance(value, str) else list(value or ())
    unknown = [word for word in words if word not in KINDS]
    if unknown:
        raise ValueError(f"export={','.join(words)}: {unknown[0]!r} is none of {', '.join(KINDS)}")
    if "h5" in words:
        h5.imported()
    if "colmap" in words:
        colmap.imported()
    return tuple(dict.fromkeys(words))


def write_exports(
    journal: MatchStore, pairs: Sequence[tuple[Path, Path]], kinds: Iterable[str], folder: Path,
    shared_camera: bool = False,
) -> list[str]:  # fmt: skip
    """Write the files for the images of these pairs into a folder, whole or not at all; their names.
    shared_camera: in COLMAP's database, one camera for all images of one size whose calibration is unknown."""
    images = list(dict.fromkeys(image for pair in pairs for image in pair if journal.has_image(image)))
    done = [pair for pair in pairs if journal.has_pair(*pair)]
    written = []
    for kind in kinds:
        if kind == "h5":
            write_hloc(folder, (journal.image(i) for i in images), journal, done)
            written += [FEATURES, MATCHES]
        else:
            with replacing(folder / DATABASE) as temporary:
                values = (journal.pair(*pair) for pair in done)
                colmap.write_database(temporary, (journal.image(i) for i in images), values, shared_camera)
            written.append(DATABASE)
    return written


def write_hloc(
    folder: Path, images: Iterable[StoredImage], journal: MatchStore, pairs: Iterable[tuple[Path, Path]]
) -> None:
    """hloc's features and matches, float32 and int32.
    hloc itself writes float16 and int16, of which the second overflows beyond 32,767 keypoints. Each pair holds beside
    ``matches0`` and ``matching_scores0``, which hloc knows, ``inliers0`` (bool), and F, `related` and, where its
    geometry is known, `configuration`, E, H, R and t as attributes."""
    h5py = h5.imported()
    counts: dict[str, int] = {}
    with replacing(folder / FEATURES) as temporary, h5py.File(temporary, "w") as file:
        for image in images:
            counts[image.name] = len(image.points)
            group = file.create_group(image.name)
            group["keypoints"], group["scores"] = image.points, image.scores
            group["image_size"] = np.array(image.size[::-1])
    with replacing(folder / MATCHES) as temporary, h5py.File(temporary, "w") as file:
        for pair in (journal.pair(*ends) for ends in pairs):
            group = file.create_group(next(predictions.hloc_keys(pair.name0, pair.name1)))
            # By keypoint of the first image, which keeps the best of several: the last one written.
            count, order = counts[pair.name0], np.argsort(pair.scores, kind="stable")
            i, j = pair.matches[order].T
            for name, blank, values in (
                ("matches0", np.full(count, -1, np.int32), j),
                ("matching_scores0", np.zeros(count, np.float32), pair.scores[order]),
                ("inliers0", np.zeros(count, bool), pair.inliers[order]),
            ):
                blank[i] = values
                group[name] = blank
            group.attrs["F"], group.attrs["related"] = pair.F, pair.related
            if pair.geometry is not None:
                group.attrs.update({**pair.geometry.texts, **pair.geometry.matrices})


GRAPH_JSON, GRAPH_CSV = "graph.json", "graph.csv"


class Edge(NamedTuple):
    """A pair. matches: those given to the estimator. significance: None where there is no F, or it was not computed."""

    image0: str
    image1: str
    matches: int
    inliers: int
    significance: float | None
    related: bool
    pair_type: str


class ViewGraph(NamedTuple):
    """Names of images, in order, and the pairs that were matched; related ones connect their images."""

    images: tuple[str, ...]
    edges: tuple[Edge, ...]

    def components(self) -> list[list[str]]:
        """The images that related pairs connect, largest component first, each in the order of the images."""
        groups = {name: {name} for name in self.images}
        for edge in self.edges:
            smaller, larger = sorted((groups[edge.image0], groups[edge.image1]), key=len)
            if edge.related and smaller is not larger:
                larger |= smaller
                groups |= dict.fromkeys(smaller, larger)
        ordered: dict[int, list[str]] = {}
        for name in self.images:
            ordered.setdefault(id(groups[name]), []).append(name)
        return sorted(ordered.values(), key=len, reverse=True)


def view_graph(journal: MatchStore, images: Sequence[Path], pairs: Sequence[tuple[Path, Path]]) -> ViewGraph:
    """The graph of what a journal has of these pairs, and of all these images."""
    edges = []
    for ends in pairs:
        if journal.has_pair(*ends):
            pair = journal.pair(*ends)
            significance = pair.significance if math.isfinite(pair.significance) else None
            counts = len(pair.matches), int(pair.inliers.sum())
            edges.append(Edge(pair.name0, pair.name1, *counts, significance, pair.related, pair.pair_type))
    return ViewGraph(tuple(journal.name(image) for image in images), tuple(edges))


def write_view_graph(graph: ViewGraph, folder: Path) -> list[str]:
    """Write the graph as JSON, with its connected components, and its pairs as CSV; the names of the files."""
    pairs = [edge._asdict() for edge in graph.edges]
    content = {"images": graph.images, "components": graph.components(), "pairs": pairs}
    write_whole(folder / GRAPH_JSON, json.dumps(content, indent=1, allow_nan=False) + "\n")
    with replacing(folder / GRAPH_CSV) as path, path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, Edge._fields)
        writer.writeheader()
        writer.writerows(pairs)
    return [GRAPH_JSON, GRAPH_CSV]
