"""ONNX files without the source lines that the exporter notes of every node: half of a small file, and local paths."""

from __future__ import annotations

from typing import Any


def forget_origin(model: Any) -> None:
    """Clear the notes and properties of a model's graph, of its nodes and values, and of the graphs within them."""
    _forget(model.graph)
    for function in model.functions:
        _forget_nodes(function.node)


def _forget(graph: Any) -> None:
    for part in (graph, *graph.value_info, *graph.input, *graph.output, *graph.initializer):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    _forget_nodes(graph.node)


def _forget_nodes(nodes: Any) -> None:
    for node in nodes:
        node.ClearField("metadata_props")
        node.ClearField("doc_string")
        for attribute in node.attribute:
            for inner in (*attribute.graphs, *([attribute.g] if attribute.HasField("g") else [])):
                _forget(inner)
