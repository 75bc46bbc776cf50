"""`fmtorch train`: a composed config -> labelled matches, a trained network, its files and its card."""

import dataclasses
import functools
import hashlib
import itertools
import os
import platform
import shlex
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning import Trainer
from omegaconf import DictConfig
from rich.progress import Progress

from fmtorch import data, presets
from fmtorch.core.options import expect_options
from fmtorch.core.settings import claim
from fmtorch.core.terminal import console, progress_bars, reporter
from fmtorch.core.version import __version__
from fmtorch.data import ImagePair, PairDataset, subset
from fmtorch.data.construction import ENOUGH
from fmtorch.evaluation.run import select
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.presets.composition import execution_of, plain, read_fields
from fmtorch.runs import cached, identity_digest
from fmtorch.scenes import RenderedPairs
from fmtorch.training.export import Result, write_result
from fmtorch.training.labelled import Augmentation, LabelledMatches, keep_ratio
from fmtorch.training.loop import PrunerTraining, ValidationPictures, load_best, train
from fmtorch.training.matched_pairs import MatchedPairs
from fmtorch.training.objective import Objective
from fmtorch.training.options import TrainOptions
from fmtorch.training.planes import Photograph, PlanePairs, list_photographs
from fmtorch.training.stored_matches import StoredMatches, last_scenes, training_batches
from fmtorch.training.validation import Use, Validation

FEW = 500  # pairs to train on, below which no useful network is to be expected
MORE = "dataset.size=full renders 3,200 pairs, dataset=fmbench dataset.root=FOLDER are your own"
PICTURES = 4  # validation pairs that are drawn into the log


def run(config: DictConfig, name: str) -> Path:
    """Train what a composed config describes and return the folder of the result.
    Started again, it goes on from the last checkpoint; a finished training only writes its files anew. name: of the
    pruner's preset, e.g. ``lc``. Raises ValueError for options that cannot be."""
    options = read_fields(TrainOptions, config)
    expect_options(Trainer, plain(config.trainer), "trainer")
    presets.expect_buildable(plain(config.dataset), "dataset")
    presets.expect_stages(config)
    network_config = network_of(config, name)
    objective = Objective(**dataclasses.asdict(options.objective))
    uses = {key: use_of(key, value) for key, value in options.validation.uses.items()}
    with progress_bars() as progress:
        matches = labelled_matches(config, options, progress)
    identity = {
        "network": network_config, "objective": dataclasses.asdict(objective), "batch": config.batch,
        "optimisation": dataclasses.asdict(options.optimisation), "augmentation": plain(config.augmentation),
        "seed": config.seed, "matches": matches.digest, "version": __version__, "trainer": plain(config.trainer),
        "validation": {k: v for k, v in plain(config.validation).items() if k != "roots"},
    }  # fmt: skip
    folder = Path(config.output or f"runs/train/{name}-{identity_digest(identity)[:8]}")
    claim(folder / "training.json", identity, "checkpoints", "choose another output")
    torch.set_num_threads(int(config.threads or os.cpu_count() or 1))
    torch.manual_seed(config.seed)
    network = presets.instantiate(network_config, f"pruner={name}, network")
    validation = Validation([m for _, m in matches.validation], uses, [p.family for p, _ in matches.validation])
    module = PrunerTraining(network, objective, options.optimisation, validation)
    first = int(os.environ.get("LOCAL_RANK", "0")) == 0  # of several processes the one that reports
    if first:
        about = f"{len(matches.training)} pairs to train on, {len(matches.validation)} to validate on"
        console.print(f"{about}; {folder}", soft_wrap=True)
        if len(matches.training) < FEW:
            console.print(f"so few pairs show that it runs, and teach little; {MORE}", soft_wrap=True)
    shown = matches.validation[:: max(1, len(matches.validation) // PICTURES)][:PICTURES]
    batches = functools.partial(training_batches, matches.training, config.batch, config.seed, workers=config.loaders)
    how: dict[str, Any] = {name: getattr(options.validation, name) for name in ("every", "patience", "monitor")}
    how |= {"checkpoint_every": options.checkpoint_every, "callbacks": (ValidationPictures(shown),)}
    steps, seconds = train(module, batches, folder, plain(config.trainer), **how)
    if first:
        processor = f"{os.cpu_count()} cores of {platform.processor() or platform.machine()}"
        facts = {**identity, "steps": steps, "seconds": seconds, "data": matches.description, "processor": processor}
        facts["best_step"] = load_best(folder, module)
        report(write_result(folder, name, module.network, validation, facts), name)
    return folder


def report(result: Result, name: str) -> None:
    """Say on the terminal what came out and how to use it."""
    for key, value in result.evaluation.figures.items():
        console.print(f"{key:32} {value:.4f}")
    use = use_line(name, result.files[0], sys.argv[1:])
    for line in (", ".join(str(path) for path in result.files), f"use it: {use}"):
        console.print(line, soft_wrap=True)


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


@dataclasses.dataclass(frozen=True, eq=False)
class Matches:
    """Labelled matches to train on, and to validate on with their pairs; their digest; what a card says of them."""

    training: StoredMatches
    validation: list[tuple[ImagePair, LabelledMatches]]
    digest: str
    description: dict[str, str]


def labelled_matches(config: DictConfig, options: TrainOptions, progress: Progress) -> Matches:
    """The matches of the config's data set, split by scenes, and of its further validation sets.
    Raises ValueError where there is nothing to train on or to validate on."""
    photographs, given, validated = list[Photograph](), config.photographs, options.validation
    if options.planes.photographs is not None:
        photographs = list_photographs(options.planes.photographs, given.sources, given.excluded)
    dataset = _dataset(config, progress)
    chosen, held_out = _split(dataset, validated.scenes)
    chosen = _limited(dataset, chosen, config.limit)
    if not chosen:
        raise ValueError("no pairs to train on: the scenes are for validation; give a smaller validation.scenes")
    front = _front(config)

    def matched(source: PairDataset, indices: Sequence[int], what: str) -> StoredMatches:
        return MatchedPairs(
            subset(source, indices) if len(indices) < len(source) else source, front,
            execution=execution_of(config, config.workers).decided(False), build=functools.partial(_front, config),
            progress=reporter(progress, f"matches {what}"),
        )  # fmt: skip

    training = matched(dataset, chosen, "to train on")
    digests, validation = [training.folder.name], list[tuple[ImagePair, LabelledMatches]]()
    sets = [(dataset, held_out, "to validate on")]
    for root in validated.roots:
        real = data.load("fmbench", root=root)
        sets.append((real, list(range(len(real))), f"of {root}"))
    for source, indices, what in sets:
        if selected := _limited(source, indices, validated.pairs):
            stored = matched(source, selected, what)
            digests.append(stored.folder.name)
            pairs = {source[i].key: source[i] for i in selected}
            for i, about in enumerate(stored.pairs):
                matches = keep_ratio(stored.stored(i), validated.ratio).compact()
                validation.append((pairs[about["key"]], matches))
    if not validation:
        raise ValueError("no pairs to validate on: give validation.scenes or validation.roots")
    families = Counter(pair.family for pair, _ in validation)
    description = {
        "training": f"{len(training)} pairs of {_scenes(training)} scenes of {dataset.name}",
        "validation": ", ".join(f"{count} pairs of {family}" for family, count in families.items())
        + f" (of {dataset.name} the last scenes of each family, which may share photographs with the training scenes)",
    }
    if photographs:
        workers, report = config.workers or os.cpu_count() or 1, reporter(progress, "views of photographs")
        drawn = PlanePairs(photographs, options.planes.limits, options.planes.seed, workers=workers, progress=report)
        planes = matched(drawn, range(len(drawn)), "of photographs")
        planes = planes.select(i for i, about in enumerate(planes.pairs) if about["inliers"] > ENOUGH)
        digests.append(planes.folder.name)
        description["training"] += f" and {len(planes)} pairs of {_scenes(planes)} photographs seen as planes"
        training = training.joined(planes)
    augmented = training.augmented(Augmentation(**dataclasses.asdict(options.augmentation)), config.seed)
    return Matches(augmented, validation, hashlib.sha256(" ".join(digests).encode()).hexdigest(), description)


def _dataset(config: DictConfig, progress: Progress) -> PairDataset:
    """The data set to train on; of the embedded one always the training side."""
    options = plain(config.dataset)
    if presets.target_of(options, "dataset") is RenderedPairs:
        options["split"] = "train"
    return data.build(options, reporter(progress, "drawing scenes"))


def _split(dataset: PairDataset, last: int | None) -> tuple[list[int], list[int]]:
    """Indices of the pairs to train on, and of those in the last scenes of each family."""
    pairs = [dataset[i] for i in range(len(dataset))]
    held = last_scenes(((pair.family, pair.scene) for pair in pairs), last)
    sides: tuple[list[int], list[int]] = ([], [])
    for i, pair in enumerate(pairs):
        sides[(pair.family, pair.scene) in held].append(i)
    return sides


def _limited(dataset: PairDataset, indices: list[int], limit: int | None) -> list[int]:
    """At most `limit` pairs of each family, chosen by their keys."""
    index = {dataset[i].key: i for i in indices}
    return sorted(index[pair.key] for pair in select([dataset[i] for i in indices], limit))


def _front(config: DictConfig) -> Pipeline:
    """Features, matcher and the pruners before the trained one."""
    extractor = cached(presets.instantiate(plain(config.features), "features"), config.cache, config.cache_limit)
    before = {str(name): presets.build("pruner", str(name)) for name in config.before}
    matcher: Any = presets.instantiate(plain(config.matcher), "matcher")
    return Pipeline(extractor, matcher, before, _no_estimator)


def _no_estimator(c: Any, seed: int = 0) -> Any:
    raise NotImplementedError("the stages before estimation only")


def _scenes(matches: StoredMatches) -> int:
    return len({about["scene"] for about in matches.pairs})
