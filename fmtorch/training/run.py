"""`fmtorch train`: a composed config -> labelled matches, a network trained by Lightning, its files and its card.

What is already done is taken up again, whatever ended the last attempt."""

import dataclasses
import functools
import hashlib
import itertools
import logging
import os
import platform
import re
import shlex
import signal
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, EarlyStopping, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray
from omegaconf import DictConfig
from rich.progress import Progress
from torch import Tensor, nn
from torch.utils.data import DataLoader

from fmtorch import data, presets
from fmtorch.core import expect_options, files, terminal
from fmtorch.core.stages import WrongPart, name_of
from fmtorch.core.version import __version__
from fmtorch.data import ImagePair, PairDataset, construction, read_image
from fmtorch.data.pairs import PairSubset
from fmtorch.evaluation.run import select
from fmtorch.io import H5Pairs, h5
from fmtorch.pipeline import pictures
from fmtorch.presets.composition import execution_of, plain, read_fields
from fmtorch.pruning.networks.learned import predict
from fmtorch.runs import identity_digest
from fmtorch.scenes import RenderedPairs
from fmtorch.training.export import Evaluation, Use, Validation, expect_figure, quiet, write_result
from fmtorch.training.labelled import Augmentation, LabelledMatches, keep_ratio
from fmtorch.training.matched_pairs import MatchedPairs, NamedPairs, OANetPairs, stages_before_estimation
from fmtorch.training.objective import Objective
from fmtorch.training.options import Optimisation, TrainOptions
from fmtorch.training.planes import Photograph, PlanePairs, list_photographs
from fmtorch.training.stored_matches import QUARTER, StoredMatches, last_scenes, training_batches

CHECKPOINTS, BEST, LOGS = "checkpoints", "best.ckpt", "logs"
SMALLER_IS_BETTER = ("log_loss", "calibration_error")  # figures of validation; of the others larger is
PICTURE_HEIGHT = 480  # px
QUIET = ("lightning.pytorch", "lightning.fabric")  # loggers, whose advice does not apply here


class Diverged(FloatingPointError, ValueError):
    """A loss or a gradient that is not finite: the network's output, or too high a learning rate."""


class PrunerTraining(lightning.LightningModule):
    """Trains a network that tells P(inlier)."""

    def __init__(
        self, network: nn.Module, objective: Objective, optimisation: Optimisation, validation: Validation
    ) -> None:
        super().__init__()
        self.network, self.objective, self.optimisation = network, objective, optimisation
        self.validation = validation
        self.evaluation: Evaluation | None = None
        self._seconds, self._started = 0.0, time.perf_counter()

    @property
    def seconds(self) -> float:
        """Spent on the training so far, in this and earlier attempts."""
        return self._seconds + time.perf_counter() - self._started

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["seconds"] = self.seconds

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self._seconds, self._started = float(checkpoint.get("seconds", 0.0)), time.perf_counter()

    def training_step(self, batch: LabelledMatches, index: int) -> Tensor:
        """The loss of a batch. Raises FloatingPointError where it is not finite: no step is skipped in silence."""
        terms = self.objective(predict(self.network, batch.correspondences), batch, self.global_step)
        if not terms["loss"].requires_grad:
            raise WrongPart(f"{name_of(self.network)}: its log-odds carry no gradient to its parameters")
        if not bool(torch.isfinite(terms["loss"])):
            values = {name: float(value) for name, value in terms.items()}
            raise Diverged(f"the loss of step {self.global_step} is not finite: {values}")
        self.log_dict({f"train/{name}": value.detach() for name, value in terms.items()}, batch_size=len(batch))
        return terms["loss"]

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        norms = [p.grad.norm() for p in self.network.parameters() if p.grad is not None]
        total = torch.stack(norms).norm() if norms else torch.zeros(())
        scaler = getattr(self.trainer.precision_plugin, "scaler", None)  # which skips a step that overflowed, as meant
        if not bool(torch.isfinite(total)) and scaler is None:
            raise Diverged(f"the gradient of step {self.global_step} is not finite")
        self.log("train/gradient_norm", total)

    def validation_step(self, batch: Any, index: int) -> None:
        """All of validation, in one step; on rank zero's pairs, the same on every rank."""
        self.evaluation = self.validation(self.network)
        self.log_dict({f"validation/{k}": v for k, v in self.evaluation.figures.items()}, batch_size=1, sync_dist=True)

    def configure_optimizers(self) -> Any:
        o = self.optimisation
        adam = torch.optim.Adam(self.network.parameters(), lr=o.learning_rate, weight_decay=o.weight_decay)
        schedule = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: o.factor(step))
        return {"optimizer": adam, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def latest_checkpoint(folder: Path) -> tuple[Path | None, int]:
    """The checkpoint of most steps that can be read, and its steps; (None, 0) where there is none."""
    names = ((re.fullmatch(r"step=(\d+)", path.stem), path) for path in (folder / CHECKPOINTS).glob("step=*.ckpt"))
    for step, path in sorted(((int(match[1]), path) for match, path in names if match), reverse=True):
        try:
            torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # torch.load raises nearly anything for damaged bytes; an older file may do
            warnings.warn(f"{path} cannot be read and is passed over ({error})", stacklevel=2)
            continue
        return path, step
    return None, 0


def load_best(folder: Path, module: PrunerTraining) -> int:
    """Give a module the best weights that validation saw; returns their step. Raises FileNotFoundError without any."""
    best = torch.load(folder / CHECKPOINTS / BEST, map_location="cpu", weights_only=True)
    module.load_state_dict(best["state_dict"])
    return int(best["global_step"])


def train(
    module: PrunerTraining, batches: Callable[[int, int, int], DataLoader[Any]], folder: Path,
    trainer: Mapping[str, Any], *, every: int, checkpoint_every: int, patience: int | None, monitor: str,
    callbacks: tuple[Callback, ...] = (),
) -> tuple[int, float]:  # fmt: skip
    """Train in `folder`, going on from its last checkpoint; returns the steps and seconds made in all.
    batches: from (step, rank, processes) to the training batches from that step on, which must always be the same.
    folder: keeps checkpoints and TensorBoard's logs. trainer: further arguments of lightning.Trainer. every,
    checkpoint_every: steps between two validations, and two checkpoints. patience: validations without a better figure
    after which training ends; None: never. monitor: the figure of validation that chooses the best weights."""
    path, step = latest_checkpoint(folder)
    figure, mode = f"validation/{monitor}", "min" if monitor in SMALLER_IS_BETTER else "max"
    total, every = module.optimisation.steps, min(every, module.optimisation.steps)
    kept = _ResumableCheckpoint(
        folder / CHECKPOINTS, "{step}", save_top_k=1, monitor="step", mode="max", every_n_train_steps=checkpoint_every,
        enable_version_counter=False, save_on_train_epoch_end=False, validated_every=every,
    )  # fmt: skip
    chosen: dict[str, Any] = {"monitor": figure, "mode": mode, "save_weights_only": True}
    best = ModelCheckpoint(folder / CHECKPOINTS, "best", enable_version_counter=False, **chosen)
    stop = [] if patience is None else [EarlyStopping(figure, mode=mode, patience=patience, strict=True)]
    with quiet(QUIET, logging.WARNING), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(does not have many workers|exists and is not empty).*")
        warnings.filterwarnings("ignore", category=FutureWarning, module="lightning.*")
        lightning_trainer = lightning.Trainer(
            max_steps=total, max_epochs=1, val_check_interval=every, check_val_every_n_epoch=None,
            num_sanity_val_steps=0, log_every_n_steps=min(10, every), default_root_dir=folder,
            logger=TensorBoardLogger(folder, name=LOGS, version=""), use_distributed_sampler=False,
            callbacks=[best, kept, *stop, _TrainingBar(total, monitor), *callbacks],
            enable_progress_bar=False, enable_model_summary=False, deterministic=True, **trainer,
        )  # fmt: skip
        if step < total:
            own = batches(step, lightning_trainer.global_rank, lightning_trainer.world_size)
            once: Any = [0]  # one item, for the one step of validation, which has its own pairs
            validation: DataLoader[Any] = DataLoader(once, batch_size=None)
            alone = lightning_trainer.world_size == 1 and threading.current_thread() is threading.main_thread()
            before = signal.signal(signal.SIGINT, kept.interrupt) if alone else None
            try:
                lightning_trainer.fit(module, own, validation, ckpt_path=path, weights_only=True)
            except SystemExit:  # which Lightning makes of Ctrl-C
                reached = latest_checkpoint(folder)[1]
                raise KeyboardInterrupt(f"step {reached} of {total} is kept in {folder}") from None
            finally:
                if before is not None:
                    signal.signal(signal.SIGINT, before)
            step = lightning_trainer.global_step
    return step, module.seconds


class _ResumableCheckpoint(ModelCheckpoint):
    """Checkpoints at every so many steps, and at the end of one in which Ctrl-C comes: at a step of validation when
    that is done, its best figure included. Lightning saves before it validates, and would go on without that."""

    def __init__(self, *args: Any, validated_every: int, **options: Any) -> None:
        super().__init__(*args, **options)
        self.validated_every, self.interrupted = validated_every, False

    def interrupt(self, *_: Any) -> None:
        """Handle the first Ctrl-C; a second one ends at once."""
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self.interrupted = True
        terminal.console.print("ends after this step, which is kept; Ctrl-C again ends at once", soft_wrap=True)

    def _save_if_due(self, trainer: lightning.Trainer) -> None:
        if self.interrupted and trainer.global_step % self._every_n_train_steps:
            self._save_topk_checkpoint(trainer, self._monitor_candidates(trainer))
        else:
            super().on_train_batch_end(trainer, trainer.lightning_module, {}, None, 0)

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        if trainer.global_step % self.validated_every:
            self._save_if_due(trainer)
            if self.interrupted:
                raise KeyboardInterrupt

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Save after a validation; that of the best weights comes before in the list of callbacks."""
        self._save_if_due(trainer)
        super().on_validation_end(trainer, pl_module)  # what the last batch puts off
        if self.interrupted:
            raise KeyboardInterrupt


class _TrainingBar(Callback):
    """The progress bar of a training, earlier attempts included: steps of `total`, loss, the best of `monitor`."""

    def __init__(self, total: int, monitor: str) -> None:
        self.total, self.monitor, self._figure = total, monitor, ""
        self._progress: Progress | None = None

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        if trainer.is_global_zero:
            self._progress = terminal.progress_bars()
            self._progress.start()
            self._progress.add_task("training", total=self.total, completed=trainer.global_step)

    def on_train_batch_end(self, trainer: lightning.Trainer, pl_module: Any, outputs: Any, *_: Any) -> None:
        if self._progress is not None:
            loss = outputs["loss"] if isinstance(outputs, dict) else outputs
            text = f"training: loss {float(loss):.3f}{self._figure}"
            self._progress.update(self._progress.task_ids[0], completed=trainer.global_step, description=text)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        value = trainer.callback_metrics.get(f"validation/{self.monitor}")
        if value is not None:
            self._figure = f", {self.monitor} {float(value):.3f}"

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        if self._progress is not None:
            self._progress.stop()
            self._progress = None


class ValidationPictures(Callback):
    """Draws some validation pairs, batches of one: matches with P(inlier) >= 0.5 green, the others thin and red."""

    def __init__(self, pairs: Sequence[tuple[ImagePair, LabelledMatches]]) -> None:
        self.pairs = list(pairs)

    @torch.no_grad()
    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        assert isinstance(pl_module, PrunerTraining)
        if not isinstance(trainer.logger, TensorBoardLogger) or not trainer.is_global_zero:
            return
        board = trainer.logger.experiment
        for pair, matches in self.pairs:
            picture = classified(pair, matches, pl_module.network)
            board.add_image(pair.identity, picture, trainer.global_step, dataformats="HWC")


@torch.no_grad()
def classified(pair: ImagePair, matches: LabelledMatches, network: torch.nn.Module) -> NDArray[np.uint8]:
    """The two images of a pair with its matches as a network classifies them; RGB (H, W, 3)."""
    device = next((p.device for p in network.parameters()), torch.device("cpu"))
    training = network.training
    network.eval()
    c = matches.correspondences
    kept = (predict(network, c.to(device)).logit[-1, 0] >= 0).cpu().numpy()
    network.train(training)
    inside = c.mask[0].numpy()
    x0, x1 = (x[0].double().numpy()[inside] for x in (c.x0, c.x1))
    image0, image1 = read_image(pair.image0), read_image(pair.image1)
    names = ("P(inlier) >= 0.5", "below")
    return pictures.draw_matches(image0, image1, x0, x1, kept[inside], height=PICTURE_HEIGHT, names=names)


FEW = 500  # pairs to train on, below which no useful network is to be expected
MORE = "give more of your own, or dataset=rendered dataset.size=full, which renders 3,200"
PICTURES = 4  # validation pairs that are drawn into the log


def run(config: DictConfig, name: str) -> Path:
    """Train what a composed config describes and return the folder of the result.
    Started again, it goes on from the last checkpoint; a finished training only writes its files anew. name: of the
    pruner's preset, e.g. ``lc``. Raises ValueError for options that cannot be."""
    options = read_fields(TrainOptions, config)
    expect_options(lightning.Trainer, plain(config.trainer), "trainer")
    presets.expect_buildable(plain(config.dataset), "dataset")
    presets.expect_stages(config)
    network_config = network_of(config, name)
    objective = Objective(**dataclasses.asdict(options.objective))
    uses = {key: use_of(key, value) for key, value in options.validation.uses.items()}
    expect_figure(options.validation.monitor, uses)
    with terminal.progress_bars() as progress:
        matches = labelled_matches(config, options, progress)
    identity = {
        "network": network_config, "objective": dataclasses.asdict(objective), "batch": config.batch,
        "optimisation": dataclasses.asdict(options.optimisation), "augmentation": plain(config.augmentation),
        "seed": config.seed, "matches": matches.digest, "version": __version__, "trainer": plain(config.trainer),
        "validation": {k: v for k, v in plain(config.validation).items() if k != "roots"},
    }  # fmt: skip
    folder = Path(config.output or f"runs/train/{name}-{identity_digest(identity)[:8]}")
    files.claim(folder / "training.json", identity, "checkpoints", "choose another output")
    torch.set_num_threads(int(config.threads or os.cpu_count() or 1))
    torch.manual_seed(config.seed)
    network = presets.instantiate(network_config, f"pruner={name}, network")
    validation = Validation([m for _, m in matches.validation], uses, [p.family for p, _ in matches.validation])
    module = PrunerTraining(network, objective, options.optimisation, validation)
    first = int(os.environ.get("LOCAL_RANK", "0")) == 0  # of several processes the one that reports
    if first:
        about = f"pairs to train on: {len(matches.training)}, to validate on: {len(matches.validation)}"
        about += f" (validation.pairs={options.validation.pairs} of each family at most); {folder}"
        terminal.console.print(about, soft_wrap=True)
        if len(matches.training) < FEW:
            few = "so few pairs" if options.limit is None else f"so few pairs (limit={options.limit} of each family)"
            terminal.console.print(f"{few} show that it runs, and teach little; {MORE}", soft_wrap=True)
    pictured = [(p, m) for p, m in matches.validation if p.image0.path.is_file() and p.image1.path.is_file()]
    shown = pictured[:: max(1, len(pictured) // PICTURES)][:PICTURES]
    batches = functools.partial(training_batches, matches.training, config.batch, config.seed, workers=config.loaders)
    how: dict[str, Any] = {name: getattr(options.validation, name) for name in ("every", "patience", "monitor")}
    how |= {"checkpoint_every": options.checkpoint_every, "callbacks": (ValidationPictures(shown),)}
    steps, seconds = train(module, batches, folder, plain(config.trainer), **how)
    if first:
        processor = f"{os.cpu_count()} cores of {platform.processor() or platform.machine()}"
        facts = {**identity, "steps": steps, "seconds": seconds, "data": matches.description, "processor": processor}
        facts["best_step"] = load_best(folder, module)
        report(name, *write_result(folder, name, module.network, validation, facts))
    return folder


def report(name: str, files: Sequence[Path], figures: Mapping[str, float]) -> None:
    """Say on the terminal what came out and how to use it."""
    for key, value in figures.items():
        terminal.console.print(f"{key:32} {value:.4f}")
    terminal.console.print(", ".join(str(path) for path in files), soft_wrap=True)
    terminal.console.print(f"use it: {use_line(name, files[0], sys.argv[1:])}", soft_wrap=True)


def use_line(name: str, file: Path, words: Sequence[str]) -> str:
    """The command that uses a learned file as a prior, by which it serves best. words: of the training's command.
    Options are given with ``++``, since a preset of a user's own need not have them."""
    folders = [shlex.quote(b) for a, b in itertools.pairwise(words) if a in ("--config-dir", "-cd")]
    folders += [shlex.quote(word.partition("=")[2]) for word in words if word.startswith("--config-dir=")]
    network = [shlex.quote(word) for word in words if word.lstrip("+").startswith(f"pruner.{name}.network.")]
    values = [f"++pruner.{name}.file={shlex.quote(str(file))}", *network, f"++pruner.{name}.soft=true"]
    start = " ".join(["python -m fmtorch.eval", *(f"--config-dir {folder}" for folder in folders)])
    return f"{start} pipeline=sift_ratio estimator=fmtorch 'pruner=[ratio,one_to_one,{name}]' {' '.join(values)}"


def network_of(config: DictConfig, name: str) -> dict[str, Any]:
    """The config of the network that a pruner's preset names. Raises ValueError where there is none."""
    pruners = plain(config.pruner)
    chosen = pruners if "_target_" in pruners else next(iter(pruners.values()), {}) if len(pruners) == 1 else {}
    network = chosen.get("network") if isinstance(chosen, Mapping) else None
    if not isinstance(network, Mapping) or "_target_" not in network:
        needs = "its preset must have a `network` with a `_target_`, as lc has"
        raise ValueError(f"pruner={name} has nothing to train: {needs}")
    return {str(key): value for key, value in network.items()}


def use_of(name: str, options: Mapping[str, Any]) -> Use:
    """A way of using P(inlier) from its config: an estimator's preset, and a threshold or null."""
    unknown = sorted(set(options) - {"estimator", "threshold"})
    if unknown or "estimator" not in options:
        raise ValueError(f"validation.uses.{name}: it has `estimator` and may have `threshold`, no {unknown}")
    return Use(presets.build("estimator", str(options["estimator"])), options.get("threshold"))


class Matches(NamedTuple):
    """Labelled matches to train on, and to validate on with their pairs; their digest; what a card says of them."""

    training: StoredMatches
    validation: list[tuple[ImagePair, LabelledMatches]]
    digest: str
    description: dict[str, str]


def labelled_matches(config: DictConfig, options: TrainOptions, progress: Progress) -> Matches:
    """The matches of the config's data set, split by scenes, and of further validation sets. ValueError without any."""
    photographs, given, validated = list[Photograph](), config.photographs, options.validation
    if options.planes.photographs is not None:
        photographs = list_photographs(options.planes.photographs, given.sources, given.excluded)
    dataset = _dataset(config, options, progress)
    by_image = not validated.roots and not isinstance(dataset, NamedPairs)
    chosen, held_out = _split(dataset, validated.scenes, by_image)
    chosen = _limited(dataset, chosen, config.limit)
    if not chosen:
        raise ValueError("no pairs to train on: the scenes are for validation; give a smaller validation.scenes")

    def matched(source: PairDataset, indices: Sequence[int], what: str) -> StoredMatches:
        if isinstance(source, NamedPairs):
            return source.matches.select(indices)
        labels = "pixels" if isinstance(source, PlanePairs) else options.labels
        return MatchedPairs(
            PairSubset(source, indices) if len(indices) < len(source) else source, stages_before_estimation(config),
            execution=execution_of(config, config.workers).decided(False),
            build=functools.partial(stages_before_estimation, config),
            progress=terminal.reporter(progress, f"matches {what}"), labels=labels,
        )  # fmt: skip

    sets = [(dataset, held_out, "to validate on")]
    for root in validated.roots:
        path = Path(root).expanduser()
        of_matches = path.suffix in h5.SUFFIXES or any(file.suffix in h5.SUFFIXES for file in path.glob("*"))
        real = _oanet_pairs(path, config, options) if of_matches else data.load("fmbench", root=root)
        sets.append((real, list(range(len(real))), f"of {root}"))
    training = matched(dataset, chosen, "to train on")
    digests, validation = [training.digest], list[tuple[ImagePair, LabelledMatches]]()
    for source, indices, what in sets:
        if selected := _limited(source, indices, validated.pairs):
            stored = matched(source, selected, what)
            digests.append(stored.digest)
            pairs = {source[i].key: source[i] for i in selected}
            for i, about in enumerate(stored.pairs):
                validation.append((pairs[about["key"]], keep_ratio(stored.stored(i), validated.ratio).compact()))
    if not validation:
        raise ValueError("no pairs to validate on: give validation.scenes or validation.roots")
    families = Counter(pair.family for pair, _ in validation)
    description = {
        "training": f"{len(training)} pairs of {_scenes(training)} scenes of {dataset.name}",
        "validation": ", ".join(f"{count} pairs of {family}" for family, count in families.items())
        + f" (of {dataset.name} the last scenes of each family, which may share photographs with the training scenes; "
        "of one scene the last images)",
    }
    if photographs:
        workers, report = config.workers or os.cpu_count() or 1, terminal.reporter(progress, "views of photographs")
        drawn = PlanePairs(photographs, options.planes.limits, options.planes.seed, workers=workers, progress=report)
        planes = matched(drawn, range(len(drawn)), "of photographs")
        planes = planes.select(i for i, about in enumerate(planes.pairs) if about["inliers"] > construction.ENOUGH)
        digests.append(planes.digest)
        description["training"] += f" and {len(planes)} pairs of {_scenes(planes)} photographs seen as planes"
        training = training.joined(planes)
    augmented = training.augmented(Augmentation(**dataclasses.asdict(options.augmentation)), config.seed)
    return Matches(augmented, validation, hashlib.sha256(" ".join(digests).encode()).hexdigest(), description)


def _dataset(config: DictConfig, options: TrainOptions, progress: Progress) -> PairDataset:
    """The data set to train on; of the embedded one always the training side."""
    chosen = plain(config.dataset)
    target = presets.target_of(chosen, "dataset")
    if target is H5Pairs and chosen["layout"] == "oanet":
        root = data.files.given_root(chosen["root"], "h5", "the file, or the folder of the files")
        return _oanet_pairs(root, config, options)
    if target is RenderedPairs:
        chosen["split"] = "train"
    return data.build(chosen, terminal.reporter(progress, "drawing scenes"))


def _oanet_pairs(root: Path, config: DictConfig, options: TrainOptions) -> NamedPairs:
    """The pairs of OANet's files, without reading them. Raises DataError where they lack ratios that are asked for."""
    before: list[Any] = [presets.build("pruner", str(name)) for name in config.before]
    pairs = OANetPairs(root, labels=options.labels, before=before)
    if options.augmentation.ratio is not None or options.validation.ratio < 1:
        pairs.expect_ratios("without them give augmentation.ratio=null validation.ratio=1")
    return NamedPairs(pairs)


def _split(dataset: PairDataset, last: int | None, by_image: bool) -> tuple[list[int], list[int]]:
    """Indices of the pairs to train on, and of those in the last scenes of each family. by_image: where each family has
    one scene, of those among its last quarter of images; pairs that join images of both sides are in neither."""
    pairs = [dataset[i] for i in range(len(dataset))]
    scenes = [(pair.family, pair.scene) for pair in pairs]
    held = last_scenes(scenes, last)
    if held or not by_image:
        sides = [2 * (scene in held) for scene in scenes]
    else:
        images = dict[tuple[str, str], set[str]]()
        ends = [(pair.image0.identity, pair.image1.identity) for pair in pairs]
        for scene, own in zip(scenes, ends, strict=True):
            images.setdefault(scene, set()).update(own)
        late = {name for names in images.values() for name in sorted(names)[-max(1, len(names) // QUARTER) :]}
        sides = [sum(name in late for name in own) for own in ends]
    return [i for i, n in enumerate(sides) if n == 0], [i for i, n in enumerate(sides) if n == 2]


def _limited(dataset: PairDataset, indices: list[int], limit: int | None) -> list[int]:
    """At most `limit` pairs of each family, chosen by their keys."""
    index = {dataset[i].key: i for i in indices}
    return sorted(index[pair.key] for pair in select([dataset[i] for i in indices], limit))


def _scenes(matches: StoredMatches) -> int:
    return len({about["scene"] for about in matches.pairs})
