"""The card that stands beside every shipped network: where it comes from, how it was trained, what it reaches."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

TITLES = {
    "hardnet": "HardNet (Mishchuk, Mishkin, Radenovic, Matas, NIPS 2017)",
    "l2net": "L2-Net (Tian, Fan, Wu, CVPR 2017)",
    "geodesc": "GeoDesc (Luo, Shen, Zhou, Zhu, Zhang, Yao, Fang, Quan, ECCV 2018)",
    "affnet": "AffNet (Mishkin, Radenovic, Matas, ECCV 2018)",
    "hardnet_fast": "HardNet (Mishchuk, Mishkin, Radenovic, Matas, NIPS 2017) in a smaller layout",
    "affnet_fast": "AffNet (Mishkin, Radenovic, Matas, ECCV 2018) in a smaller layout",
    "orinet": "OriNet (Mishkin, Radenovic, Matas, ECCV 2018)",
}
RATIO = "residual_tilt"
FIGURES = {
    "fpr95": "FPR at 95 % recall (%)",
    "map": "mAP (%)",
    "accuracy": "nearest is right (%)",
    RATIO: "ratio of axes left after rectification (median; 1 is best)",
}
OTHER_LOSS = {
    ("affnet", "affine_covariance"): "The loss is this project's own, not AffNet's: a patch that was stretched in two "
    "known ways should be rectified alike (fmtorch.training.patch_objectives.CovarianceObjective). The published hard "
    "negative-constant loss, with a HardNet that is itself robust to tilt, ended after 20 minutes in one shape for all "
    "patches; it is the option training.loss.name=hard_negative_constant.",
    ("affnet_fast", "affine_covariance"): "The loss is that of affnet.md, plus the departure from its shapes.",
    ("l2net", "hardest_triplet"): "The loss is HardNet's: L2-Net's own, the option "
    "training.loss.name=relative_distance, learns far more slowly in so short a run.",
    ("geodesc", "geodesc"): "The method is GeoDesc's; the authors' weights are not. In place of their reconstructions, "
    "photographs seen as planes and rendered scenes give matches with known angles. A batch has fewer pairs of "
    "photographs than theirs (12), the optimiser is Adam instead of SGD, and the two patches of a match are not turned "
    "at random by up to 90 degrees each, which the authors' later code limits to 5 (lzx551402/tfmatch).",
}
"""What a card says of an architecture and loss: how its training differs from that of its paper."""
OWN_LICENCE = "Apache-2.0, as this project"


def sha256(path: Path) -> str:
    """Of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def model_card(
    path: Path,
    architecture: str,
    precision: str,
    checkpoint: Mapping[str, Any],
    figures: Mapping[str, float] | None = None,
    licence: str | None = None,
) -> str:
    """Markdown for the ONNX file at `path`, from what its checkpoint says beside the weights.

    figures: of the ONNX file itself on the validation patches. licence: of weights that this project did not train.
    """
    lines = [
        f"# {path.name}",
        "",
        f"{TITLES[architecture]}, {precision}: float32 grey patches (N, 1, 32, 32) to (N, D).",
        "",
    ]
    lines += ["| | |", "| --- | --- |", f"| SHA-256 | `{sha256(path)}` |", f"| bytes | {path.stat().st_size} |"]
    if "options" in checkpoint:
        lines += [f"| licence | {licence or OWN_LICENCE} |", *_training(checkpoint)]
    else:
        lines += [f"| licence | {licence or 'as the checkpoint it was converted from'} |", "| origin | converted |"]
    loss = checkpoint.get("loss", {}).get("name")
    if (architecture, loss) in OTHER_LOSS:
        lines += ["", OTHER_LOSS[architecture, loss]]
    rows = dict(checkpoint.get("validation", {}))
    if figures is not None:
        rows["this file"] = figures
    return "\n".join([*lines, "", *_quality(rows, checkpoint)]).rstrip() + "\n"


def _training(checkpoint: Mapping[str, Any]) -> list[str]:
    o, data, losses = checkpoint["options"], checkpoint["data"], checkpoint["losses"]
    licences = checkpoint.get("licences", {}) | {"scikit-image": "photographs inside the package, BSD-3-Clause"}
    photographs = "; ".join(
        f"{count} of {source}" + (f" ({licences[source]})" if source in licences else "")
        for source, count in data["photographs"].items()
    )
    loss = ", ".join(f"{k} {Path(v).name if k == 'descriptor' else v}" for k, v in checkpoint["loss"].items())
    last = losses[-100:]
    teacher = checkpoint.get("teacher")
    match_sets = [checkpoint["match_sets"]] if "match_sets" in checkpoint else []
    limits = ", ".join(f"{k} {v}" for k, v in data["limits"].items())
    scenes = ", ".join(f"{count} of {family}" for family, count in data.get("scenes", {}).items())
    return [
        "| origin | trained by this project from random weights, scripts/train_patch_network.py |",
        f"| photographs | {photographs} |",
        f"| patches | {data['patches']} of {data['points']} points, found independently by DoG and Hessian in"
        f" {data['views']} random views of each photograph ({limits}) with changes of light, blur, noise and JPEG"
        f"{f', and in as many photographs of each rendered scene ({scenes})' if scenes else ''} |",
        f"| loss | {loss} |",
        *([f"| teacher | {_teacher(teacher)} |"] if teacher else []),
        *(f"| match sets | {', '.join(f'{k} {v}' for k, v in sets.items())} |" for sets in match_sets),
        f"| run | {checkpoint['step']} steps of {o['batch']} points, {checkpoint['seconds'] / 60:.0f} minutes, "
        f"{o['optimizer']}, learning rate {o['learning_rate']} falling linearly to zero, seed {o['seed']}, "
        f"{'bfloat16 autocast' if o['bf16'] else 'float32'} |",
        f"| loss of the last {len(last)} steps | {sum(last) / len(last):.4f} |",
    ]


def _teacher(teacher: Mapping[str, Any]) -> str:
    """The network whose outputs were imitated, and how much that counts."""
    name, precision = Path(teacher["network"]).name, teacher["precision"]
    return f"{name} ({precision}), whose outputs for the same patches are imitated with weight {teacher['weight']}"


def _quality(rows: Mapping[str, Mapping[str, float]], checkpoint: Mapping[str, Any]) -> list[str]:
    """A table of the figures on held-out patches; figures of circular shapes get a row of their own."""
    table: dict[str, Mapping[str, float]] = {}
    for name, row in rows.items():
        table[name] = row
        circle = {k.removeprefix("circle_"): v for k, v in row.items() if k.startswith("circle_")}
        if circle:
            table["circles instead of shapes"] = circle
    if not table:
        return []
    held_out = ", ".join(checkpoint.get("validation_data", {}).get("photographs", {}))
    title = f"Measured on patches of held-out sources ({held_out}):" if held_out else "Measured on held-out patches:"
    columns = [key for key in FIGURES if all(key in row for row in table.values())]
    head = [title, "", "| | " + " | ".join(FIGURES[key] for key in columns) + " |", "| --- " * (len(columns) + 1) + "|"]
    return head + [
        f"| {name} | " + " | ".join(f"{row[key] * (1 if key == RATIO else 100):.2f}" for key in columns) + " |"
        for name, row in table.items()
    ]
