"""Estimators that are named in one word: PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]; a pruner may have options, too."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch

from fmtorch import presets
from fmtorch.core.grey_pyramid import GreyPyramid, grey_pyramid
from fmtorch.core.stages import Estimator, Pruner, pruned
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import ImagePair, ImageSource, read_image, to_grey
from fmtorch.geometry import refine
from fmtorch.pipeline.build import load_pipeline
from fmtorch.pipeline.pipeline import Pipeline
from scripts.benchmark import kept
from scripts.benchmark.matched import pruner, split

Stage = Pruner
Method = Callable[[ImagePair, Correspondences, int], Estimate]
NGRANSAC = "ngransac"
TRUTH = "truth"
NONE: Mapping[str, Stage] = {}


def read_specs(path: Path) -> list[str]:
    """One estimator a line, without comments."""
    return [text for line in path.read_text().splitlines() if (text := line.partition("#")[0].strip())]


def stages_of(spec: str) -> list[str]:
    """The pruners of `PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]`."""
    return [stage for stage in spec.partition("@")[2].split("+") if stage]


def pipeline_of(words: str, *overrides: str) -> Pipeline:
    """The pipeline of ``PRESET[ NAME=VALUE...]``, such as ``sift_ratio estimator=msac``, with further overrides."""
    name, *own = words.split()
    pipeline: Pipeline = load_pipeline(name, overrides=[*own, *overrides])
    return pipeline


def features_of(name: str) -> str:
    """What the name of a pipeline, with overrides or not, says of its features: ``hesaffnet`` of ``hesaffnet_gms``.

    With its folder, as ``paper/sift`` of ``paper/sift_gms``; the whole name where it names none.
    """
    preset = name.split()[0]
    own = preset.rpartition("/")[2]
    known = [feature for feature in presets.available("features") if own.startswith(f"{feature}_")]
    return preset.removesuffix(own) + max(known, key=len) if known else preset


def identity(spec: str, extra: Mapping[str, Stage] = NONE) -> str:
    """The digest of what an estimator's results depend on: options, code, learned files, versions of peers."""
    name, changed = split(spec.partition("@")[0])
    stages: kept.Stages = [] if name == TRUTH else [("estimator", name, changed)]
    stages += [("pruner", *split(stage)) for stage in stages_of(spec) if stage not in extra]
    own = [part for stage in stages_of(spec) if stage in extra for part in (stage, extra[stage])]
    built = [presets.build("pruner", name, **changed) for group, name, changed in stages if group == "pruner"]
    return kept.identity(stages, name, *own, *built)


def build(spec: str, extra: Mapping[str, Stage] = NONE) -> Estimator:
    """The function of `PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]`: pruners in order, then the estimator.

    extra: pruners that are no presets. Pruners that look at images need `informed`.
    """
    estimator, pruners = estimator_of(spec), pruners_of(spec, extra)

    def call(c: Correspondences, seed: int = 0) -> Estimate:
        estimate: Estimate = estimator(functools.reduce(lambda kept, stage: stage(kept), pruners, c), seed)
        return estimate

    return call


def estimator_of(spec: str) -> Estimator:
    """The estimator of a spec, without its pruners."""
    name, changed = split(spec.partition("@")[0])
    estimator: Estimator = presets.build("estimator", name, **changed)
    return estimator


def pruners_of(spec: str, extra: Mapping[str, Stage] = NONE) -> list[Stage]:
    """The pruners of a spec, in order."""
    return [extra[stage] if stage in extra else pruner(stage) for stage in stages_of(spec)]


@functools.lru_cache(maxsize=2)  # of a pair the images are asked for by each method
def pyramid_of(image: ImageSource) -> GreyPyramid:
    """The grey levels of an image."""
    return grey_pyramid(to_grey(read_image(image)))


def pruned_by(pruners: Sequence[Stage], pair: ImagePair, c: Correspondences) -> Correspondences:
    """The matches of a pair, a batch of one, after pruners; those that look at images are given the pair's."""
    for stage in pruners:
        c = pruned(stage, c, lambda _: (pyramid_of(pair.image0), pyramid_of(pair.image1)))
    return c


def ngransac(file: Path) -> Stage:
    """The network of neural-guided RANSAC (Brachmann & Rother, ICCV 2019) as prior: its weights of samples."""
    if not file.is_file():
        raise SystemExit(f"--ngransac {file}: no such file; scripts/make_models.py ngransac makes it")
    network = {"_target_": "fmtorch.pruning.networks.LC", "side": ["ratio"]}
    stage: Stage = presets.build("pruner", "lc", soft=True, network=network, file=str(file))
    return stage


def informed(spec: str, extra: Mapping[str, Stage] = NONE) -> Method:
    """As `build`, of methods that are given the pair: `truth` looks at its F, and some pruners at its images."""
    pruners = pruners_of(spec, extra)
    if spec.partition("@")[0] == TRUTH:
        return lambda pair, c, seed: from_truth(pair, pruned_by(pruners, pair, c))
    estimator = estimator_of(spec)
    return lambda pair, c, seed: estimator(pruned_by(pruners, pair, c), seed)


def from_truth(pair: ImagePair, c: Correspondences) -> Estimate:
    """The robust fit to the matches, weighted by their prior, that starts from the true matrix."""
    F = torch.from_numpy(pair.F)[None]
    for scale in (1.5, 0.7):  # px
        F = refine(F, c.x0, c.x1, c.prior, c.mask, loss="geman_mcclure", scale=scale, iterations=20)
    ok = torch.isfinite(F).all(-1).all(-1)
    return Estimate(F, c.mask, ok, ("",), torch.zeros(1, dtype=torch.int64))
