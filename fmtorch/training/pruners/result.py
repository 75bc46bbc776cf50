"""What a training leaves: a learned file in two forms, and a card that says where it comes from and how good it is."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from fmtorch.core.files import replacing
from fmtorch.pruning.networks.learned import Exportable
from fmtorch.training.model_card import OWN_LICENCE, sha256
from fmtorch.training.pruner_export import export_onnx, save_weights
from fmtorch.training.pruners.loop import BEST, CHECKPOINTS
from fmtorch.training.pruners.module import PrunerTraining
from fmtorch.training.pruners.validation import Evaluation
from fmtorch.training.reliability import reliability


@dataclasses.dataclass(frozen=True, eq=False)
class Result:
    """A finished training: files, figures and the temperature of its log-odds."""

    files: tuple[Path, ...]
    evaluation: Evaluation
    temperature: float


def write_result(folder: Path, name: str, module: PrunerTraining, facts: Mapping[str, Any]) -> Result:
    """Evaluate the best weights of a training and write them into its folder.

    The files are `name` with .safetensors, .md and, where the network can be exported and the extra `export` is
    installed, .onnx.

    Args:
        folder: of the training. name: of the files. module: of the training; takes the best weights.
        facts: what the card says of the training: `data`, `seconds`, `steps`, `processor`, and the identity.

    Returns:
        What was written.

    Raises:
        FileNotFoundError: the training has left no weights.
    """
    best = torch.load(folder / CHECKPOINTS / BEST, map_location="cpu", weights_only=True)
    module.load_state_dict(best["state_dict"])
    network = module.network.to("cpu").eval()
    evaluation = module.validation(network)
    temperature = evaluation.temperature()
    weights = folder / f"{name}.safetensors"
    save_weights(network, weights, temperature=temperature)
    files = [weights]
    if isinstance(network, Exportable) and importlib.util.find_spec("onnxscript") is not None:
        files.append(folder / f"{name}.onnx")
        export_onnx(network, files[-1], temperature=temperature)
    card = folder / f"{name}.md"
    with replacing(card) as temporary:
        temporary.write_text(
            model_card(files, facts, evaluation, temperature, int(best["global_step"])), encoding="utf-8"
        )
    with replacing(folder / "validation.json") as temporary:
        temporary.write_text(json.dumps({**evaluation.figures, "temperature": temperature}, indent=2) + "\n")
    return Result((*files, card), evaluation, temperature)


def model_card(
    files: list[Path], facts: Mapping[str, Any], evaluation: Evaluation, temperature: float, step: int
) -> str:
    """Markdown: what was trained on what, for how long, and how good it is on the validation pairs."""
    network, optimisation, objective = (facts[part] for part in ("network", "optimisation", "objective"))
    kind = str(network["_target_"]).rpartition(".")[2]
    options = ", ".join(f"{key} {value}" for key, value in network.items() if key != "_target_")
    terms = ", ".join(f"{key} {value}" for key, value in objective.items())
    augmentation = ", ".join(f"{key} {value}" for key, value in facts["augmentation"].items())
    rows = {
        "network": f"{kind} ({options})" if options else kind,
        **{f"SHA-256 of {path.name}": f"`{sha256(path)}`" for path in files},
        "bytes": ", ".join(str(path.stat().st_size) for path in files),
        "licence": OWN_LICENCE,
        "origin": "trained by this project from random weights, fmtorch.train",
        "trained on": facts["data"]["training"],
        "validated on": facts["data"]["validation"],
        "augmentation": augmentation,
        "loss": terms,
        "run": f"{facts['steps']} steps of {facts['batch']} pairs, Adam, learning rate {optimisation['learning_rate']} "
        f"falling to zero over the last {100 * optimisation['decay']:.0f} %, seed {facts['seed']}, "
        f"{facts['seconds'] / 60:.0f} minutes on {facts['processor']}; weights of step {step}",
        "temperature": f"{temperature:.3f}, fitted on validation",
    }
    lines = [f"# {files[0].stem}", "", "| | |", "| --- | --- |", *(f"| {k} | {v} |" for k, v in rows.items()), ""]
    figures = evaluation.figures
    uses = sorted({key.split("/")[0] for key in figures if key.endswith("/AUC@0.05")})
    lines += [
        "On the validation pairs (recall in %):",
        "",
        "| use | R.05 | R.01 | AUC@0.05 |",
        "| --- | ---: | ---: | ---: |",
    ]
    for use in uses:
        values = (100 * figures[f"{use}/{figure}"] for figure in ("recall@0.05", "recall@0.01", "AUC@0.05"))
        lines.append(f"| {use} | " + " | ".join(f"{value:.1f}" for value in values) + " |")
    families = sorted({key.split("/")[2] for key in figures if key.count("/") == 2})
    if families:
        lines += [
            "",
            "AUC@0.05 by family:",
            "",
            "| use | " + " | ".join(families) + " |",
            "| --- |" + " ---: |" * len(families),
        ]
        lines += [
            f"| {use} | " + " | ".join(f"{100 * figures[f'{use}/AUC@0.05/{f}']:.1f}" for f in families) + " |"
            for use in uses
        ]
    table = reliability(torch.sigmoid(evaluation.logit / temperature), evaluation.label)
    lines += [
        "", f"Log loss {figures['log_loss']:.3f} nats a match; with P >= 0.5, precision "
        f"{100 * figures['match_precision']:.1f} % and recall {100 * figures['match_recall']:.1f} % of the matches. "
        f"Reliability (expected calibration error {100 * table.error:.1f} %):", "",
        "| P(inlier) | " + " | ".join(f"{p:.2f}" for p in table.predicted.tolist()) + " |",
        "| --- |" + " ---: |" * len(table.matches),
        "| share of inliers | " + " | ".join(f"{p:.2f}" for p in table.observed.tolist()) + " |",
        "| matches | " + " | ".join(str(n) for n in table.matches.tolist()) + " |",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"
