"""Trains HardNet, L2-Net, GeoDesc or AffNet on corresponding patches of photographs.

python -m scripts.patch_networks.train training=hardnet images=FOLDER photographs.held_out=[SUBFOLDER]
python -m scripts.patch_networks.train training=affnet images=FOLDER photographs=permissive training.options.minutes=20

Patches are cut once into <out>/patches; delete that folder after a change of photographs or of `patches`. resume=true
goes on from the checkpoint <out>/<name>.pt, of which scripts.patch_networks.export makes the ONNX network and its card:
every step is a function of the seed and its number. A batch is points of a whole store, or matches of pairs of
photographs (`training.match_sets`, as GeoDesc is trained).
"""

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import hydra
import torch
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor, nn

import fmtorch.commands.config  # noqa: F401  # which lets Hydra 1.3 run on Python 3.14
from fmtorch.core.files import conf_dir, replacing
from fmtorch.core.terminal import console, exits_with_message
from fmtorch.features.local_feature import PatchNetwork, network_file
from fmtorch.features.networks import build, read_checkpoint
from fmtorch.jit.random import Stream, bits, uniform
from fmtorch.presets import plain, resolve_device
from fmtorch.training.planes import PlaneViews, list_photographs
from scripts.patch_networks import objectives, stores
from scripts.patch_networks.objectives import DRAWS, CovarianceObjective, DescriptorObjective, Objective
from scripts.patch_networks.stores import Cutting, MatchSets, PatchStore, Tolerance, match_sets, order


class TrainingOptions(NamedTuple):
    """How a patch network is trained, by Adam; the learning rate falls linearly to zero over the run.
    batch: points a step, with two patches each. minutes: the run's length in wall time, in place of steps. bf16:
    autocast to bfloat16. checkpoint_steps, log_steps: how often to save, to log."""

    batch: int = 512
    steps: int = 5000
    minutes: float | None = None
    learning_rate: float = 3e-3
    weight_decay: float = 1e-4
    seed: int = 0
    bf16: bool = True
    checkpoint_steps: int = 250
    log_steps: int = 50


class PatchTraining:
    """A network in training: `run` goes on to the end, or until a step; `save` keeps all that is needed.
    sets: where batches are of `options.batch` / `matches` of these, and `matches` of each (N_1 of GeoDesc's paper)."""

    def __init__(
        self, network: nn.Module, objective: Objective, store: PatchStore, options: TrainingOptions,
        description: dict[str, Any] | None = None, device: torch.device | str = "cpu", *,
        sets: MatchSets | None = None, matches: int = 1,
    ) -> None:  # fmt: skip
        self.units: PatchStore | MatchSets = store if sets is None else sets
        if options.batch % matches:
            raise ValueError(f"batch={options.batch} must be a multiple of match_sets.matches={matches}")
        if options.batch > matches * len(self.units):
            what = "points there are" if sets is None else f"sets of {matches} matches"
            raise ValueError(f"batch={options.batch} is more than the {len(self.units)} {what}")
        self.network, self.objective, self.store, self.options = network.to(device), objective, store, options
        self.sets, self.matches, self.description, self.device = sets, matches, description or {}, torch.device(device)
        parameters = self.network.parameters()
        self.optimizer = torch.optim.Adam(parameters, options.learning_rate, weight_decay=options.weight_decay)
        self.step, self.seconds, self.losses = 0, 0.0, list[float]()

    def resume(self, path: Path | str) -> None:
        """Go on from a checkpoint of a run with the same options; ValueError names what differs."""
        content = read_checkpoint(path)
        mine, theirs = self.options._asdict(), content.get("options", {})
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
            "seconds": self.seconds, "losses": self.losses, "options": self.options._asdict(),
            "data": self.store.description, **self.description, **more,
        }  # fmt: skip
        with replacing(path) as unfinished:
            torch.save(content, unfinished)

    def _one_step(self) -> Tensor:
        """The loss of this step's patches, by `DRAWS` random numbers of each point and two more."""
        o = self.options
        key = torch.tensor([self.step])
        draws = uniform(o.seed, key, Stream.TRAINING, 0, o.batch, DRAWS + 2)[0].float()
        torch.manual_seed(int(bits(o.seed, key, Stream.TRAINING, o.batch, 1, DRAWS + 2)[0, 0, 0]))  # dropout
        pairs, similarity = self._batch(draws)
        draws, pairs = draws.to(self.device), pairs.to(self.device)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=o.bf16):
            loss = self.objective.loss(self.network, pairs, draws, similarity)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        return loss.detach()

    def _batch(self, draws: Float[Tensor, "b k"]) -> tuple[Float[Tensor, "2 b 1 h w"], Float[Tensor, "s n"] | None]:
        """This step's pairs of patches, and S_patch of those of match sets; each epoch is a random order of all."""
        seed, count = self.options.seed, self.options.batch // self.matches
        epoch, i = divmod(self.step, len(self.units) // count)
        chosen = order(seed + 1, epoch, len(self.units))[i * count : (i + 1) * count]
        if self.sets is None:
            return self.store.views(chosen, draws[:, DRAWS:]), None
        index = []
        for k, unit in enumerate(chosen.tolist()):
            begin, end = self.sets.first[unit : unit + 2].tolist()
            index.append(begin + order(seed + 2, self.step * count + k, end - begin)[: self.matches])
        matches = torch.stack(index).numpy()
        patches = torch.from_numpy(self.sets.patches[:, matches]).flatten(1)
        return self.store.pairs(patches), torch.from_numpy(self.sets.similarity[matches]).float().to(self.device)


def opened_stores(config: DictConfig) -> list[PatchStore]:
    """Training and validation patches, cut now where they are not there yet."""
    opened, given, patches = [], config.photographs, config.patches
    for side, name in enumerate(("train", "validation")):
        folder = Path(config.out) / "patches" / name
        if not folder.exists():
            photographs = list_photographs(config.images, given.sources and list(given.sources), given.excluded)
            photographs += stores.package_photographs() if config.package_images else []
            chosen = stores.split(photographs, given.held_out)[side]
            console.print(f"cutting patches of {len(chosen)} photographs into {folder}")
            stores.build_store(folder, chosen, cutting_of(config), patches.seed + side, patches.workers)
        opened.append(PatchStore.open(folder))
    return opened


def cutting_of(config: DictConfig) -> Cutting:
    patches: dict[str, Any] = plain(config.patches)
    planes: Any = {name: tuple(v) if isinstance(v, list) else v for name, v in patches["planes"].items()}
    return Cutting(PlaneViews(**planes), patches["points"], Tolerance(**patches["tolerance"]), patches["longest_side"])


def objective_of(config: DictConfig) -> Objective:
    loss, taught = plain(config.training.loss), dict[str, Any]()
    if "teacher" in config.training:
        teacher = config.training.teacher
        taught = {"teacher": PatchNetwork(network_file(teacher.network, teacher.precision)), "weight": teacher.weight}
    name = loss.pop("name")
    if (name == "geodesc") != ("match_sets" in config.training):
        raise ValueError("training.match_sets needs training.loss.name=geodesc, and that loss match sets")
    if name == "affine_covariance":
        return CovarianceObjective(**loss, **taught)
    criteria: dict[str, Any] = {"hardest_triplet": objectives.hardest_triplet, "geodesc": objectives.geodesc}
    if name not in criteria:
        raise ValueError(f"training.loss.name={name}; there are: affine_covariance, {', '.join(criteria)}")
    return DescriptorObjective(functools.partial(criteria[name], **loss), **taught)


def training_of(
    config: DictConfig, network: nn.Module, store: PatchStore, description: dict[str, Any], device: torch.device
) -> PatchTraining:
    training, of_sets = plain(config.training), dict[str, Any]()
    objective = objective_of(config)
    if "match_sets" in training:
        of_sets = {"sets": match_sets(store, **training["match_sets"]), "matches": training["match_sets"]["matches"]}
        description = {**description, "match_sets": training["match_sets"]}
    options = TrainingOptions(**training["options"])
    return PatchTraining(network, objective, store, options, description, device, **of_sets)


@hydra.main(version_base=None, config_path=str(conf_dir()), config_name="train_patch_network")
def main(config: DictConfig) -> None:
    with exits_with_message("interrupted; resume=true goes on from the last checkpoint"):
        torch.set_num_threads(config.threads)
        device = resolve_device(config.device)
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
