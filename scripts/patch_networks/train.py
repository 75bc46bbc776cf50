"""Trains HardNet, L2-Net, GeoDesc or AffNet on corresponding patches of photographs.

python -m scripts.patch_networks.train training=hardnet images=FOLDER photographs.held_out=[SUBFOLDER]
python -m scripts.patch_networks.train training=affnet images=FOLDER photographs=permissive training.options.minutes=20

The patches are cut once into <out>/patches, those of known geometry (training=geodesc) into <out>/tracks; delete that
folder after a change of photographs, of `patches` or of `training.tracks`. The checkpoint <out>/<name>.pt carries what
the model card says; resume=true goes on from it; scripts.patch_networks.export makes the ONNX network and the card.

Every step is a function of the seed and its number, so that a run can be resumed. A batch is points of a whole store,
or matches of pairs of photographs (`MatchSetTraining`, as GeoDesc is trained).
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
import torch
from jaxtyping import Float, Int
from omegaconf import DictConfig
from torch import Tensor, nn

from fmtorch import presets
from fmtorch.core.files import conf_dir, replacing
from fmtorch.core.terminal import console, exits_with_message
from fmtorch.features.networks import build, read_checkpoint
from fmtorch.features.onnx_network import PatchNetwork, network_file
from fmtorch.jit import random
from fmtorch.jit.random import Stream
from fmtorch.presets import plain
from fmtorch.training.planes import PlaneViews, list_photographs
from scripts.patch_networks import objectives, stores
from scripts.patch_networks.objectives import DRAWS, CovarianceObjective, DescriptorObjective, Objective
from scripts.patch_networks.patches import Tolerance, Warps, training_scenes
from scripts.patch_networks.stores import MAX_SIMILARITY, Cutting, PatchStore

OPTIMIZERS: dict[str, Callable[..., torch.optim.Optimizer]] = {
    "adam": torch.optim.Adam,
    "sgd": functools.partial(torch.optim.SGD, momentum=0.9, dampening=0.9),  # as the authors of HardNet do
}


@dataclasses.dataclass(frozen=True)
class TrainingOptions:
    """How a patch network is trained; the learning rate falls linearly to zero over the run.

    batch: points a step, with two patches each. steps: the run's length, or minutes where that is given: wall time that
    this run has spent in all its parts. optimizer: adam or sgd. bf16: autocast to bfloat16. checkpoint_steps,
    log_steps: how often to save, to log.
    """

    batch: int = 512
    steps: int = 5000
    minutes: float | None = None
    optimizer: str = "adam"
    learning_rate: float = 3e-3
    weight_decay: float = 1e-4
    seed: int = 0
    bf16: bool = True
    checkpoint_steps: int = 250
    log_steps: int = 50


class PatchTraining:
    """A network in training: `run` goes on to the end, or until a step; `save` keeps all that is needed."""

    def __init__(
        self, network: nn.Module, objective: Objective, store: PatchStore, options: TrainingOptions,
        description: dict[str, Any] | None = None, device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
        if options.batch > len(store):
            raise ValueError(f"batch={options.batch} is more than the {len(store)} points there are")
        if options.optimizer not in OPTIMIZERS:
            raise ValueError(f"optimizer={options.optimizer}; there are: {', '.join(OPTIMIZERS)}")
        self.network, self.objective, self.store, self.options = network.to(device), objective, store, options
        self.description, self.device = description or {}, torch.device(device)
        rates = {"lr": options.learning_rate, "weight_decay": options.weight_decay}
        self.optimizer = OPTIMIZERS[options.optimizer](self.network.parameters(), **rates)
        self.step, self.seconds, self.losses = 0, 0.0, list[float]()

    def resume(self, path: Path | str) -> None:
        """Go on from a checkpoint of a run with the same options; ValueError names what differs."""
        content = read_checkpoint(path)
        mine, theirs = dataclasses.asdict(self.options), content.get("options", {})
        changed = [k for k, v in mine.items() if k not in ("steps", "minutes") and theirs.get(k) != v]
        if content.get("match_sets") != self.description.get("match_sets"):
            changed.append("match_sets")
        if changed:
            raise ValueError(f"{path} was trained with other {', '.join(changed)}; start anew or take those options")
        self.network.load_state_dict(content["state_dict"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.step, self.seconds, self.losses = content["step"], content["seconds"], list(content["losses"])

    def run(
        self, until: int | None = None, checkpoint: Path | None = None, log: Callable[[str], None] | None = None
    ) -> None:
        """Train to the end, or to the step `until`. Raises FloatingPointError where the loss is no longer finite."""
        o = self.options
        last = time.perf_counter()
        self.network.train()
        while self.progress() < 1 and (until is None or self.step < until):
            for group in self.optimizer.param_groups:
                group["lr"] = o.learning_rate * (1 - self.progress())
            loss = self._one_step()
            if not torch.isfinite(loss):
                raise FloatingPointError(f"the loss is {float(loss)} at step {self.step}: lower the learning rate")
            self.losses.append(float(loss))
            self.step += 1
            now = time.perf_counter()
            self.seconds, last = self.seconds + now - last, now
            if log and self.step % o.log_steps == 0:
                recent = self.losses[-o.log_steps :]
                log(f"step {self.step} loss {sum(recent) / len(recent):.4f} seconds {self.seconds:.0f}")
            if checkpoint and self.step % o.checkpoint_steps == 0:
                self.save(checkpoint)
        if checkpoint:
            self.save(checkpoint)

    def progress(self) -> float:
        o = self.options
        return self.step / o.steps if o.minutes is None else self.seconds / (60 * o.minutes)

    def save(self, path: Path | str, **more: Any) -> None:
        """Write the checkpoint; a file that was there before is replaced when the new one is complete."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        content = {
            "state_dict": self.network.state_dict(), "optimizer": self.optimizer.state_dict(), "step": self.step,
            "seconds": self.seconds, "losses": self.losses, "options": dataclasses.asdict(self.options),
            "data": self.store.description, **self.description, **more,
        }  # fmt: skip
        with replacing(path) as unfinished:
            torch.save(content, unfinished)

    def _one_step(self) -> Tensor:
        o = self.options
        key = torch.tensor([self.step])
        draws = random.uniform(o.seed, key, Stream.TRAINING, 0, o.batch, DRAWS + 2)[0].float()
        torch.manual_seed(int(random.bits(o.seed, key, Stream.TRAINING, o.batch, 1, DRAWS + 2)[0, 0, 0]))  # dropout
        with torch.autocast(self.device.type, torch.bfloat16, enabled=o.bf16):
            loss = self._loss(draws)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        return loss.detach()

    def _loss(self, draws: Float[Tensor, "b k"]) -> Tensor:
        """The loss of this step's patches; `draws` are `DRAWS` random numbers of each point and two more."""
        pairs = self.store.views(self._selected(len(self.store), self.options.batch), draws[:, DRAWS:])
        return self.objective.loss(self.network, pairs.to(self.device), draws.to(self.device))

    def _selected(self, total: int, count: int) -> Int[Tensor, " b"]:
        """This step's points or match sets: each epoch is a random order of all."""
        epoch, i = divmod(self.step, total // count)
        return _order(self.options.seed + 1, epoch, total)[i * count : (i + 1) * count]


@functools.lru_cache(maxsize=2)
def _order(seed: int, epoch: int, total: int) -> Int[Tensor, " n"]:
    return random.bits(seed, torch.tensor([epoch]), Stream.TRAINING, 0, total, 1).flatten().argsort(stable=True)


class MatchSetTraining(PatchTraining):
    """`PatchTraining` on batches of `options.batch` / `matches` match sets, each epoch a random order of all.

    loss: of the descriptors (s, n, d), twice, of match sets and of the S_patch (s, n) of their matches. matches: of
    each set, N_1 of the paper; max_similarity: of the photographs of a pair, above which it is left out.

    Raises ValueError where the store has no geometry, and where the batch is no multiple of `matches`, or larger than
    all sets together.
    """

    def __init__(
        self, network: nn.Module, loss: Callable[..., Tensor], store: PatchStore,
        options: TrainingOptions, description: dict[str, Any] | None = None, device: torch.device | str = "cpu",
        *, matches: int = 64, max_similarity: float = MAX_SIMILARITY,
    ) -> None:  # fmt: skip
        if store.tracks is None:
            raise ValueError("training.match_sets needs patches with their geometry: training.tracks")
        if options.batch % matches:
            raise ValueError(f"batch={options.batch} must be a multiple of match_sets.matches={matches}")
        self.matches, self.criterion = matches, loss
        self.sets = stores.match_sets(store.tracks, matches, max_similarity)
        if options.batch > matches * len(self.sets):
            raise ValueError(f"batch={options.batch} is more than {matches} matches of the {len(self.sets)} sets")
        super().__init__(network, DescriptorObjective(loss), store, options, description, device)  # for its figures

    def _loss(self, draws: Float[Tensor, "b k"]) -> Tensor:
        seed, count = self.options.seed, self.options.batch // self.matches
        chosen = self._selected(len(self.sets), count).tolist()
        numbers = random.uniform(seed + 2, torch.tensor([self.step]), Stream.TRAINING, 0, count, self.matches)[0]
        patches, similarity = self.sets.draw(chosen, self.matches, numbers)
        similarity = similarity.float().to(self.device)

        def criterion(a: Tensor, b: Tensor) -> Tensor:
            a, b = (x.reshape(*similarity.shape, -1) for x in (a, b))
            return self.criterion(a, b, similarity)

        pairs = self.store.pairs(patches.flatten(1)).to(self.device)
        return DescriptorObjective(criterion).loss(self.network, pairs, draws.to(self.device))


def opened_stores(config: DictConfig) -> list[PatchStore]:
    """Training and validation patches, cut now where they are not there yet."""
    opened, given = [], config.photographs
    for side, name in enumerate(("train", "validation")):
        tracks = side == 0 and "tracks" in config.training
        folder = Path(config.out) / ("tracks" if tracks else "patches") / name
        if not folder.exists():
            photographs = list_photographs(config.images, given.sources and list(given.sources), given.excluded)
            photographs += stores.package_photographs() if config.package_images else []
            chosen = stores.split(photographs, given.held_out)[side]
            console.print(f"cutting patches of {len(chosen)} photographs into {folder}")
            patches, cutting = config.patches, cutting_of(config, tracks)
            count, seed = 0 if side else patches.scenes, patches.seed + side
            scenes = training_scenes(count, cutting.views.views, seed)
            stores.build_store(folder, [*chosen, *scenes], cutting, seed, patches.workers)
        opened.append(PatchStore.open(folder))
    return opened


def cutting_of(config: DictConfig, tracks: bool) -> Cutting:
    """How a config cuts patches: of warped photographs, or of photographs as planes, with their geometry."""
    patches: dict[str, Any] = plain(config.patches)
    limits = plain(config.training.tracks)["planes"] if tracks else {**patches["limits"], "views": patches["views"]}
    limits = {name: tuple(value) if isinstance(value, list) else value for name, value in limits.items()}
    points = config.training.tracks.points if tracks else patches["points"]
    views = PlaneViews(**limits) if tracks else Warps(**limits)
    return Cutting(views, points, Tolerance(**patches["tolerance"]), patches["longest_side"])


def objective_of(config: DictConfig) -> Objective:
    """The loss of a config, on descriptors or on shapes."""
    loss, taught = plain(config.training.loss), dict[str, Any]()
    if "teacher" in config.training:
        teacher = config.training.teacher
        taught = {"teacher": PatchNetwork(network_file(teacher.network, teacher.precision)), "weight": teacher.weight}
    name = loss.pop("name")
    if name == "affine_covariance":
        return CovarianceObjective(**loss, **taught)
    if name != "hardest_triplet":
        raise ValueError(f"training.loss.name={name}; there are: hardest_triplet, affine_covariance, geodesc")
    return DescriptorObjective(functools.partial(objectives.hardest_triplet, **loss), **taught)


def training_of(
    config: DictConfig, network: nn.Module, store: PatchStore, description: dict[str, Any], device: torch.device
) -> PatchTraining:
    """The training of a config: on points of the whole store, or on match sets."""
    training = plain(config.training)
    options = TrainingOptions(**training["options"])
    if "match_sets" not in training:
        return PatchTraining(network, objective_of(config), store, options, description, device)
    loss = training["loss"]
    if loss.pop("name") != "geodesc":
        raise ValueError("training.match_sets needs training.loss.name=geodesc")
    description = {**description, "match_sets": training["match_sets"]}
    criterion = functools.partial(objectives.geodesc, **loss)
    return MatchSetTraining(network, criterion, store, options, description, device, **training["match_sets"])


@hydra.main(version_base=None, config_path=str(conf_dir()), config_name="train_patch_network")
def main(config: DictConfig) -> None:
    with exits_with_message("interrupted; resume=true goes on from the last checkpoint"):
        torch.set_num_threads(config.threads)
        device = presets.resolve_device(config.device)
        train, validation = opened_stores(config)
        training = plain(config.training)
        torch.manual_seed(training["options"]["seed"])
        network = build(training["architecture"], **training["network"])
        if hasattr(network, "pixel_mean"):  # L2-Net's, of patches spread evenly over the store
            spread = torch.from_numpy(train.patches[:: max(1, len(train.patches) // 20000)].copy())
            network.pixel_mean.copy_(objectives.middle(spread).float().mean(0) / 255)  # type: ignore[operator]
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        kept = ("architecture", "network", "loss", "teacher")
        description: dict[str, Any] = {key: value for key, value in training.items() if key in kept}
        description |= {"validation_data": validation.description, "licences": plain(config.photographs.sources)}
        checkpoint = Path(config.out) / f"{config.name}.pt"
        run = training_of(config, network, train, description, device)
        if config.resume:
            run.resume(checkpoint)
        elif checkpoint.exists():
            raise ValueError(f"{checkpoint} exists: resume=true goes on from it, another name= starts anew")
        pairs = stores.validation_pairs(validation, config.validation_pairs).to(device)
        untrained = build(training["architecture"]).to(device).eval()
        figures = {"untrained": run.objective.evaluate(untrained, pairs)}
        console.print(f"{len(train)} points; untrained: {figures['untrained']}")
        run.run(checkpoint=checkpoint, log=console.print)
        figures["trained"] = run.objective.evaluate(network.eval(), pairs)
        console.print(f"trained, {run.step} steps in {run.seconds / 60:.1f} minutes: {figures['trained']}")
        run.save(checkpoint, validation=figures)


if __name__ == "__main__":
    main()
