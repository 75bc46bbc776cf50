"""Methods that are named in one word, PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...], or as a pipeline with overrides.

Pruners may have options, too. In place of a preset `find_fundamental` is the public call, with points, distance ratios,
scores and image sizes, and options as its arguments; `truth` is the fit that starts from the true matrix, and so what
the matches allow. Without an estimator, as in `@gms`, pruners alone are meant. Among the pruners may be what changes
the pair: `sizeless`, `ratioless`, `scoreless`, `priorless` (these are not given; without scores no prior either),
`part:left=0,top=0,right=0.5,bottom=0.5` (both images cropped, in fractions of their sides) and `bent:lens=-0.15`
(points of two such lenses, F of pinholes). The last two come first.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

import fmtorch
from fmtorch import presets
from fmtorch.core import Correspondences, Estimate, Estimator, Pruner
from fmtorch.data import ImagePair
from fmtorch.geometry import refine
from fmtorch.pipeline.pipeline import Outcome, Pipeline, build_pipeline, load_pipeline
from fmtorch.presets.composition import PIPELINES, compose
from scripts.benchmark import changes
from scripts.benchmark.runner import Method, Stages, identity

TRUTH, NGRANSAC, FIND = "truth", "ngransac", "find_fundamental"
FIND_STAGES: Stages = [("estimator", "fmtorch", {})]
FIND_STAGES += [("pruner", name, {}) for name in ("frame_consistency", "position_consistency")]
VIEWS: dict[str, Callable[..., Any]] = {"part": changes.part, "bent": changes.bent}
SHARED = frozenset(("ratio", "one_to_one"))  # pruners that nearly all pipelines have, whose time does not count
NO_STAGES: Mapping[str, Pruner] = {}


def specs_of(words: Sequence[str], file: Path | None) -> list[str]:
    if specs := [*words, *(read_specs(file) if file else [])]:
        return specs
    raise SystemExit("name at least one method, or a file of --specs")


def read_specs(path: Path) -> list[str]:
    return [text for line in path.read_text().splitlines() if (text := line.partition("#")[0].strip())]


def options(text: str) -> dict[str, Any]:
    """``KEY=VALUE,...``: numbers, true, false or null as in JSON; anything else is text.
    ``PART.KEY=VALUE`` is the option KEY of a part, as on the command line."""
    changed: dict[str, Any] = {}
    for key, value in (item.split("=") for item in text.split(",") if item):
        *parts, last = key.split(".")
        inside = changed
        for part in parts:
            inside = inside.setdefault(part, {})
        try:
            inside[last] = json.loads(value)
        except json.JSONDecodeError:
            inside[last] = value
    return changed


def split(word: str) -> tuple[str, dict[str, Any]]:
    """The preset of ``PRESET[:KEY=VALUE,...]`` and its changed options."""
    name, _, rest = word.partition(":")
    return name, options(rest)


def build(group: str, word: str) -> Any:
    """The part of ``PRESET[:KEY=VALUE,...]``, one of `WITHHELD`, or the public call."""
    name, changed = split(word)
    if group == "estimator" and name == FIND:
        return functools.partial(estimate_by_call, changed)
    return WITHHELD[name] if name in WITHHELD else presets.build(group, name, **changed)


def estimate_by_call(options: Mapping[str, Any], c: Correspondences, seed: int) -> Estimate:
    """What `find_fundamental` makes of points, ratios, scores and image sizes, and of a pruner's prior and noise.
    options: its arguments, which replace these."""
    names = ("mask", "ratio", "score", "prior", "noise", "size0", "size1", "key")
    given: dict[str, Any] = {**{name: getattr(c, name) for name in names}, "seed": seed, **options}
    return fmtorch.find_fundamental(c.x0, c.x1, **given)


def stages_of(spec: str) -> list[str]:
    return [stage for stage in spec.partition("@")[2].split("+") if stage]


def method(spec: str, matches: str = "", extra: Mapping[str, Pruner] = NO_STAGES) -> Method:
    """The method of a spec on given matches. matches: what these depend on; extra: further stages by name."""
    word, words = spec.partition("@")[0], stages_of(spec)
    names = [name for name in words if split(name)[0] not in VIEWS]
    stages = {name: extra[name] if name in extra else build("pruner", name) for name in names}
    called = split(word)[0] == FIND
    own = FIND_STAGES if called else [] if word == TRUTH else [("estimator", *split(word))]
    own = [*own, *(("pruner", *split(name)) for name in names if name not in {*extra, *WITHHELD})]
    others: list[Any] = [part for stage in words for part in (stage, stages.get(stage))]
    others += [{"_target_": f"fmtorch.{FIND}"}] if called else []
    solve = from_truth if word == TRUTH else functools.partial(_estimated, build("estimator", word))
    views = [functools.partial(VIEWS[name], **changed) for name, changed in map(split, words) if name in VIEWS]
    made_with = identity(own, word, matches, *others)
    return Method(spec, made_with, lambda family: stages, solve, view=functools.partial(viewed, views))


def viewed(views: Sequence[Callable[..., Any]], outcome: Outcome, seed: int) -> Outcome:
    pair, c = outcome.pair, outcome.correspondences
    if c is None or not views:
        return outcome
    for view in views:
        pair, c = view(pair, c)
    return dataclasses.replace(outcome, pair=pair, correspondences=c)


def call(spec: str) -> Callable[[Correspondences], Any]:
    """A spec as a function of matches alone: pruners in order, then the estimator, if there is one, with seed 0."""
    word = spec.partition("@")[0]
    parts: list[Callable[[Correspondences], Any]] = [build("pruner", name) for name in stages_of(spec)]
    parts += [functools.partial(build("estimator", word), seed=0)] if word else []
    return lambda c: functools.reduce(lambda given, part: part(given), parts, c)


def _estimated(estimator: Estimator, pair: ImagePair, c: Correspondences, seed: int) -> Estimate:
    return estimator(c, seed)


def from_truth(pair: ImagePair, c: Correspondences, seed: int) -> Estimate:
    """The robust fit to the matches, weighted by their prior, that starts from the true matrix."""
    F = torch.from_numpy(pair.F)[None]
    for scale in (1.5, 0.7):  # px
        F = refine(F, c.x0, c.x1, c.prior, c.mask, loss="geman_mcclure", scale=scale, iterations=20)
    ok = torch.isfinite(F).all(-1).all(-1)
    F = torch.where(ok[:, None, None], F, 0.0)
    return Estimate(F, c.mask & ok[:, None], ok, ("" if bool(ok) else "no fit",), torch.zeros(1, dtype=torch.int64))


def pipeline_of(words: str, *overrides: str) -> Pipeline:
    """The pipeline of ``PRESET[ NAME=VALUE...]``, such as ``sift_ratio estimator=msac``, with further overrides."""
    name, *own = words.split()
    return load_pipeline(name, overrides=[*own, *overrides])


def pipeline_method(name: str, words: str, *overrides: str) -> tuple[Method, Pipeline, str]:
    """A pipeline as a method, what makes its matches, and the digest of that; words after ``+`` are further pruners."""
    words, *more = (part.strip() for part in words.split(" + "))
    preset, *changed = [*words.split(), *overrides]
    composed = compose(PIPELINES, (f"pipeline={preset}", "cache=off", *changed))
    pipeline, config = build_pipeline(composed), presets.stages(composed)
    front = identity([], config["features"], config["matcher"], pipeline.extractor)
    added = {word: build("pruner", word) for word in more}
    configs = [config["estimator"], *(part for entry in config["pruner"] for part in entry.values())]
    parts = [*pipeline.pruners.values(), *added.values()]
    digest = identity([("pruner", *split(word)) for word in more], *configs, front, str(pipeline.families), *parts)
    solve = functools.partial(_estimated, pipeline.estimator)
    made = Method(name, digest, lambda family: {**pipeline.pruners_of(family), **added}, solve, untimed=SHARED)
    return made, pipeline, front


def ngransac(file: Path | None) -> dict[str, Pruner]:
    """The network of neural-guided RANSAC (Brachmann & Rother, ICCV 2019) as prior: its weights of samples."""
    if file is None:
        return {}
    if not file.is_file():
        raise SystemExit(f"--ngransac {file}: no such file; scripts/convert_checkpoint.py makes it")
    network = {"_target_": "fmtorch.pruning.networks.LC", "side": ["ratio"]}
    return {NGRANSAC: presets.build("pruner", "lc", soft=True, network=network, file=str(file))}


WITHHELD: dict[str, Pruner] = {
    "sizeless": lambda c: c.replace(size0=None, size1=None), "ratioless": lambda c: c.replace(ratio=None),
    "scoreless": lambda c: c.replace(score=None, prior=None), "priorless": lambda c: c.replace(prior=None),
}  # fmt: skip
"""Stages that are no presets: what an estimator is not given."""
