"""Learned pruners: a network and its learned file as a stage, which drops matches or supplies their prior."""

import copy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.core.onnx_network import NetworkFileError
from fmtorch.core.types import Correspondences
from fmtorch.pruning.networks.files import SUFFIXES, OnnxBackbone, learned_file, load_weights
from fmtorch.pruning.networks.layers import Slots

Backbone = Callable[[Tensor, Slots], Tensor]  # (B, channels, N), zero in masked slots -> (B, outputs, N)


class Prediction(NamedTuple):
    """The output of a network over S stages (one, or one for each iteration); the last stage counts.

    logit: log-odds that a match is an inlier, (S, B, N); finite and without meaning in masked slots.
    weight: of the match in a weighted 8-point fit, (S, B, N); not negative, 0 where masked.
    F: fundamental matrices that the network fits itself, (S, B, 3, 3), float64, in pixels and of unit Frobenius norm;
    where a fit is not determined the one of the stage before, or zero; None where the network fits none.
    """

    logit: Float[Tensor, "stages b n"]
    weight: Float[Tensor, "stages b n"]
    F: Float[Tensor, "stages b 3 3"] | None = None


@runtime_checkable
class Exportable(Protocol):
    """A network whose parameters all belong to its `backbone`, a function of tensors: ONNX Runtime can take its place.

    input_channels: of the backbone. options: the arguments that build the network, which its files state.
    """

    backbone: Any
    input_channels: int
    options: Mapping[str, Any]

    def predict(self, c: Correspondences, backbone: Backbone) -> Prediction:
        """The prediction, with `backbone` or what takes its place."""
        ...


def predict(network: nn.Module, c: Correspondences) -> Prediction:
    """What any network says of a batch: one that returns log-odds (B, N) alone gets weights of ``tanh(relu(logit))``.

    Raises TypeError or ValueError where the network returns something else.
    """
    output = network(c)
    if isinstance(output, Prediction):
        return output
    if not isinstance(output, Tensor):
        kind = type(output).__name__
        raise TypeError(f"{type(network).__name__} returns {kind}; a network of matches returns log-odds or Prediction")
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
        file: its learned file: the name of a shipped one, without suffix, or a path; see `learned_file`. None: the
            network, of which a copy is taken, stays as it is.
        runtime: "torch" reads .safetensors; "onnx" reads .onnx, computes on the CPU, and takes networks that are
            `Exportable`; "auto" takes what the file's suffix says or, without one, .onnx on a CPU where there is such a
            file.
        threshold: least P of a match that survives. None: all do.
        prior: whether to supply the prior.
        soft: in place of the two: supply the prior and drop nothing.
        temperature: by which log-odds are divided; None: as the file says, or 1.
        threads: of ONNX Runtime.
        command: what makes the file, said where it is missing.

    Raises:
        ValueError: for unknown or contradicting options. NetworkFileError, a ValueError, at the first use: for a file
            that is absent, unreadable or of another network.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        file: str | Path | None = None,
        runtime: str = "auto",
        threshold: float | None = None,
        prior: bool = True,
        soft: bool = False,
        temperature: float | None = None,
        threads: int = 1,
        command: str = COMMAND,
    ) -> None:
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
        if not isinstance(network, Exportable) and "onnx" in (runtime, suffix.removeprefix(".")):
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
        counts = mask.sum(1).tolist()
        for i, count in enumerate(counts):
            if count:
                p[i, mask[i]] = self._alone(c[i].keep(mask[i : i + 1]).compact())
        return p

    def _alone(self, c: Correspondences) -> Float[Tensor, " n"]:
        """P(inlier) of the matches of one pair without padding."""
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
                stated = ready.file.temperature
            else:
                ready = copy.deepcopy(self.network)
                if self.file is not None:
                    stated = load_weights(ready, self._path(runtime), self.command).temperature
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
        fits = device.type == "cpu" and isinstance(self.network, Exportable) and self._path("onnx").is_file()
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
