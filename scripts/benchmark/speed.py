"""Milliseconds a pair of estimators and pruners: one pair a call and many, peers in turn, prior included.

FMTORCH_CACHE=$(mktemp -d) python -m scripts.benchmark speed --peers    # the first call compiles the kernels
"""

import argparse
import ctypes
import functools
import gc
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import kornia.feature as KF
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from fmtorch import presets
from fmtorch.core.stages import pruned
from fmtorch.core.types import Correspondences, collate
from fmtorch.data import ImagePair, read_image, to_grey
from fmtorch.evaluation import statistics
from fmtorch.features import ImagePyramid, LocalFeature
from fmtorch.jobs import Execution, Factory, Local, TaskRunner, WorkerPool
from fmtorch.pipeline.pipeline import STAGES, Pipeline
from fmtorch.runs import PairRow, RunFolder
from fmtorch.scenes.surfaces import photograph
from scripts.benchmark import pairs
from scripts.benchmark.methods import call, pipeline_of
from scripts.benchmark.runner import add_command, console, timed
from scripts.benchmark.tables import Record, Sheet, show

SINGLE = 64  # pairs at most that are estimated one a call
MEMORY = "Peak memory of estimators and pruners: how far one call makes its process grow, each in a process of its own."
SCALE = "What evaluation costs at any size: workers, bytes and memory. Of stages `fmtorch eval` tells the seconds."
PROC = Path("/proc/self")
Call = Callable[[Correspondences], Any]
WAIT = 0.04  # seconds of a stage that only waits
EMPTY = 1000  # batches that a scheduler is given to do nothing in
BATCH = 64  # rows that are stored at a time where memory is measured
Image = NDArray[np.uint8]
Seconds = dict[str, float]
Peer = Callable[[Image, Image, int], Seconds]
PARTS = ("detection", "shape", "orientation", "description")
RATIO = 0.8
FEATURES = "Where the time of an image's features goes: processor milliseconds by stage, of presets that take turns."
END_TO_END = """Whole pipelines by stage against the same stages written with OpenCV's and kornia's calls, in turn.

The peer of `hesaffnet_gms` has kornia's Hessian detector, AffNet and HardNet (the same networks with random weights,
which cost the same) for as many features as ours found, and no GMS, which neither library has.
"""


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "speed", run, __doc__, pairs.add_match_options)
    parser.add_argument("--matches", type=int, default=760, help="median of the synthetic pairs, used without --root")
    parser.add_argument("--pairs", type=int, default=64, help="synthetic pairs")
    parser.add_argument("--batch", type=int, default=64, help="pairs a call")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--estimators", nargs="+", default=["fmtorch@frame_consistency"], help="[PRESET][@PRUNER...]")
    parser.add_argument("--peers", nargs="*", default=["poselib", "opencv:method=usac_magsac"], help="of the ratios")
    parser = add_command(commands, "memory", run_memory, MEMORY)
    parser.add_argument("--estimators", nargs="+", help="[PRESET][@PRUNER...]; default: all our own estimators")
    parser.add_argument("--pairs", type=int, default=64)
    parser.add_argument("--matches", type=int, default=8000)
    parser = add_command(commands, "scale", run_scale, SCALE)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--executors", nargs="+", default=["threads", "processes", "dask"])
    parser.add_argument("--rows", type=int, nargs="+", default=[10_000, 1_000_000], help="at which memory is measured")
    parser.add_argument("--parts", nargs="+", default=["workers", "memory"], help="of the tables")
    parser = add_command(commands, "features", run_features, FEATURES)
    parser.add_argument("--image", type=Path, help="default: a photograph of scikit-image")
    parser.add_argument("--size", type=int, nargs=2, default=(1024, 1536), help="the image is resized to (h, w)")
    parser.add_argument("--features", nargs="+", default=["hesaffnet", "hesaffnet_fast"], help="of conf/features")
    parser.add_argument("--repeats", type=int, default=7)
    parser = add_command(commands, "end_to_end", run_end_to_end, END_TO_END, pairs.add_set_options)
    parser.add_argument("--pipelines", nargs="*", default=list(PEERS), choices=list(PEERS))


def run(arguments: argparse.Namespace) -> None:
    every = [pairs.synthetic_matches(i, arguments.matches) for i in range(arguments.pairs)]
    if pairs.named(arguments):
        every = [item.matches for item in pairs.matched(arguments)]
    methods = {spec: call(spec) for spec in (*arguments.peers, *arguments.estimators)}
    first = {spec: timed(method, every[0])[1] for spec, method in methods.items()}  # lazy initialisation
    single = in_turn(methods, every[:SINGLE], arguments.repeats)
    size = arguments.batch
    many = in_turn(methods, [collate(every[i : i + size]) for i in range(0, len(every), size)], arguments.repeats)
    records: list[Record] = []
    for spec in methods:
        line: Record = {"estimator": spec, "one pair a call: median ms": f"{1e3 * np.median(single[spec]):.2f}"}
        line["one pair a call: mean ms"] = f"{1e3 * single[spec].mean():.2f}"
        line[f"{size} pairs a call: ms"] = f"{1e3 * np.median(many[spec].sum(1)) / len(every):.2f}"
        line["first call, s"] = f"{first[spec]:.1f}"
        for peer in arguments.peers:
            line[f"median / {peer}"] = f"{np.median(single[spec]) / np.median(single[peer]):.2f}"
        records.append(line)
    count = np.median([int(c.count()) for c in every])
    show([Sheet("speed", f"{len(every)} pairs, {count:.0f} matches (median)", records)], arguments.table)


def in_turn(methods: dict[str, Call], inputs: Sequence[Correspondences], repeats: int) -> dict[str, np.ndarray]:
    """Seconds (repeats, inputs) of methods that take turns at each input."""
    taken = [[[timed(method, c)[1] for method in methods.values()] for c in inputs] for _ in range(repeats)]
    return dict(zip(methods, np.array(taken).transpose(2, 0, 1), strict=True))


def run_memory(arguments: argparse.Namespace) -> None:
    targets = {name: str(presets.load("estimator", name)["_target_"]) for name in presets.available("estimator")}
    own = [name for name, target in targets.items() if not target.rpartition(".")[2].islower()]  # peers' are functions
    context = multiprocessing.get_context("spawn")
    records: list[Record] = []
    for spec in arguments.estimators or own:
        with context.Pool(1) as pool:  # memory once claimed stays claimed, so each has a fresh process
            size, growth = pool.apply(peak, (spec, arguments.pairs, arguments.matches))
        console.print(f"{spec}: {growth:.0f} MiB", highlight=False)
        records.append({"estimator": spec, "input, MiB": f"{size:.0f}", "peak growth, MiB": f"{growth:.0f}"})
    show([Sheet("memory", f"{arguments.pairs} pairs of {arguments.matches} matches", records)], arguments.table)


def peak(spec: str, count: int, matches: int) -> tuple[float, float]:
    """MiB of the input, and by how much the peak of one call exceeds what was resident before."""
    torch.set_num_threads(1)
    method = call(spec)
    method(pairs.synthetic_matches(0, 200, 0))  # lazy initialisation is not counted
    c = collate([pairs.synthetic_matches(i, matches, 0) for i in range(count)])
    size = sum(value.nbytes for value in vars(c).values() if isinstance(value, torch.Tensor)) / 2**20
    return size, peak_growth(lambda: method(c))


def peak_growth(call: Callable[[], Any]) -> float:
    """MiB, the peak of the resident set during a call beyond what was resident before it, on Linux.
    What the process claimed before, as for compiled kernels, does not hide it."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what was freed is given back, or the call would use it
    (PROC / "clear_refs").write_text("5")  # the peak is counted from here
    before = _resident("VmRSS")
    call()
    return (_resident("VmHWM") - before) / 1024


def _resident(field: str) -> int:
    """kB; of the process itself, whereas ru_maxrss is inherited."""
    return next(int(line.split()[1]) for line in (PROC / "status").open() if line.startswith(field))


def run_scale(arguments: argparse.Namespace) -> None:
    sheets = [worker_sheet(arguments.executors, arguments.workers)] if "workers" in arguments.parts else []
    records: list[Record] = []
    for count in arguments.rows if "memory" in arguments.parts else ():
        with multiprocessing.get_context("spawn").Pool(1) as pool:  # each time in a process of its own
            records.append({"rows": count, **{k: f"{v:.0f}" for k, v in pool.apply(stored, (count,)).items()}})
    sheets.append(Sheet("memory", "How far the peak of each step exceeds what the caller had before", records))
    show(sheets, arguments.table)


def worker_sheet(executors: Sequence[str], workers: Sequence[int]) -> Sheet:
    """Efficiency of waiting, the time of one worker by their number over that taken; calls a second of nothing."""
    records: list[Record] = []
    for executor in executors:
        line: Record = {"executor": executor}
        for count in workers:
            efficiency = 100 * WAIT * 50 / _timed(executor, count, WAIT, 50 * count)
            line[f"{count} worker{'s' * (count > 1)}: efficiency, %"] = f"{efficiency:.0f}"
        records.append(line | {"batches a second": f"{EMPTY / _timed(executor, workers[-1], 0.0, EMPTY):.0f}"})
    return Sheet("workers", f"Batches that only wait {1e3 * WAIT:.0f} ms, and such as do nothing", records)


def _timed(executor: str, workers: int, seconds: float, count: int) -> float:
    """Seconds of so many calls from the first result on, when all workers have started."""
    execution = Execution(executor, workers)
    source: Any = Local(seconds) if execution.shared else Factory(functools.partial(float, seconds))
    warm = 4 * workers
    start = 0.0
    with WorkerPool(execution) as pool:
        runner = TaskRunner[int](pool, source, wait, lambda task, result: None)
        for done, _ in enumerate(runner.each(range(warm + count))):
            if done == warm:
                start = time.perf_counter()
        return time.perf_counter() - start


def wait(seconds: float, job: int) -> int:
    time.sleep(seconds)
    return job


def stored(count: int) -> dict[str, float]:
    """MiB of storing so many rows, finding what is done and the summary; seconds, parts and bytes of storing."""
    with tempfile.TemporaryDirectory() as name:
        folder = RunFolder.open(Path(name) / "run", {"rows": count})

        def store() -> None:
            with WorkerPool(Execution("threads", 2)) as pool:
                runner = TaskRunner[range](pool, Local(None), rows_of, lambda task, rows: folder.append(rows))
                for _ in runner.each(range(i, min(i + BATCH, count)) for i in range(0, count, BATCH)):
                    pass

        start = time.perf_counter()
        figures = {"storing, MiB": peak_growth(store)}
        seconds = time.perf_counter() - start
        figures["finding what is done, MiB"] = peak_growth(folder.done)
        figures["summary, MiB"] = peak_growth(lambda: statistics.summarize(folder.read(without=("pair", "F"))))
        files = list((folder.path / "pairs").iterdir())
        size = sum(file.stat().st_size for file in files) / count
        return figures | {"storing, s": seconds, "parts": len(files), "bytes a row on disk": size}


def rows_of(nothing: None, numbers: range) -> list[PairRow]:
    rows = []
    for i in numbers:
        name, F = f"family/scene{i // 1000}/im{i:07d}-im{i + 1:07d}", [0.1234567 * k + 1e-9 * i for k in range(1, 10)]
        seconds: Any = {f"seconds_{stage}": 1e-3 + 1e-9 * i for stage in statistics.STAGES}
        figures: Any = {"nsgd": (i % 997) / 997, "inlier_rate": 0.9, "F": F, "corrs": i % 400, "corrs_before": 500}
        rows.append(PairRow(name, i, "family", f"scene{i // 1000}", ok=True, **figures, **seconds))
    return rows


# Images, by stage


class Clock:
    """Seconds of processor time between one stage and the next."""

    def __init__(self, stages: tuple[str, ...]) -> None:
        self.seconds, self.last = dict.fromkeys(stages, 0.0), time.process_time()

    def stage(self, name: str) -> None:
        """What was computed since the last call belongs to this stage."""
        self.seconds[name] += time.process_time() - self.last
        self.last = time.process_time()


def medians(seconds: list[Seconds]) -> Record:
    totals = [{**each, "all": sum(each.values())} for each in seconds]
    return {f"{stage}, ms": f"{1e3 * np.median([each[stage] for each in totals]):.1f}" for stage in totals[0]}


@torch.no_grad()
def run_features(arguments: argparse.Namespace) -> None:
    h, w = arguments.size
    image = photograph("chelsea.png") if arguments.image is None else read_image(arguments.image)
    image = np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_CUBIC), np.uint8)
    features = {name: presets.build("features", name) for name in arguments.features}
    turns = [{name: by_stage(each, image) for name, each in features.items()} for _ in range(arguments.repeats + 1)]
    records: list[Record] = [{"features": name, **medians([turn[name] for turn in turns[1:]])} for name in features]
    show([Sheet("stages", f"{w} x {h}", records)], arguments.table)


def by_stage(feature: LocalFeature, image: Image) -> Seconds:
    """Seconds of processor time of each stage, patches included where they are cut; 0 for a stage that is absent."""
    clock = Clock(PARTS)
    lafs, _ = feature.detector.detect(image)
    pyramid = ImagePyramid(to_grey(image))
    clock.stage("detection")
    for stage, step in (("shape", feature.shape), ("orientation", feature.orientation)):
        if step is not None:
            lafs = step(pyramid, lafs)
            clock.stage(stage)
    feature.describe(image, lafs)
    clock.stage("description")
    return clock.seconds


@torch.no_grad()
def run_end_to_end(arguments: argparse.Namespace) -> None:
    every = pairs.pairs_of(arguments)
    records: list[Record] = []
    for name in arguments.pipelines:
        (title, peer), pipeline = PEERS[name], pipeline_of(name, "cache=off")
        ours: list[Seconds] = []
        theirs: list[Seconds] = []
        for pair in track([every[0], *every], name, console=console, transient=True):
            images = read_image(pair.image0), read_image(pair.image1)
            seconds, features = own_stages(pipeline, pair, *images)
            ours.append(seconds)
            theirs.append(peer(*images, features))
        ratio = np.median([sum(b.values()) / sum(a.values()) for a, b in zip(ours[1:], theirs[1:], strict=True)])
        records.append({"pipeline": name, **medians(ours[1:]), "time / ours": "1.0"})
        records.append({"pipeline": title, **medians(theirs[1:]), "time / ours": f"{ratio:.1f}"})
    show([Sheet("end_to_end", f"Medians of {len(every)} pairs", records)], arguments.table)


def own_stages(pipeline: Pipeline, pair: ImagePair, image0: Image, image1: Image) -> tuple[Seconds, int]:
    clock = Clock(STAGES)
    features0, features1 = pipeline.extractor(image0), pipeline.extractor(image1)
    clock.stage("features")
    c = pipeline.matcher(features0, features1)
    clock.stage("matching")
    for pruner in pipeline.pruners_of(pair.family).values():
        c = pruned(pruner, c, lambda _: pipeline.images(pair)).compact()
    clock.stage("pruning")
    pipeline.estimator(c, 0)
    clock.stage("estimation")
    return clock.seconds, (len(features0) + len(features1)) // 2


def opencv_stages(method: int, threshold: float, image0: Image, image1: Image, features: int) -> Seconds:
    """SIFT, brute-force matching, ratio test and an estimator of OpenCV's."""
    clock, sift = Clock(STAGES), cv2.SIFT.create(8000)
    (k0, d0), (k1, d1) = (sift.detectAndCompute(to_grey(image), None) for image in (image0, image1))
    clock.stage("features")
    neighbors = cv2.BFMatcher(cv2.NORM_L2).knnMatch(d0, d1, 2)
    clock.stage("matching")
    kept = [two[0] for two in neighbors if len(two) == 2 and two[0].distance < RATIO * two[1].distance]
    x0 = np.array([k0[match.queryIdx].pt for match in kept], np.float64)
    x1 = np.array([k1[match.trainIdx].pt for match in kept], np.float64)
    return _estimated(clock, x0, x1, method, threshold)


def _estimated(clock: Clock, x0: NDArray[Any], x1: NDArray[Any], method: int, threshold: float) -> Seconds:
    clock.stage("pruning")
    if len(x0) >= 8:
        cv2.findFundamentalMat(x0, x1, method, threshold, 0.9999, 10000)
    clock.stage("estimation")
    return clock.seconds


def kornia_stages(image0: Image, image1: Image, features: int) -> Seconds:
    """kornia's HesAffNet and matcher with the ratio test, OpenCV's LMedS."""
    shape = KF.LAFAffNetShapeEstimator(False, preserve_orientation=False)
    hessian = KF.BlobHessian()
    detector = KF.ScaleSpaceDetector(features, resp_module=hessian, aff_module=shape, ori_module=KF.LAFOrienter(32))
    hesaffnet = KF.LocalFeature(detector, KF.LAFDescriptor(KF.HardNet(False))).eval()
    clock = Clock(STAGES)
    extracted = [hesaffnet(torch.from_numpy(to_grey(image))[None, None].float() / 255) for image in (image0, image1)]
    clock.stage("features")
    _, matches = KF.match_snn(extracted[0][2][0], extracted[1][2][0], RATIO)
    clock.stage("matching")
    x0, x1 = (extracted[i][0][0, matches[:, i], :, 2].double().numpy() for i in (0, 1))
    return _estimated(clock, x0, x1, cv2.FM_LMEDS, 1.0)


LMEDS, MAGSAC = (functools.partial(opencv_stages, *of) for of in ((cv2.FM_LMEDS, 1.0), (cv2.USAC_MAGSAC, 0.25)))
PEERS: dict[str, tuple[str, Peer]] = {
    "sift_ratio estimator=lmeds_eight_point": ("OpenCV: SIFT, BFMatcher, FM_LMEDS", LMEDS),
    "sift_fmtorch": ("OpenCV: SIFT, BFMatcher, USAC_MAGSAC", MAGSAC),
    "hesaffnet_gms": ("kornia: HesAffNet, match_snn; OpenCV: FM_LMEDS", kornia_stages),
}
