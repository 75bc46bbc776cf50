"""Makes an ONNX file, and its model card, from a checkpoint of a patch network.

python -m scripts.patch_networks.export checkpoint=runs/patch_networks/hardnet.pt           -> models/hardnet.onnx, .md
python -m scripts.patch_networks.export checkpoint=HardNet++.pth architecture=hardnet name=hardnetpp
python -m scripts.patch_networks.export checkpoint=... precision=int8 calibration=runs/patch_networks/patches/train

checkpoint: of scripts.patch_networks.train, kornia's and the authors' .pth, or TorchScript. int8: weights per channel,
activations by what `calibration` patches show. validation=FOLDER of patches adds the ONNX file's figures to the card.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from fmtorch.core.files import models_dir
from fmtorch.core.terminal import console, exits_with_message
from fmtorch.features.local_feature import PatchNetwork, network_file
from fmtorch.features.networks import DESCRIPTORS, build, load_weights, read_checkpoint
from fmtorch.training.export import OWN_LICENCE, listed, markdown_table, sha256
from scripts.patch_networks.objectives import evaluate_descriptor, middle
from scripts.patch_networks.onnx_export import export, lay_out, quantize
from scripts.patch_networks.stores import PatchStore, validation_pairs

DEFAULTS = {
    "checkpoint": "???", "architecture": None, "name": None, "precision": "fp32", "folder": None,
    "calibration": None, "calibration_patches": 2048, "validation": None, "pairs": 5000, "seed": 0, "threads": 1,
    "licence": None,
}  # fmt: skip
CARDS = Path(__file__).with_name("cards.yaml")
RATIO = "residual_tilt"
FIGURES = {"fpr95": "FPR at 95 % recall (%)", "map": "mAP (%)", "accuracy": "nearest is right (%)"}
FIGURES[RATIO] = "ratio of axes left after rectification (median; 1 is best)"


def model_card(config: DictConfig, path: Path, checkpoint: Mapping[str, Any], figures: Mapping[str, float]) -> str:
    """Markdown for the ONNX file at `path`, from what its checkpoint says beside the weights.
    figures: of the ONNX file itself on the validation patches; empty where it was not measured."""
    trained, about = "options" in checkpoint, OmegaConf.load(CARDS)[config.architecture]
    licence = config.licence or (OWN_LICENCE if trained else "as the checkpoint it was converted from")
    rows = {"SHA-256": f"`{sha256(path)}`", "bytes": path.stat().st_size, "licence": licence}
    rows |= _training(checkpoint) if trained else {"origin": "converted"}
    title = f"{about.title}, {config.precision}: float32 grey patches (N, 1, 32, 32) to (N, D)."
    lines = [f"# {path.name}", "", title, "", "| | |", "| --- | --- |", *(f"| {k} | {v} |" for k, v in rows.items())]
    other_loss = about.get(checkpoint.get("loss", {}).get("name", ""))
    lines += ["", other_loss] if other_loss else []
    measured = checkpoint.get("validation", {}) | ({"this file": figures} if figures else {})
    return "\n".join([*lines, "", *_quality(measured, checkpoint)]).rstrip() + "\n"


def _training(checkpoint: Mapping[str, Any]) -> dict[str, str]:
    """Rows of the card: what a network was trained on, and how."""
    data, losses = checkpoint["data"], checkpoint["losses"][-100:]
    licences = checkpoint.get("licences", {}) | {"scikit-image": "photographs inside the package, BSD-3-Clause"}
    under = {source: f" ({licence})" for source, licence in licences.items()}
    photographs = (f"{count} of {source}{under.get(source, '')}" for source, count in data["photographs"].items())
    rows = {
        "origin": "trained by this project from random weights, scripts.patch_networks.train",
        "photographs": "; ".join(photographs),
        "patches": f"{data['patches']} of {data['points']} points, found independently by DoG and Hessian in random "
        f"views of each photograph ({listed(data['limits'])}) with changes of light, blur, noise and JPEG",
        "run": f"{checkpoint['step']} steps, {checkpoint['seconds'] / 60:.0f} minutes; {listed(checkpoint['options'])}",
    }
    rows |= {name: listed(checkpoint[name]) for name in ("loss", "teacher", "match_sets") if name in checkpoint}
    return {**rows, f"loss of the last {len(losses)} steps": f"{sum(losses) / len(losses):.4f}"}


def _quality(rows: Mapping[str, Mapping[str, float]], checkpoint: Mapping[str, Any]) -> list[str]:
    """A table of the figures on held-out patches; figures of circular shapes get a row of their own."""
    table = dict(rows)
    for row in rows.values():
        if circle := {k.removeprefix("circle_"): v for k, v in row.items() if k.startswith("circle_")}:
            table["circles instead of shapes"] = circle
    if not table:
        return []
    held_out = ", ".join(checkpoint.get("validation_data", {}).get("photographs", {}))
    title = f"Measured on patches of held-out sources ({held_out}):" if held_out else "Measured on held-out patches:"
    columns = [key for key in FIGURES if all(key in row for row in table.values())]
    cells = {name: [f"{row[k] * (1 if k == RATIO else 100):.2f}" for k in columns] for name, row in table.items()}
    return [title, "", *markdown_table("", [FIGURES[key] for key in columns], cells)]


def main() -> None:
    with exits_with_message():
        config = OmegaConf.merge(OmegaConf.create(DEFAULTS), OmegaConf.from_cli())
        assert isinstance(config, DictConfig)
        if OmegaConf.is_missing(config, "checkpoint"):
            raise ValueError("checkpoint is missing; it names the file of the trained network: checkpoint=FILE.pt")
        torch.set_num_threads(config.threads)
        content = read_checkpoint(config.checkpoint)
        config.architecture = architecture = config.architecture or content.get("architecture")
        if architecture is None:
            raise ValueError(f"{config.checkpoint} does not say what it is: give architecture=")
        network = build(architecture).eval()
        load_weights(network, config.checkpoint)
        folder = models_dir() if config.folder is None else Path(config.folder)
        path = folder / network_file(config.name or architecture, config.precision).name
        if config.precision == "fp32":
            export(network, path)
            lay_out(path)
        elif config.calibration is None:
            raise ValueError("precision=int8 needs calibration=FOLDER of patches, e.g. <out>/patches/train")
        else:
            store = PatchStore.open(config.calibration)
            with tempfile.TemporaryDirectory() as temporary:
                export(network, Path(temporary) / "fp32.onnx")
                patches = middle(validation_pairs(store, config.calibration_patches, config.seed)[0])
                quantize(Path(temporary) / "fp32.onnx", path, patches)
        figures: dict[str, float] = {}
        if config.validation is not None and architecture in DESCRIPTORS:
            pairs = validation_pairs(PatchStore.open(config.validation), config.pairs)
            figures = evaluate_descriptor(PatchNetwork(path), pairs)
        card = path.with_suffix(".md")
        card.write_text(model_card(config, path, content, figures))
        console.print(f"{path} ({path.stat().st_size} bytes), {card}")


if __name__ == "__main__":
    main()
