"""How good a pruner is, through real estimators on whole pairs; and what its training leaves.

That is the network as safetensors and ONNX, which state it, and a card: where it comes from, how good it is."""

import contextlib
import copy
import dataclasses
import hashlib
import importlib.util
import json
import logging
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Float, Int, Int8
from safetensors.torch import save_file
from torch import Tensor, nn

from fmtorch import metrics
from fmtorch.core import Estimator
from fmtorch.core.files import replacing, write_whole
from fmtorch.metrics.recall import FINE_THRESHOLD
from fmtorch.pruning.networks import layers, learned
from fmtorch.training.labelled import LabelledMatches
from fmtorch.training.objective import classification_loss

MAX_TEMPERATURE = 100.0  # and its inverse: bounds where the labels set none, as when they are perfectly separated
BINS = 10  # of a table of reliability
BISECTIONS = 50  # halvings of the interval of log temperature: 9.2 / 2^50


@dataclasses.dataclass(frozen=True, eq=False)
class Use:
    """One way of using P(inlier) before an estimator.
    threshold: matches with a smaller P are dropped and no prior is given; None: all are kept, with P as their prior."""

    estimator: Estimator
    threshold: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Evaluation:
    """Figures by name, and the log-odds and labels of all labelled matches, from which a temperature is fitted."""

    figures: dict[str, float]
    logit: Tensor
    label: Tensor


def expect_figure(name: str, uses: Iterable[str]) -> None:
    """Raises ValueError where validation with these uses has no figure of this name."""
    recalls = [f"{use}/{figure}" for use in uses for figure in ("recall@0.05", "recall@0.01", "AUC@0.05")]
    known = ["log_loss", "match_precision", "match_recall", "calibration_error", *recalls]
    if name not in known and not name.startswith(tuple(f"{each}/" for each in recalls[2::3])):  # of a family
        raise ValueError(f"validation.monitor={name}; it must be one of: {', '.join(known)}, or USE/AUC@0.05/FAMILY")


class Validation:
    """Evaluates a network on labelled matches of single pairs.

    Args:
        pairs: batches of one.
        uses: by name; each gives recall at NSGD 0.05 and 0.01 and AUC@0.05, the area under the recall curve to 0.05.
        families: of the pairs; where given, AUC@0.05 of each family is a figure of its own.
        seed: of sampling and of NSGD.
    """

    def __init__(
        self, pairs: Sequence[LabelledMatches], uses: Mapping[str, Use], families: Sequence[str] | None = None,
        seed: int = 0,
    ) -> None:  # fmt: skip
        if not pairs:
            raise ValueError("validation needs at least one pair; see validation.scenes and validation.roots")
        self.pairs, self.uses, self.seed = list(pairs), dict(uses), seed
        self.families = list(families) if families is not None else [""] * len(self.pairs)

    @torch.no_grad()
    def __call__(self, network: nn.Module) -> Evaluation:
        """The figures of a network in its present state, which is left as it was.
        Each pair is evaluated alone, in evaluation mode and on the CPU's one thread, as in use."""
        training, threads = network.training, torch.get_num_threads()
        device = next((p.device for p in network.parameters()), torch.device("cpu"))
        network.eval()
        torch.set_num_threads(1)
        try:
            predictions = (learned.predict(network, pair.correspondences.to(device)) for pair in self.pairs)
            logits = [prediction.logit[-1].to("cpu", torch.float64) for prediction in predictions]
            nsgd = {name: self._nsgd(use, logits) for name, use in self.uses.items()}
        finally:
            torch.set_num_threads(threads)
            network.train(training)
        labelled = [pair.labelled for pair in self.pairs]
        logit = torch.cat([value[mask] for value, mask in zip(logits, labelled, strict=True)])
        label = torch.cat([pair.label[mask] for pair, mask in zip(self.pairs, labelled, strict=True)])
        kept, inlier = logit >= 0, label == 1  # P >= 0.5
        right = float((kept & inlier).sum())
        figures = {
            "log_loss": float(classification_loss(logit[None], label[None])),
            "match_precision": right / max(float(kept.sum()), 1.0),
            "match_recall": right / max(float(inlier.sum()), 1.0),
            "calibration_error": reliability(torch.sigmoid(logit), label).error,
        }
        for name, values in nsgd.items():
            figures |= self._recalls(name, values)
        return Evaluation(figures, logit, label)

    def _nsgd(self, use: Use, logits: Sequence[Tensor]) -> Tensor:
        """NSGD of each pair; 1 where the estimate failed."""
        values = []
        for pair, logit in zip(self.pairs, logits, strict=True):
            c, p = pair.correspondences, torch.sigmoid(logit)
            c = c.replace(prior=p.to(c.x0.dtype)) if use.threshold is None else c.keep(p >= use.threshold).compact()
            estimate = use.estimator(c, self.seed)
            assert c.size0 is not None
            assert c.size1 is not None
            error = metrics.nsgd(pair.F, estimate.F.to(torch.float64), c.size0, c.size1, seed=self.seed, key=c.keys)
            values.append(torch.where(estimate.ok, error, 1.0))
        return torch.cat(values)

    def _recalls(self, name: str, nsgd: Tensor) -> dict[str, float]:
        figures = {
            f"{name}/recall@0.05": float(metrics.recall(nsgd)),
            f"{name}/recall@0.01": float(metrics.recall(nsgd, FINE_THRESHOLD)),
            f"{name}/AUC@0.05": float(metrics.mean_recall(nsgd)),
        }
        for family in sorted(set(self.families) - {""}):
            mine = torch.tensor([f == family for f in self.families])
            figures[f"{name}/AUC@0.05/{family}"] = float(metrics.mean_recall(nsgd[mine]))
        return figures


class Reliability(NamedTuple):
    """Predicted against observed shares of inliers, over bins of equal width of the predicted probability.
    edges: of the bins. matches: how many fell in each. predicted: their mean probability. observed: their share of
    inliers; both NaN in an empty bin. error: the expected calibration error, the mean over matches of |predicted -
    observed| of their bin (Naeini et al., AAAI 2015); NaN without matches."""

    edges: Float[Tensor, " bins_and_1"]
    matches: Int[Tensor, " bins"]
    predicted: Float[Tensor, " bins"]
    observed: Float[Tensor, " bins"]
    error: float


def temperature(logit: Float[Tensor, "*matches"], label: Int8[Tensor, "*matches"]) -> float:
    """The T that minimises the mean cross-entropy of the logits divided by T (Guo et al., ICML 2017, section 4.2).

    The loss is convex in 1 / T; the root of its derivative is found by bisection. Nothing else is fitted, so the order
    of the matches stays as it is, and so does the decision at probability one half.

    Args:
        logit: predicted log-odds of validation matches, of any shape.
        label: 1 inlier, 0 outlier, -1 ignored.

    Returns:
        T, between 1 / MAX_TEMPERATURE and MAX_TEMPERATURE: at a bound where the best T lies beyond, as when the logits
        separate the classes. 1 where there is no labelled match or every logit is zero.
    """
    labelled = label >= 0
    z = logit.detach()[labelled].to(torch.float64)
    target = (label[labelled] > 0).to(torch.float64)
    if not bool((z != 0).any()):
        return 1.0

    def slope(log_t: float) -> float:
        """Of the loss along 1 / T: rises with 1 / T."""
        return float(((torch.sigmoid(z * math.exp(-log_t)) - target) * z).sum())

    low, high = -math.log(MAX_TEMPERATURE), math.log(MAX_TEMPERATURE)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        if slope(middle) > 0:  # too sure: a higher temperature is better
            low = middle
        else:
            high = middle
    return math.exp((low + high) / 2)


def reliability(probability: Float[Tensor, "*matches"], label: Int8[Tensor, "*matches"]) -> Reliability:
    """Predicted probabilities against observed shares of inliers, float64; a probability of 1 is in the last of `BINS`.

    Args:
        probability: that a match is an inlier, of any shape.
        label: 1 inlier, 0 outlier, -1 ignored.
    """
    labelled = label >= 0
    p = probability.detach()[labelled].to(torch.float64)
    target = (label[labelled] > 0).to(torch.float64)
    index = (p * BINS).long().clamp(0, BINS - 1)
    count = torch.bincount(index, minlength=BINS)
    sums = [torch.bincount(index, weights=x, minlength=BINS) for x in (p, target)]
    predicted, observed = (s / count for s in sums)
    error = float((sums[0] - sums[1]).abs().sum() / count.sum())
    edges = torch.linspace(0, 1, BINS + 1, dtype=torch.float64, device=p.device)
    return Reliability(edges, count, predicted, observed, error)


ATOL = 1e-4  # of torch against ONNX
OPSET = 18
EXAMPLE_MATCHES = 300
OWN_LICENCE = "Apache-2.0, as this project"


def sha256(path: Path) -> str:
    """Of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def save_weights(
    network: nn.Module, path: Path, *, temperature: float = 1.0, notes: Mapping[str, str] | None = None
) -> None:
    """Write a network's weights as safetensors, whole or not at all, into a folder that is made.
    An attribute `options` of the network is stated in the file. temperature: by which log-odds are divided at
    inference. notes: what else the file is to say."""
    path.parent.mkdir(parents=True, exist_ok=True)
    state = {key: value.detach().cpu().contiguous() for key, value in network.state_dict().items()}
    with replacing(path) as unfinished:
        save_file(state, unfinished, metadata=learned.metadata(network, temperature, notes))


def export_onnx(network: nn.Module, path: Path, *, temperature: float = 1.0) -> None:
    """Write a network's backbone as ONNX: float `matches` (1, channels, N), N free, to `outputs` (1, K, N).
    Needs the extra `export`. temperature: as of `save_weights`. Raises ValueError for a network that is not
    `Exportable`, ArithmeticError where ONNX Runtime disagrees with torch."""
    if not learned.exportable(network):
        missing = f"{type(network).__name__} has no `backbone`, `input_channels`, `options` and `predict`"
        raise ValueError(f"{missing}: it cannot be exported to ONNX, and runs with torch alone")
    outside = [key for key in network.state_dict() if not key.startswith("backbone.")]
    if outside:
        raise ValueError(f"{', '.join(outside)}: parameters outside the backbone would not be in the ONNX file")
    import onnx

    parts = cast(learned.Exportable, network)
    alone = _OnePair(copy.deepcopy(parts.backbone)).eval().cpu().float()
    example = torch.rand(1, parts.input_channels, EXAMPLE_MATCHES, generator=torch.Generator().manual_seed(0))
    model = onnx_model(alone, example, learned.INPUT, learned.OUTPUT, free_axis=2)
    onnx.helper.set_model_props(model, learned.metadata(network, temperature))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as unfinished, torch.no_grad():
        onnx.save(model, unfinished)
        x = torch.rand(1, parts.input_channels, 3 * EXAMPLE_MATCHES)
        slots = layers.Slots(torch.tensor([float(x.shape[2])]), None)
        expect_equal(unfinished, learned.OnnxBackbone(network, unfinished, "")(x, slots), alone(x))


def onnx_model(network: nn.Module, example: Tensor, name: str, output: str, *, free_axis: int) -> Any:
    """A module of one input as an ONNX model, one axis of the input of any length, without notes of source lines."""
    with quiet(("torch.onnx",), logging.ERROR), warnings.catch_warnings():  # of operators that are not installed
        warnings.simplefilter("ignore", FutureWarning)  # of the exporter's own deprecated calls
        program = torch.onnx.export(
            network, (example,), dynamo=True, opset_version=OPSET, input_names=[name], output_names=[output],
            dynamic_shapes=({free_axis: torch.export.Dim("n", min=1)},), verbose=False,
        )  # fmt: skip
    assert program is not None
    return without_origin(program.model_proto)


def without_origin(model: Any) -> Any:
    """An ONNX model without the notes and properties of its graph, of nodes and values, and of the graphs within."""
    import onnx_ir.passes.common

    return onnx_ir.to_proto(onnx_ir.passes.common.ClearMetadataAndDocStringPass()(onnx_ir.from_proto(model)).model)


def expect_equal(path: Path, exported: Tensor, expected: Tensor) -> None:
    """Raises ArithmeticError where what a file's network gives is further than `ATOL` from torch's."""
    apart = float((exported - expected).abs().max())
    if not apart <= ATOL:
        raise ArithmeticError(f"{path}: ONNX Runtime differs from torch by {apart:.1e}, more than {ATOL:.0e}")


@contextlib.contextmanager
def quiet(names: Sequence[str], level: int) -> Iterator[None]:
    """Without messages of these loggers below a level."""
    loggers = [logging.getLogger(name) for name in names]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(level)
    try:
        yield
    finally:
        for logger, old in zip(loggers, before, strict=True):
            logger.setLevel(old)


class _OnePair(nn.Module):
    """A backbone as a function of one pair's input alone."""

    def __init__(self, backbone: nn.Module) -> None:
        super().__init__()
        self.backbone = backbone

    def forward(self, x: Float[Tensor, "1 channels n"]) -> Float[Tensor, "1 outputs n"]:
        return self.backbone(x, layers.Slots(torch.ones_like(x[:, 0]).sum(1), None))  # type: ignore[no-any-return]


def write_result(
    folder: Path, name: str, network: nn.Module, validation: Validation, facts: Mapping[str, Any]
) -> tuple[list[Path], dict[str, float]]:
    """Evaluate the best weights of a training and write them into its folder; the files, and the figures.
    The files are `name` with .safetensors, .md and, where the network can be exported and the extra `export` is
    installed, .onnx. facts of the training: `data`, `seconds`, `steps`, `best_step`, `processor`, the identity."""
    network = network.to("cpu").eval()
    evaluation = validation(network)
    fitted = temperature(evaluation.logit, evaluation.label)
    files = [folder / f"{name}.safetensors"]
    save_weights(network, files[0], temperature=fitted)
    if learned.exportable(network) and importlib.util.find_spec("onnxscript") is not None:
        files.append(folder / f"{name}.onnx")
        export_onnx(network, files[-1], temperature=fitted)
    card = folder / f"{name}.md"
    write_whole(card, model_card(files, facts, evaluation, fitted))
    write_whole(folder / "validation.json", json.dumps({**evaluation.figures, "temperature": fitted}, indent=2) + "\n")
    return [*files, card], evaluation.figures


def model_card(files: Sequence[Path], facts: Mapping[str, Any], evaluation: Evaluation, temperature: float) -> str:
    """Markdown: what was trained on what, for how long, and how good it is on the validation pairs."""
    network, optimisation, figures = facts["network"], facts["optimisation"], evaluation.figures
    options = listed({key: value for key, value in network.items() if key != "_target_"})
    rows = {
        "network": str(network["_target_"]).rpartition(".")[2] + (f" ({options})" if options else ""),
        **{f"SHA-256 of {path.name}": f"`{sha256(path)}`" for path in files},
        "bytes": ", ".join(str(path.stat().st_size) for path in files),
        "licence": OWN_LICENCE,
        "origin": "trained by this project from random weights, fmtorch.train",
        "trained on": facts["data"]["training"],
        "validated on": facts["data"]["validation"],
        "augmentation": listed(facts["augmentation"]),
        "loss": listed(facts["objective"]),
        "run": f"{facts['steps']} steps of {facts['batch']} pairs, Adam, learning rate {optimisation['learning_rate']} "
        f"falling to zero over the last {100 * optimisation['decay']:.0f} %, seed {facts['seed']}, "
        f"{facts['seconds'] / 60:.0f} minutes on {facts['processor']}; weights of step {facts['best_step']}",
        "temperature": f"{temperature:.3f}, fitted on validation",
    }
    lines = [f"# {files[0].stem}", "", "| | |", "| --- | --- |", *(f"| {k} | {v} |" for k, v in rows.items()), ""]
    uses = sorted({key.split("/")[0] for key in figures if key.endswith("/AUC@0.05")})
    families = sorted({key.split("/")[2] for key in figures if key.count("/") == 2})
    keys = {"R.05": "recall@0.05", "R.01": "recall@0.01", "AUC@0.05": "AUC@0.05"}
    percent = {use: [f"{100 * figures[f'{use}/{key}']:.1f}" for key in keys.values()] for use in uses}
    lines += ["On the validation pairs (recall in %):", "", *markdown_table("use", keys, percent)]
    if families:
        percent = {use: [f"{100 * figures[f'{use}/AUC@0.05/{family}']:.1f}" for family in families] for use in uses}
        lines += ["", "AUC@0.05 by family:", "", *markdown_table("use", families, percent)]
    table = reliability(torch.sigmoid(evaluation.logit / temperature), evaluation.label)
    lines += [
        "", f"Log loss {figures['log_loss']:.3f} nats a match; with P >= 0.5, precision "
        f"{100 * figures['match_precision']:.1f} % and recall {100 * figures['match_recall']:.1f} % of the matches. "
        f"Reliability (expected calibration error {100 * table.error:.1f} %):", "",
        *markdown_table("P(inlier)", [f"{p:.2f}" for p in table.predicted.tolist()], {
            "share of inliers": [f"{p:.2f}" for p in table.observed.tolist()],
            "matches": [str(n) for n in table.matches.tolist()],
        }),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def markdown_table(corner: str, columns: Iterable[str], rows: Mapping[str, Sequence[str]]) -> list[str]:
    """The lines of a Markdown table of figures, a column of names first."""
    names = list(columns)
    head = [f"| {corner}".rstrip() + " | " + " | ".join(names) + " |", "| --- |" + " ---: |" * len(names)]
    return [*head, *(f"| {name} | " + " | ".join(values) + " |" for name, values in rows.items())]


def listed(options: Mapping[str, Any]) -> str:
    """Options in a cell of a card's table."""
    return ", ".join(f"{key} {value}" for key, value in options.items())
