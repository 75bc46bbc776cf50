"""Learned pruners: a network and its learned file as a stage, which drops matches or supplies their prior.

Weights are safetensors, a backbone is ONNX; both state the network they belong to. Reading one executes nothing of it:
whoever reads the file builds the network, which has to be the one that it states."""

import copy
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from fmtorch.core import Correspondences, NetworkFileError, models_dir, onnx_session, stages
from fmtorch.pruning.networks.layers import Slots

SUFFIXES = {"torch": ".safetensors", "onnx": ".onnx"}  # of the file that each runtime reads
METADATA = "fmtorch"  # the one key of a file's metadata: several have no fixed order, and so no digest, in safetensors
INPUT, OUTPUT = "matches", "outputs"  # of an ONNX file: (1, channels, N) and (1, outputs, N)


def learned_file(name: str | Path, runtime: str) -> Path:
    """Where the file of a name is that a runtime, "torch" or "onnx", reads.
    A plain name is a shipped model's: "lc_f" is models/lc_f.onnx. Others are paths, which get the suffix if missing."""
    path = Path(name)
    if path.suffix in SUFFIXES.values():
        return path
    return (models_dir() if len(path.parts) == 1 else path.parent) / f"{path.name}{SUFFIXES[runtime]}"


def stated_network(network: nn.Module) -> dict[str, Any]:
    """What a file states of its network, as JSON gives it back: its class, and its `options` where it has them."""
    return json.loads(json.dumps({"class": type(network).__name__, "options": getattr(network, "options", None)}))  # type: ignore[no-any-return]


def metadata(network: nn.Module, temperature: float, notes: Mapping[str, str] | None = None) -> dict[str, str]:
    """A file's metadata; equal contents are equal bytes. temperature: of the log-odds. notes: anything else."""
    said = {"network": stated_network(network), "temperature": float(temperature), "notes": dict(notes or {})}
    return {METADATA: json.dumps(said, sort_keys=True)}


def load_weights(network: nn.Module, path: Path, hint: str) -> float:
    """Load a safetensors file into a network, which is built as it states, strictly; the temperature by which its
    log-odds are divided. hint: what makes such a file, for the errors. Raises NetworkFileError where it is absent,
    unreadable, or of another network."""
    if not path.is_file():
        raise NetworkFileError(f"{path} does not exist: {hint}")
    try:
        with safe_open(path, framework="pt") as file:
            said, state = file.metadata() or {}, {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise NetworkFileError(f"{path} is no safetensors file ({error}): {hint}") from error
    temperature = _checked(network, path, said)
    try:
        network.load_state_dict(state, strict=True)
    except RuntimeError as error:
        raise NetworkFileError(f"{path} does not fit {type(network).__name__}: {error}") from error
    return temperature


class OnnxBackbone:
    """An ONNX file in the place of a network's `backbone`, for one pair without padding at a time."""

    def __init__(self, network: nn.Module, path: Path, hint: str, threads: int = 1) -> None:
        """Raises NetworkFileError for a file that is absent, cannot be run, or is of another network."""
        self.path, self.hint, self.threads = path, hint, threads
        session = onnx_session(path, threads, hint)
        by_verb = {"takes": session.get_inputs(), "gives": session.get_outputs()}
        shapes = {verb: [(a.name, a.type, len(a.shape)) for a in arguments] for verb, arguments in by_verb.items()}
        if shapes != {"takes": [(INPUT, "tensor(float)", 3)], "gives": [(OUTPUT, "tensor(float)", 3)]}:
            wanted = f"a pruner's file takes float {INPUT} (1, channels, N) and gives {OUTPUT} (1, K, N): {hint}"
            raise NetworkFileError(f"{path} takes {shapes['takes']} and gives {shapes['gives']}; {wanted}")
        self.temperature = _checked(network, path, session.get_modelmeta().custom_metadata_map)

    def __call__(self, x: Float[Tensor, "1 channels n"], slots: Slots) -> Float[Tensor, "1 outputs n"]:
        """The backbone's result, on x's device; computed on the CPU."""
        if slots.mask is not None or len(x) != 1:
            raise ValueError("an ONNX backbone takes one pair without padding at a time")
        array = x.detach().to("cpu", torch.float32).contiguous().numpy()
        session = onnx_session(self.path, self.threads, self.hint)
        return torch.from_numpy(session.run([OUTPUT], {INPUT: array})[0]).to(x.device)


def _checked(network: nn.Module, path: Path, said: Mapping[str, str]) -> float:
    """The temperature that a file's metadata says. Raises NetworkFileError where it states another network, or none."""
    if METADATA not in said:
        raise NetworkFileError(f"{path} does not state its network: fmtorch.training.export makes such files")
    try:
        content = json.loads(said[METADATA])
        stated, temperature, _ = content["network"], float(content["temperature"]), content["notes"]
    except (ValueError, TypeError, KeyError) as error:
        raise NetworkFileError(f"{path}: its metadata cannot be read: {error!r}") from error
    if not (temperature > 0 and math.isfinite(temperature)):
        raise NetworkFileError(f"{path}: temperature {temperature}; it has to be positive")
    expected = stated_network(network)
    if stated != expected:
        both = f"{path} holds {stated}, the preset names {expected}"
        raise NetworkFileError(f"{both}: take the file's options, or train this one")
    return temperature


Backbone = Callable[[Tensor, Slots], Tensor]  # (B, channels, N), zero in masked slots -> (B, outputs, N)


class Prediction(NamedTuple):
    """The output of a network over S stages (one, or one for each iteration); the last stage counts.
    logit: log-odds that a match is an inlier, (S, B, N); finite and without meaning in masked slots. weight: of the
    match in a weighted 8-point fit, (T, B, N), of T stages; not negative, 0 where masked. F: fundamental matrices that
    the network fits itself, (T, B, 3, 3), float64, in pixels and of unit Frobenius norm; where a fit is not determined
    the one of the stage before, or zero; None where the network fits none. judged: matches whose log-odds a stage is
    trained on, (S, B, N), as those that are not pruned before it; None: all."""

    logit: Float[Tensor, "stages b n"]
    weight: Float[Tensor, "fits b n"]
    F: Float[Tensor, "fits b 3 3"] | None = None
    judged: Bool[Tensor, "stages b n"] | None = None


class Exportable(Protocol):
    """A network whose parameters all belong to its `backbone`, a function of tensors: ONNX Runtime can take its place.
    input_channels: of the backbone. options: the arguments that build the network, which its files state."""

    backbone: Any
    input_channels: int
    options: Mapping[str, Any]

    def predict(self, c: Correspondences, backbone: Backbone) -> Prediction:
        """The prediction, with `backbone` or what takes its place."""
        ...


def exportable(network: nn.Module) -> bool:
    """Whether a network is `Exportable`: `isinstance` does not see the submodules of a Module from Python 3.12 on."""
    return all(hasattr(network, name) for name in ("backbone", "input_channels", "options", "predict"))


def predict(network: nn.Module, c: Correspondences) -> Prediction:
    """What any network says of a batch: one that returns log-odds (B, N) alone gets weights of ``tanh(relu(logit))``.
    Raises TypeError or ValueError where the network returns something else, RuntimeError where it ends the program."""
    output = stages.called("c", network, c)
    if isinstance(output, Prediction):
        return output
    if not isinstance(output, Tensor):
        name, kind = type(network).__name__, type(output).__name__
        raise stages.WrongPart(f"{name} returns {kind}; a network of matches returns log-odds or Prediction")
    if output.shape != c.mask.shape:
        of = f"log-odds of shape {tuple(output.shape)} for matches of shape {tuple(c.mask.shape)}"
        raise ValueError(f"{type(network).__name__} returns {of}; there must be one for each match")
    return Prediction(output[None], torch.where(c.mask, torch.tanh(torch.relu(output)), 0)[None])


RUNTIMES = ("auto", *SUFFIXES)
COMMAND = "fmtorch train pruner=NAME makes it, with the name of the preset"


class LearnedPruner:
    """P(inlier) by a network; below `threshold` matches are dropped, and `prior` hands it to the estimator.

    Each pair goes through the network alone, without its padding and without gradients, so that its result has the same
    bits in any batch. Matches that are not finite have P = 0.

    Args:
        network: maps `Correspondences` to log-odds (B, N) or a `Prediction`.
        file: its learned file, see `learned_file`. None: the network, of which a copy is taken, stays as it is.
        runtime: "torch" reads .safetensors; "onnx" reads .onnx, computes on the CPU, and takes networks that are
            `Exportable`; "auto" goes by the suffix or, without one, takes .onnx on a CPU if it is there.
        threshold: least P of a match that survives. None: all do.
        prior: whether to supply the prior.
        soft: in place of the two: supply the prior and drop nothing.
        temperature: by which log-odds are divided; None: as the file says, or 1.
        threads: of ONNX Runtime.
        command: what makes the file, said where it is missing.

    Raises:
        ValueError: for unknown or contradicting options. NetworkFileError, one too, at first use: as `load_weights`.
    """

    def __init__(
        self, network: nn.Module, *, file: str | Path | None = None, runtime: str = "auto",
        threshold: float | None = None, prior: bool = True, soft: bool = False, temperature: float | None = None,
        threads: int = 1, command: str = COMMAND,
    ) -> None:  # fmt: skip
        if runtime not in RUNTIMES:
            raise ValueError(f"runtime={runtime}; there are: {', '.join(RUNTIMES)}")
        threshold, prior = (None, True) if soft else (threshold, prior)
        if threshold is None and not prior:
            raise ValueError("a learned pruner with threshold=None and prior=False would do nothing")
        if threshold is not None and not 0 <= threshold <= 1:
            raise ValueError(f"threshold={threshold}: the least P(inlier) of a match, from 0 to 1")
        if temperature is not None and not temperature > 0:
            raise ValueError(f"temperature={temperature}: log-odds are divided by it, so it must be positive")
        suffix = "" if file is None else Path(file).suffix
        if runtime != "auto" and suffix in SUFFIXES.values() and suffix != SUFFIXES[runtime]:
            raise ValueError(f"runtime={runtime} reads {SUFFIXES[runtime]}, not {file}")
        if not exportable(network) and "onnx" in (runtime, suffix.removeprefix(".")):
            raise ValueError(f"{type(network).__name__} is not `Exportable`: it runs with runtime=torch and a "
                             "file .safetensors")  # fmt: skip
        if file is None and runtime == "onnx":
            raise ValueError("runtime=onnx needs a `file`")
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self.file, self.runtime, self.threads, self.command = file, runtime, threads, command
        self.threshold, self.prior, self.temperature = threshold, prior, temperature
        self._ready: dict[str, tuple[Any, float]] = {}

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only likely ones survive, or with ``prior``, zero where masked."""
        p = self.probability(c)
        if self.prior:
            c = c.replace(prior=p)
        return c if self.threshold is None else c.keep(p >= self.threshold)

    def open_file(self, device: torch.device) -> None:
        """Read the learned file now. Raises NetworkFileError where it cannot be used."""
        if self.file is not None:
            self._prepared(self._runtime(device), device)

    @torch.no_grad()
    def probability(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """P(inlier) of each match, in the type of x0; zero where masked."""
        mask = c.mask & torch.isfinite(c.x0).all(-1) & torch.isfinite(c.x1).all(-1)
        p = torch.zeros_like(c.x0[..., 0])
        for i, count in enumerate(mask.sum(1).tolist()):
            if count:
                p[i, mask[i]] = self._alone(c[i].keep(mask[i : i + 1]).compact())
        return p

    def _alone(self, c: Correspondences) -> Float[Tensor, " n"]:
        runtime = self._runtime(c.x0.device)
        ready, temperature = self._prepared(runtime, c.x0.device)
        prediction: Prediction = (
            self.network.predict(c, ready) if runtime == "onnx" else predict(ready, c)  # type: ignore[operator]
        )
        p = torch.sigmoid(prediction.logit[-1, 0] / temperature).to(c.x0.dtype)
        return torch.where(torch.isfinite(p), p, 0)

    def _prepared(self, runtime: str, device: torch.device) -> tuple[Any, float]:
        """The network on a device, or the backbone that takes its backbone's place; and the temperature."""
        key = runtime if runtime == "onnx" else str(device)
        if key not in self._ready:  # two threads may do this at once, with equal results
            stated = 1.0
            ready: Any = self.network
            if runtime == "onnx":
                ready = OnnxBackbone(self.network, self._path(runtime), self.command, self.threads)
                stated = ready.temperature
            else:
                ready = copy.deepcopy(self.network)
                if self.file is not None:
                    stated = load_weights(ready, self._path(runtime), self.command)
                ready = ready.to(device).eval()
            self._ready[key] = ready, stated if self.temperature is None else self.temperature
        return self._ready[key]

    def _path(self, runtime: str) -> Path:
        assert self.file is not None
        return learned_file(self.file, runtime)

    def _runtime(self, device: torch.device) -> str:
        if self.runtime != "auto" or self.file is None:
            return "torch" if self.file is None else self.runtime
        suffix = Path(self.file).suffix
        if suffix in SUFFIXES.values():
            return next(name for name, s in SUFFIXES.items() if s == suffix)
        fits = device.type == "cpu" and exportable(self.network) and self._path("onnx").is_file()
        return "onnx" if fits else "torch"

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_ready": {}}

    @property
    def identity(self) -> dict[str, object]:
        """What defines the results. Raises NetworkFileError for a learned file that is absent."""
        options = {"threshold": self.threshold, "prior": self.prior, "temperature": self.temperature}
        if self.file is None:
            return {**options, "network": self.network}
        runtime = self._runtime(torch.device("cpu"))
        if not self._path(runtime).is_file():
            raise NetworkFileError(f"{self._path(runtime)} does not exist: {self.command}")
        weights = [path for path in map(self._path, SUFFIXES) if path.is_file()]
        return {**options, "runtime": self.runtime, "network": [type(self.network), repr(self.network)],
                "files": weights}  # fmt: skip
