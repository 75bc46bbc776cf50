"""What each command takes: options with types, defaults and help, and groups of presets with what stands in each.

The one declaration of both: the config that Hydra composes, the checks of its values and ``--help`` are made of it.
Nothing here imports a library, for which ``--help`` would wait."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from fmtorch.core import Within
from fmtorch.core.files import STAGES
from fmtorch.core.options import CACHE, CACHE_LIMIT, DEBUG, Cache, Count, Debug, Device, Gigabytes, Seed, option
from fmtorch.training.options import TrainOptions

DEVICE = "auto | cpu | cuda | cuda:1 | mps"
BentBy = Literal["shared", "unknown"] | float | list[Any] | None
LENS = (
    "how much lenses bend straight lines: shared (one unknown lens), unknown (one of each image), or lambda of the "
    "division model in half diagonals, or [lambda,deviation]; null: not at all"
)
OF_DATA = "known: those of the data set. Images are undistorted with null alone. Part of the run's identity"
REPLACED = "Groups are replaced by name (estimator=lmeds), values by path (estimator.threshold=0.5)."


def as_in_configs(fields: list[tuple[str, Any]]) -> dict[str, Any]:
    """The fields of a dataclass with lists for tuples and texts for paths."""
    return {name: list(v) if isinstance(v, tuple) else str(v) if isinstance(v, Path) else v for name, v in fields}


class LeastAndGreatest:
    """A rule for lists: two shares, of which the first is not the greater."""

    def __call__(self, value: Any) -> bool:
        return len(value) == 2 and 0 <= value[0] <= value[1] <= 1

    def __str__(self) -> str:
        return "from 0 to 1: least and greatest share, as [0.1,0.4],"


@dataclasses.dataclass(frozen=True)
class PoseOptions:
    """How poses are judged."""

    signed: bool = option(
        False, "true: the sign of a translation counts, and of the four poses of an F the best one, as PoseBench judges"
    )


@dataclasses.dataclass(frozen=True)
class EvalOptions:
    """What `fmtorch eval` takes beside stages and the data set."""

    limit: Count | None = option(None, "evaluate only the first so many pairs of each family")
    seed: Seed = option(0, "of sampling and metrics; part of the run's identity")
    cameras: Literal["known", "shared", "exif", "unknown"] | None = option(
        None,
        "what the estimator is given of each pair's cameras, whose pose is then evaluated; part of the run's identity: "
        "null (nothing, the pose is that of F with the true calibrations) | known | shared | exif | unknown",
    )
    lens: BentBy | Literal["known"] = option(None, f"{LENS}; {OF_DATA}")
    pose: PoseOptions = option(PoseOptions(), "how poses are judged")
    device: Device = option("auto", DEVICE)
    batch: Count = option(16, "pairs that travel together; changes no result")
    workers: Count | None = option(None, "short for executor.workers")
    processes: bool | None = option(None, "short for executor=processes (true) and executor=threads (false)")
    shard: str | None = option(
        None, "i/n: only the i-th of n parts of the pairs, for machines that share output; the last one sums up all"
    )
    output: Path | None = option(None, "null: runs/<data set>/<pipeline>-<first digits of the identity>")
    cache: Cache = option(None, CACHE)
    cache_limit: Gigabytes | None = option(20, CACHE_LIMIT)
    export: str | list[str] | None = option(
        None, "h5, colmap or both, with a comma: hloc's files, a COLMAP database, in the run folder (docs/exchange.md)"
    )
    debug: Debug = option(False, f"{DEBUG}. One worker")


@dataclasses.dataclass(frozen=True)
class MatchOptions:
    """What `fmtorch match` takes beside stages."""

    image0: Path | None = option(None, "an image file: JPEG, PNG, TIFF, WebP, AVIF, BMP, ...; HEIC with pillow-heif")
    image1: Path | None = option(None, "the other one")
    images: Path | None = option(None, "instead of the two: a folder of images, whose pairs are matched")
    pairs: Path | None = option(
        Path("exhaustive"),
        "of a folder: exhaustive; similar:N, each image with the N that look most like it; sequential:N, with the N "
        "next ones by name; or a text file with the names of two images a line",
    )
    export: str | list[str] | None = option(
        None, "of a folder: h5, colmap or both, with a comma: hloc's files, a COLMAP database (docs/exchange.md)"
    )
    camera: Literal["per_image", "shared"] = option(
        "per_image", "of a folder, in COLMAP's database: per_image, or shared by all images of one size"
    )
    cameras: Path | None = option(
        None,
        "null: F alone; unknown, shared (one unknown focal length), exif, or a file of cameras (a COLMAP model, a JSON "
        'file {"a.jpg": [fx, fy, cx, cy]}): also the pose. Distortion is taken out of matched points',
    )
    K: str | list[float | int] | None = option(
        None, "fx,fy,cx,cy of all cameras, in pixels of the images as they are shown"
    )
    lens: BentBy = option(None, LENS)
    truth: Path | None = option(
        None, "a text file with the nine numbers of the true F, row by row, in pixels of the images as they are shown"
    )
    output: Path | None = option(None, "null: matches/<image0>-<image1>")
    orient: bool = option(True, "turn the images as their EXIF orientation or TIFF tag says")
    longest_side: Count = option(
        1600, "px; larger images are reduced to it. F and points are always in pixels of the images as they are"
    )
    workers: Count | None = option(
        None, "of a folder: images and pairs worked on at a time; null: one a core, one for a GPU"
    )
    seed: Seed = option(0, "of sampling")
    device: Device = option("auto", DEVICE)
    cache: Cache = option(None, CACHE)
    cache_limit: Gigabytes | None = option(20, CACHE_LIMIT)
    debug: Debug = option(False, DEBUG)


@dataclasses.dataclass(frozen=True)
class PairsOptions:
    """What `fmtorch pairs` takes beside the data set."""

    output: Path | None = option(
        None, "folder of the set; its name is the set's. The same command continues what was interrupted"
    )
    count: Count | None = option(1000, "pairs, drawn at random from all that pass; null: all")
    seed: Seed = option(0, "of the draw")
    overlap: Annotated[list[int | float], LeastAndGreatest()] | None = option(
        None,
        "[0.1,0.4]: the least and the greatest share of one image's pixels with depth, or of its points of a "
        "reconstruction, that the other sees; of the two shares the smaller counts. null: the paper's rule",
    )
    layout: Literal["fmbench", "oanet"] = option(
        "fmbench",
        "fmbench: folders of images; oanet: HDF5 files of all matches, one a scene, by the features and the matcher",
    )
    workers: Count | None = option(None, "short for executor.workers")
    quality: Annotated[int, Within(1, 100)] = option(
        95, "of the JPEG images that are written because they were undistorted; others are copied"
    )


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """What `fmtorch report` takes."""

    runs: str | list[str] = option(["runs"], "run folders, or folders that hold some, at any depth")
    output: Path | None = option(None, "the page; null: report.html beside the runs, in the first of their folders")
    title: str = option("Fundamental matrices", "of the page")
    pictures: Annotated[int, Within(0)] = option(
        6, "pairs of each data set that are shown, where the runs differ most; 0: none"
    )
    order: str | None = option(
        None, "given | recall; null: as given, and by recall where a folder of several runs is given"
    )
    root: str | list[str] | None = option(
        None, "where images lie (fmbench), or a list of such folders: each data set is looked for in all of them"
    )
    own_code: bool = option(False, "true: parts and data sets of your own are loaded as well, which runs their code")
    device: Device = option("auto", f"{DEVICE}; for the pictures, which run the pipelines again")
    cache: Cache = option(None, CACHE)
    cache_limit: Gigabytes | None = option(20, CACHE_LIMIT)


@dataclasses.dataclass(frozen=True)
class VerifyOptions:
    """What `fmtorch verify` takes beside the estimator."""

    database: Path | None = option(None, "database.db of a COLMAP project, with keypoints and matches")
    features_file: Path | None = option(None, "instead of it: hloc's file of features, features=FILE in short,")
    matches: Path | None = option(
        None, "and that of matches; or, without features, an npz or HDF5 file of x0, x1. They need an output"
    )
    output: Path | None = option(None, "a new database (or file of matches) to write to; null: DATABASE itself")
    cameras: Literal["stored", "shared", "unknown"] = option(
        "stored",
        "stored | shared | unknown: the database's cameras and priors, one unknown focal length, nothing known",
    )
    lens: BentBy = option(None, f"{LENS}; of images whose stored camera does not distort")
    force: bool = option(False, "true: estimate pairs that have a geometry as well, and replace an existing output")
    seed: Seed = option(0, "of sampling")
    shard: str | None = option(
        None,
        "i/n: only the i-th of n parts of the pairs, into a folder beside the database (or output), from where the "
        "same command without shard merges all",
    )
    debug: Debug = option(False, DEBUG)


@dataclasses.dataclass(frozen=True)
class Command:
    """A command, ``fmtorch NAME``, whose config Hydra composes.
    about: what its help says after its summary. options: the dataclass of its options, each an `option`. groups: groups
    of presets, with those that stand in each where the user names no other; group_help: what help says of them.
    positional: options that need no name, in order; the last takes several if its name ends in ``...``. texts: options,
    beside those that are paths, whose value Hydra shall not take apart at commas and brackets. interrupted: what is
    said where the user stops it. sweeps: the folder of what Hydra keeps of a sweep."""

    name: str
    about: str
    options: type
    groups: Mapping[str, str | list[str]]
    group_help: Mapping[str, str] = dataclasses.field(default_factory=dict)
    positional: tuple[str, ...] = ()
    texts: tuple[str, ...] = ()
    interrupted: str = "interrupted"
    sweeps: str = "."

    @property
    def defaults(self) -> dict[str, Any]:
        """The default of each option, those of nested dataclasses as mappings."""
        return dataclasses.asdict(self.options(), dict_factory=as_in_configs)

    @property
    def names(self) -> list[str]:
        return [*self.defaults, *self.groups]


EVAL = Command(
    "eval", REPLACED, EvalOptions, {**STAGES, "dataset": "rendered", "executor": "auto", "pipeline": "sift_ratio"},
    texts=("dataset.root", "dataset.file", "dataset.truth", "dataset.images", "export"),
    interrupted="interrupted; the same command continues the run", sweeps="runs",
)  # fmt: skip
MATCH = Command(
    "match", REPLACED, MatchOptions, {**STAGES, "executor": "auto", "pipeline": "hesaffnet_fast_fmtorch"},
    positional=("image0", "image1"), texts=("export", "K"),
)  # fmt: skip
PAIRS = Command(
    "pairs",
    """The set has the layout of FM-Bench, for dataset=fmbench, or OANet's, for dataset=h5. The rule is the
paper's: more than 20 SIFT matches within 1 px of the true epipolar lines in both images; or, with overlap, how much
of the scene both images show, whatever features find. Which pairs are looked at, the data set says (window,
candidates); docs/guides/data.md.""",
    PairsOptions,
    {"features": "sift", "matcher": "nearest", "dataset": "cameras", "executor": "auto"},
    {"features": "of layout=oanet", "matcher": "of layout=oanet"},
    texts=("dataset.root",),
    interrupted="interrupted; the same command goes on from there",
)
REPORT = Command("report", "It has tables, curves and pictures.", ReportOptions, {}, positional=("runs...",))
TRAIN = Command(
    "train",
    """The data set has ground truth: fmtorch train pruner=lc.
Groups are replaced by name (pruner=dfe, trainer=gpu), values by path (optimisation.steps=500).""",
    TrainOptions,
    {
        "features": "sift", "matcher": "nearest", "pruner": "lc", "dataset": "rendered", "photographs": "any",
        "executor": "auto", "trainer": "cpu",
    },
    {
        "features": "what the training matches come from",
        "pruner": "the network to train; its preset names the network, the result is a learned file for it",
        "dataset": "its training side",
        "photographs": "which of planes.photographs, by their source; or permissive",
        "executor": "what computes matches: auto (threads) | threads | processes | dask",
        "trainer": "cpu | gpu | ddp",
    },
    interrupted="interrupted; the same command continues the training",
    sweeps="runs",
)  # fmt: skip
VERIFY = Command(
    "verify",
    """docs/verify.md. The estimator is replaced by name (estimator=magsac), its values by path
(estimator.inlier_threshold=1.0).""",
    VerifyOptions,
    {"estimator": "fmtorch", "executor": "auto"},
    positional=("database",),
    interrupted="interrupted; the same command continues",
)
COMMANDS = {command.name: command for command in (EVAL, MATCH, PAIRS, REPORT, TRAIN, VERIFY)}
