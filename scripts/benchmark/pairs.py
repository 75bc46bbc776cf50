"""The pairs that benchmarks run on, with their matches: data sets, synthetic ones, photographs of different scenes."""

import argparse
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from fmtorch import data, presets
from fmtorch.core.types import Correspondences, pair_key
from fmtorch.data import ImagePair, ImageSource, PairDataset
from fmtorch.data.pairs import GivenMatches
from fmtorch.evaluation.run import select
from fmtorch.geometry import fundamental_from_calibration
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from fmtorch.runs.feature_cache import cached
from fmtorch.scenes import RenderedPairs, surfaces
from fmtorch.scenes import dataset as generate
from fmtorch.training.matched_pairs import no_estimator
from scripts.benchmark import methods
from scripts.benchmark.runner import Item, Kept, Row, Stages, identity

SIZE = (768, 1024)  # (h, w) of synthetic pairs
UNRELATED = "unrelated"  # what the names of families of pairs of different scenes begin with


def add_set_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--root", action="append", default=[], help="a set in the FM-Bench layout; may be repeated")
    parser.add_argument("--all-pairs", action="store_true", help="of the images of --root, not those that it lists")
    parser.add_argument("--rendered", choices=["small", "full"], help="also the embedded data set, of this size")
    parser.add_argument("--split", default="test", help="of --rendered: test or train; a --root has no splits")
    parser.add_argument("--limit", type=int, help="pairs of each family at most, chosen by hash")


def add_match_options(parser: argparse.ArgumentParser) -> None:
    add_set_options(parser)
    parser.add_argument("--features", default="sift")
    parser.add_argument("--matcher", default="nearest", help="PRESET[:KEY=VALUE,...], as lightglue, without --pruners")
    parser.add_argument("--pruners", nargs="*", default=["ratio", "one_to_one"])
    parser.add_argument("--cache", default="off", help="a folder that keeps features from run to run; off: nowhere")


def add_method_options(parser: argparse.ArgumentParser) -> None:
    add_match_options(parser)
    parser.add_argument("--specs", type=Path, help="a file with one method a line; # starts a comment")
    parser.add_argument("--shares", type=float, nargs="*", default=[], help="group pairs by right matches: 0.4 0.7")


def sets_of(arguments: argparse.Namespace) -> list[PairDataset]:
    sets = [data.load("cameras" if arguments.all_pairs else "fmbench", root=root) for root in arguments.root]
    if arguments.rendered:
        sets.append(data.load("rendered", arguments.split, size=arguments.rendered))
    return sets


def pairs_of(arguments: argparse.Namespace) -> list[ImagePair]:
    return select([dataset[i] for dataset in sets_of(arguments) for i in range(len(dataset))], arguments.limit)


def named(arguments: argparse.Namespace) -> bool:
    return bool(arguments.root or arguments.rendered)


def rows_of(arguments: argparse.Namespace, measured: Callable[[Kept], list[Row]]) -> list[Row]:
    """The rows of the data sets that the options name, or else all that are kept. Raises SystemExit for none."""
    kept = Kept(arguments.rows)
    rows = measured(kept) if named(arguments) else kept.rows
    if not rows:
        raise SystemExit("nothing to show: name sets with --root or --rendered, or a file of earlier --rows")
    return rows


def front_of(
    features: str, pruners: Iterable[str], cache: str = "off", memory: int = 64, matcher: str = "nearest"
) -> Pipeline:
    stages = {word: methods.build("pruner", word) for word in pruners}
    extractor = cached(presets.build("features", features), cache)
    return Pipeline(extractor, methods.build("matcher", matcher), stages, no_estimator, memory=memory)


def matches_identity(arguments: argparse.Namespace) -> str:
    """The digest of what the matches of `matched` depend on, but for the images."""
    stages: Stages = [("features", arguments.features, {}), ("matcher", *methods.split(arguments.matcher))]
    stages += [("pruner", *methods.split(word)) for word in arguments.pruners]
    return identity(stages, *(presets.build(group, name, **changed) for group, name, changed in stages))


def matched(arguments: argparse.Namespace) -> list[Item]:
    front = front_of(arguments.features, arguments.pruners, arguments.cache, matcher=arguments.matcher)
    return items(pairs_of(arguments), front)


def items(pairs: Iterable[ImagePair], front: Pipeline) -> list[Item]:
    def matched(pair: ImagePair) -> Outcome:
        return front.correspondences([pair])[0]

    return [Item(p, functools.partial(matched, p), images=functools.partial(front.images, p)) for p in pairs]


def synthetic_pair(index: int, matches: int, spread: float = 0.5) -> ImagePair:
    """Two views of a cloud of points, with their matches: with outliers, ratios and similarity frames.
    Their number is log-normal about `matches`; 30 to 80 % of them are right, with a noise of 0.5 px."""
    f, (h, w), rng = 1.2 * SIZE[1], SIZE, np.random.default_rng(index)
    n = max(20, round(matches * np.exp(spread * rng.normal())))
    depth, x0 = rng.uniform(4, 12, n), rng.uniform([0, 0], [w, h], (n, 2))
    roll, yaw = rng.uniform(-0.3, 0.3, 2)
    turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    R = turn @ np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    t = turn @ (rng.uniform([-1, -0.3, -0.5], [1, 0.3, 0.5]) - [8 * np.sin(yaw), 0, 0])
    K = np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1]])
    moved = np.c_[x0, np.ones(n)] @ np.linalg.inv(K).T * depth[:, None] @ R.T + t
    x1 = (moved @ K.T)[:, :2] / moved[:, 2:]
    wrong = rng.random(n) > rng.uniform(0.3, 0.8)
    x1[wrong] = rng.uniform([0, 0], [w, h], (int(wrong.sum()), 2))
    x0, x1 = (x + rng.normal(0, 0.5, (n, 2)) for x in (x0, x1))
    ratio = np.where(wrong, rng.uniform(0.6, 0.8, n), rng.uniform(0.2, 0.8, n))
    angle = np.where(wrong, rng.uniform(-np.pi, np.pi, n), roll + rng.normal(0, 0.1, n))
    scale = np.where(wrong, np.exp(rng.normal(0, 0.7, n)), depth / moved[:, 2].clip(1) * np.exp(rng.normal(0, 0.1, n)))
    size = np.exp(rng.normal(1.5, 0.5, n))
    image = ImageSource("none", Path("none.png"))  # not looked at
    F = fundamental_from_calibration(*(torch.from_numpy(each) for each in (K, K, R, t))).numpy()
    pair = ImagePair(f"synthetic/{index}", "synthetic", f"{index}", image, image, F, K, K, R, t)
    c = Correspondences(
        _tensor(x0), _tensor(x1), torch.ones(1, n, dtype=torch.bool), ratio=_tensor(ratio),
        lafs0=_tensor(_frames(x0, size, np.zeros(n))), lafs1=_tensor(_frames(x1, size * scale, angle)),
        size0=torch.tensor([SIZE]), size1=torch.tensor([SIZE]), key=torch.tensor([pair.key]),
    )  # fmt: skip
    return dataclasses.replace(pair, matches=functools.partial(GivenMatches, c, (n, n)))


def synthetic_matches(index: int, matches: int, spread: float = 0.5) -> Correspondences:
    pair = synthetic_pair(index, matches, spread)
    assert pair.matches is not None
    return pair.matches().correspondences


def _frames(x: np.ndarray, size: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Local affine frames (n, 2, 3) of a size and an orientation."""
    c, s = size * np.cos(angle), size * np.sin(angle)
    return np.stack([np.stack([c, -s, x[:, 0]], 1), np.stack([s, c, x[:, 1]], 1)], 1)


def _tensor(value: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(value.astype(np.float32))[None]


def unrelated_pairs(pairs: Sequence[ImagePair], datasets: Sequence[PairDataset], most: int) -> list[ImagePair]:
    """Pairs of photographs of different scenes, at most `most` of each two, chosen by hash, with an F of zeros.
    pairs: related ones, whose photographs are taken. Rendered scenes are paired with each other where they show no
    photograph in common, and real ones with each other."""
    shown: dict[str, frozenset[str]] = {}
    for dataset in datasets:
        shown |= photographs_shown(dataset) if isinstance(dataset, RenderedPairs) else {}
    scenes: dict[tuple[str, str], dict[str, ImageSource]] = {}
    for pair in sorted(pairs, key=lambda pair: f"{pair.family}/{pair.scene}"):
        scenes.setdefault((pair.family, pair.scene), {}).update({i.identity: i for i in (pair.image0, pair.image1)})
    chosen = []
    for a, b in itertools.combinations(scenes, 2):
        drawn = a[1] in shown
        if drawn == (b[1] in shown) and not (drawn and shown[a[1]] & shown[b[1]]):
            family, names = f"{UNRELATED}, {'rendered' if drawn else 'real'}", ("/".join(a), "/".join(b))
            crossed = []
            for ends in itertools.product(scenes[a].values(), scenes[b].values()):
                identity = " | ".join(f"{name}/{image.identity}" for name, image in zip(names, ends, strict=True))
                ends = ends[::-1] if pair_key(identity) % 2 else ends  # either scene comes first in half of the pairs
                crossed.append(ImagePair(identity, family, " | ".join(names), *ends, np.zeros((3, 3))))
            chosen += sorted(crossed, key=lambda pair: pair.key)[:most]
    return chosen


def photographs_shown(dataset: RenderedPairs) -> dict[str, frozenset[str]]:
    """The names of the photographs that each rendered scene is built with, whether they can be seen or not."""
    shown = {}
    for name, task in dataset._tasks.items():
        with mock.patch.object(surfaces, "photograph", wraps=surfaces.photograph) as taken:
            generate.build(task)
        shown[name] = frozenset(str(call.args[0]) for call in taken.call_args_list)
    return shown
