"""Homographies of photographs as planes: errors and milliseconds beside other libraries, on the same matches.

docs/benchmarks/homographies.md says what warped and hard pairs and views are. SIFT, ratio 0.8, one match a location,
P(inlier) from frame consistency. Every second photograph is for tuning (--tuning), the others for the claim.
"""

import argparse
import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from fmtorch import find_homography, match, metrics, presets
from fmtorch.core.types import PAIR_TYPES, Correspondences, Estimate, collate
from fmtorch.data import ImagePair, ImageSource, read_image
from fmtorch.geometry import poses_from_homography
from fmtorch.io.colmap import imported
from fmtorch.pipeline.pipeline import Outcome
from fmtorch.scenes.raycast import calibration
from fmtorch.training.planes import Photograph, PlanePairs, PlaneViews
from fmtorch.two_view.known_cameras import KnownCameras
from fmtorch.two_view.pair_type import classify
from scripts.benchmark import pairs
from scripts.benchmark.changes import bent, sizes_of
from scripts.benchmark.methods import options
from scripts.benchmark.runner import Item, Kept, Measured, Row, add_command, console, measure, timed
from scripts.benchmark.tables import Record, Results, Sheet, grouped, show

POSES = ("from F", "from H, the first pose", "from H, the better one")
KINDS = ("warped", "hard", "views")
METHODS = ["ours", *(f"{name}:{px}" for name in ("poselib", "fastpose") for px in (1, 2, 3))]
METHODS += ["usac_accurate:1", "usac_magsac:0.5"]
Array = NDArray[Any]
Solve = Callable[[Correspondences, int], Array | None]
SIDE = 640  # px, the longer side of the photographs
HARD_RIGHT, HARD_WRONG_SHARE = 60, 0.7
GRID = 12  # points along each side of a view
FOCAL, WIDE_FOCAL = 1.2, 0.8  # of the longer side: of warped photographs and copies; of one that is looked around in
BEHIND = 7  # photographs further on is the one that is seen behind a plane
CONFIGURATION = """Kinds of image pairs: confusion tables of `classify` and of COLMAP's rule, on the same matches.

Photographs: each as a plane, looked around in, copied, cropped, and beside another one. Every second photograph is for
tuning (--tuning), the others for the claim. Real and rendered pairs: --root, --rendered. SIFT, ratio 0.8, one match a
location, P(inlier) from frame consistency, noise of matches.
"""
GENERAL = {"castle-P19", "fountain-P11", "Herz-Jesus-P8", "sacre_coeur", "00", "driving", "orbit"}  # of depth
TIMED_FIELDS = ("x0", "x1", "mask", "ratio", "prior", "noise", "key", "size0", "size1", "K0", "K1")
COLMAP = {
    "CALIBRATED": "general", "UNCALIBRATED": "general", "PLANAR": "planar", "PANORAMIC": "rotation",
    "PLANAR_OR_PANORAMIC": "planar", "WATERMARK": "identical", "DEGENERATE": "unrelated", "UNDEFINED": "unrelated",
}  # fmt: skip


def add_arguments(commands: Any) -> None:
    planes = add_command(commands, "homography", run, __doc__, seeds=3)
    types = add_command(commands, "pair_types", run_pair_types, CONFIGURATION, pairs.add_match_options)
    for parser in (planes, types):
        parser.add_argument("--photographs", type=Path, required=parser is planes, help="a folder of photographs")
        parser.add_argument("--tuning", action="store_true", help="the photographs for choosing constants")
    planes.add_argument("--methods", nargs="+", default=METHODS, help="NAME:THRESHOLD or ours:KEY=VALUE,...")
    planes.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    planes.add_argument("--warps", type=int, default=1, help="pairs of each kind and photograph")
    planes.add_argument("--limit", type=int, help="photographs at most")
    planes.add_argument("--bent", type=float, default=0.0, help="lambda of lenses that bend the points of both images")
    types.add_argument("--colmap", nargs="*", type=float, default=[4.0, 1.0], help="COLMAP's thresholds, px")
    types.add_argument("--unknown", action="store_true", help="without calibrations, by image sizes alone")
    types.set_defaults(pruners=["ratio", "one_to_one", "frame_consistency", "match_noise"])


def run(arguments: argparse.Namespace) -> None:
    paths = paths_of(arguments)
    planes = [*(warped(paths, arguments.warps) if {"warped", "hard"} & set(arguments.kinds) else ()),
              *(views(paths, arguments.warps) if "views" in arguments.kinds else ())]  # fmt: skip
    items = [item for item in track(planes, "warping", console=console) if item.pair.family in arguments.kinds]
    methods = [Homography(word, bent=arguments.bent) for word in arguments.methods]
    results = Results(measure(methods, items, arguments.seeds, Kept(None)))
    groups = results.by_family(results.all_pairs)
    records = results.records(groups, [*(f"AUC@{px} px" for px in (1, 3, 5)), "ms"], "method", ["AUC@1 px"])
    show([Sheet("homography", "AUC of the mean distance of points, in %", records)], arguments.table)


@dataclasses.dataclass
class Plane(Item):
    """Two pictures of a plane. points: (n, 2), where an estimate of the homography is judged."""

    points: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))


class Homography(Measured):
    """An estimator of homographies: ``ours:KEY=VALUE,...``, or a peer or a method of OpenCV as ``NAME:THRESHOLD``."""

    identity = ""

    def __init__(self, word: str, solve: Solve | None = None, bent: float = 0.0) -> None:
        self.name, self.bent, self.solve = word, bent, solve or functools.partial(_solved, *word.partition(":")[::2])

    def figures(self, item: Item, seed: int) -> Row:
        """The mean error in pixels, infinite where there is no homography, and milliseconds."""
        assert isinstance(item, Plane)
        assert item.pair.H is not None
        matches = bent(item.pair, item.matches, self.bent)[1] if self.bent else item.matches
        H, seconds = timed(self.solve, matches, seed)
        row: Row = {"ms": 1e3 * seconds, "corner_error": np.inf}
        if H is not None:
            apart = np.linalg.norm(mapped(H, item.points) - mapped(item.pair.H, item.points), axis=1)
            row["corner_error"] = float(apart.mean())
        return row


def estimated(c: Correspondences, seed: int = 0, **changed: Any) -> Estimate:
    given: dict[str, Any] = {name: getattr(c, name) for name in TIMED_FIELDS[2:-2]}  # without points and K
    return find_homography(c.x0, c.x1, seed=seed, **given, **changed)


def _solved(name: str, setting: str, c: Correspondences, seed: int) -> Array | None:
    if name == "ours":
        estimate = estimated(c, seed, **options(setting))
        return estimate.H[0].numpy() if bool(estimate.ok[0]) else None
    (x0, x1), threshold = points(c), float(setting)
    if name == "poselib":
        import poselib

        return np.asarray(poselib.estimate_homography(x0, x1, {"max_reproj_error": threshold, "seed": seed}, {})[0])
    if len(x0) < 4:
        return None
    if name == "fastpose":
        from fastpose.estimators import estimate_homography

        return np.asarray(estimate_homography(x0, x1, max_error=threshold, seed=seed)[0]["H"])
    cv2.setRNGSeed(seed)
    H, _ = cv2.findHomography(x0, x1, getattr(cv2, name.upper()), threshold, maxIters=2000, confidence=0.9999)
    return None if H is None else np.asarray(H)


def run_pair_types(arguments: argparse.Namespace) -> None:
    items: list[Item] = []
    if arguments.photographs:
        items += track(list(kinds(paths_of(arguments))), "warping", console=console)
    for item in pairs.matched(arguments) if pairs.named(arguments) else ():
        if item.pair.K0 is not None and item.pair.K1 is not None and item.outcome and item.outcome.correspondences:
            general = {item.pair.scene, item.pair.family} & GENERAL
            item.facts |= {"truth": "general" if general else "", "group": f"{item.pair.family}/{item.pair.scene}"}
            items.append(item)
    methods = {"fmtorch": functools.partial(by_ours, presets.build("estimator", "fmtorch"), not arguments.unknown)}
    methods |= {f"COLMAP, {px:g} px": functools.partial(by_colmap, px) for px in arguments.colmap}
    rows: list[Row] = [
        {**item.facts, "method": name, "kind": verdict(item.matches), "set": item.pair.family, "item": item}
        for name, verdict in methods.items()
        for item in track(items, name, console=console, transient=True)
    ]
    show([kinds_sheet(rows), pose_sheet(rows)], arguments.table)
    print(time_line([item.matches for item in items]))


def by_ours(estimator: Any, known: bool, c: Correspondences) -> str:
    """`classify` after F, which has the exact cameras where they are known."""
    exact = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]], dtype=torch.float64)
    c = c.replace(focal=exact) if known else c.replace(K0=None, K1=None)
    return str(classify(c, (KnownCameras(estimator) if known else estimator)(c, 0), seed=0).names[0])


def by_colmap(threshold: float, c: Correspondences) -> str:
    """COLMAP's two-view geometry of calibrated cameras at a threshold of so many pixels."""
    known: Any = ((c.K0, c.size0), (c.K1, c.size1))
    library, (x0, x1) = imported(), points(c)
    options = library.TwoViewGeometryOptions(compute_relative_pose=True)
    options.ransac.max_error, options.ransac.random_seed = threshold, 0
    cameras = [library.Camera(camera_id=i, model="PINHOLE") for i in (1, 2)]
    for camera, (K, size) in zip(cameras, known, strict=True):
        (camera.height, camera.width), k = size[0].int().tolist(), K[0].double()
        camera.params, camera.has_prior_focal_length = [k[0, 0], k[1, 1], k[0, 2], k[1, 2]], True
    matches = np.repeat(np.arange(len(x0), dtype=np.uint32)[:, None], 2, 1)
    geometry = library.estimate_two_view_geometry(cameras[0], x0, cameras[1], x1, matches, options)
    return COLMAP[library.TwoViewGeometryConfiguration(geometry.config).name]


def kinds_sheet(rows: Sequence[Row]) -> Sheet:
    records: list[Record] = []
    for (method, group, truth), own in grouped(rows, "method", "group", "truth").items():
        kinds = [row["kind"] for row in own]
        line: Record = {"method": method, "pairs of": group, "truth": truth, "pairs": len(own)}
        line |= {kind: kinds.count(kind) for kind in PAIR_TYPES}
        records.append(line | {"right, %": f"{100 * kinds.count(truth) / len(own):.1f}" if truth else ""})
    return Sheet("kinds", "Kinds of pairs", records)


def pose_sheet(rows: Sequence[Row]) -> Sheet:
    """AUC of the pose error with known cameras, of pairs called general and of others, from F and from H."""
    posed = [row for row in rows if row["method"] == "fmtorch" and row["item"].pair.R is not None]
    records: list[Record] = []
    for (family, kind), own in grouped(posed, "set", "kind").items():
        errors = torch.from_numpy(np.stack([pose_errors(row["item"]) for row in own], 1))
        line: Record = {"set": family, "kind": kind, "pairs": len(own)}
        for name, areas in zip(POSES, (100 * metrics.pose_auc(errors)).tolist(), strict=True):
            line |= {f"{name} @{t}": f"{area:.1f}" for t, area in zip((5, 10, 20), areas, strict=True)}
        records.append(line)
    return Sheet("poses", "AUC of the pose error, in %", records)


def pose_errors(item: Item) -> Array:
    """Degrees (3,): of F's pose, of the first pose of H, and of the better one of both."""
    c = item.matches
    R, t, K0, K1 = (torch.from_numpy(getattr(item.pair, name))[None] for name in ("R", "t", "K0", "K1"))
    x0, x1, estimate, H = c.x0.double(), c.x1.double(), presets.build("estimator", "fmtorch")(c, 0), estimated(c)
    from_F = metrics.fundamental_pose_error(estimate.F, K0, K1, x0, x1, R, t, estimate.inliers)
    poses = poses_from_homography(H.H, K0, K1, x0, x1, H.inliers)
    seen = torch.where(poses.valid[..., None, None], poses.R, torch.nan)
    from_H = metrics.pose_error(seen, poses.t, R[:, None], t[:, None]).worst[0].nan_to_num(180.0)
    return np.array([float(from_F.worst), float(from_H[0]), float(from_H.min())])


def time_line(matches: Sequence[Correspondences]) -> str:
    """Milliseconds of processor time a pair, in one batch, of F and of `classify` beyond it."""
    chosen = matches[:: -(-len(matches) // 64)]
    c = collate([Correspondences(**{name: getattr(each, name) for name in TIMED_FIELDS}) for each in chosen])
    estimator = presets.build("estimator", "fmtorch")
    estimate = estimator(c, 0)
    classify(c, estimate)
    ms = [1e3 * timed(*call)[1] / len(c) for call in ((estimator, c, 0), (classify, c, estimate))]
    return f"{len(c)} pairs, median {int(c.count().median())} matches: F {ms[0]:.2f} ms, kinds {ms[1]:.2f} ms"


# Pairs made of photographs: planes seen from the side, rotations, copies and crops, and unrelated photographs


def paths_of(arguments: argparse.Namespace) -> list[Path]:
    paths = sorted(path for path in arguments.photographs.iterdir() if path.suffix in (".jpg", ".png"))
    paths = paths[(0 if arguments.tuning else 1) :: 2][: arguments.limit]
    if len(paths) < 2:
        raise SystemExit("error: two photographs at least are needed, of which one is behind the other")
    return paths


def item_of(kind: str, path: Path, seed: int, c: Correspondences, points: Array | None = None, **known: Any) -> Plane:
    image = ImageSource(path.name, path)
    pair = ImagePair(f"{kind}/{path.name}/{seed}", kind, path.stem, image, image, np.zeros((3, 3)), **known)
    outcome = Outcome(pair, (c.mask.shape[1],) * 2, c)
    return Plane(pair, lambda: outcome, points=np.zeros((0, 2)) if points is None else points)


def warped(paths: Sequence[Path], warps: int, hard_too: bool = True) -> Iterator[Plane]:
    """Each photograph as a plane seen from the side over another; of each the same with few right matches."""
    for seed, path in ((i + 1000 * k, path) for k in range(warps) for i, path in enumerate(paths)):
        image, background = small(path), small(paths[(seed % 1000 + min(BEHIND, len(paths) - 1)) % len(paths)])
        view, H = tilted(np.random.default_rng(seed), image, background)
        h, w = image.shape[:2]
        corners = np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], float)
        c = matched(image, view)
        yield item_of("warped", path, seed, c, corners, H=H)
        if hard_too:
            yield item_of("hard", path, seed, hard(c, H, seed), corners, H=H)


def tilted(rng: np.random.Generator, image: Array, background: Array) -> tuple[Array, Array]:
    """A photograph as a plane before a pinhole camera that looks at it from the side, and the homography to that."""
    h, w = image.shape[:2]
    tilt, direction, turn = np.deg2rad([rng.uniform(20, 55), rng.uniform(0, 360), rng.uniform(-20, 20)])
    axes = tilt * np.array([np.cos(direction), np.sin(direction), 0.0]), np.array([0, 0, turn])
    R = cv2.Rodrigues(axes[0])[0] @ cv2.Rodrigues(axes[1])[0]
    focal = FOCAL * max(h, w)
    plane = np.array([[1, 0, -w / 2], [0, 1, -h / 2], [0, 0, 1.0]])  # its points, in the plane's own frame
    camera = np.array([[focal, 0, w / 2], [0, focal, h / 2], [0, 0, 1.0]])
    H = camera @ np.c_[R[:, :2], [0, 0, focal * rng.uniform(1.0, 1.3)]] @ plane
    view = cv2.warpPerspective(image, H, (w, h), flags=cv2.INTER_AREA)
    inside = cv2.warpPerspective(np.ones((h, w), np.float32), H, (w, h))[..., None]
    view = cv2.GaussianBlur(inside * view + (1 - inside) * cv2.resize(background, (w, h)), (0, 0), 0.6)
    return np.clip(view + rng.normal(0, 3, view.shape), 0, 255).astype(np.uint8), H / np.linalg.norm(H)


def views(paths: Sequence[Path], count: int) -> Iterator[Plane]:
    """So many pairs of views of each photograph, kept in the cache folder, that see a tenth of the grid in common."""
    for seed, path in ((seed, path) for seed in range(count) for path in paths):
        pairs = PlanePairs([Photograph(path, path.name)], PlaneViews(views=2), seed)
        (pair,) = pairs
        images = [np.asarray(read_image(image.path)[..., ::-1]) for image in (pair.image0, pair.image1)]
        H, sizes = pairs.homography(pair), [np.array(image.shape[1::-1]) for image in images]
        grid = np.stack(np.meshgrid(*(np.linspace(0, side - 1, GRID) for side in sizes[0])), -1).reshape(-1, 2)
        there = mapped(H, grid)
        seen = (there >= 0).all(1) & (there < sizes[1]).all(1) & (grid @ H[2, :2] + H[2, 2] > 0)
        if seen.mean() >= 0.1:
            yield item_of("views", path, seed, matched(*images), grid[seen], H=H)


def hard(c: Correspondences, H: Array, seed: int) -> Correspondences:
    """At most HARD_RIGHT right matches, and random ones beside them; no prior."""
    rng = np.random.default_rng(seed)
    x0, x1 = points(c)
    right = np.flatnonzero(np.linalg.norm(mapped(H, x0) - x1, axis=1) < 2)
    right = rng.permutation(right)[:HARD_RIGHT]
    wrong = round(len(right) * HARD_WRONG_SHARE / (1 - HARD_WRONG_SHARE))
    a = np.concatenate([x0[right], rng.uniform(x0.min(0), x0.max(0), (wrong, 2))])
    b = np.concatenate([x1[right], rng.uniform(x1.min(0), x1.max(0), (wrong, 2))])
    order = rng.permutation(len(a))
    x = [torch.from_numpy(v[order][None]) for v in (a, b)]
    mask, key = torch.ones(x[0].shape[:2], dtype=torch.bool), torch.tensor([seed])
    return Correspondences(x[0], x[1], mask, key=key, size0=c.size0, size1=c.size1)


def kinds(paths: Sequence[Path]) -> Iterator[Plane]:
    """Of each photograph a plane, a rotation, a copy, a crop and an unrelated pair, with cameras; facts: its truth."""
    for seed, plane in enumerate(warped(paths, 1, hard_too=False)):
        path, behind = paths[seed], paths[(seed + min(BEHIND, len(paths) - 1)) % len(paths)]
        yield _with_cameras("warped photographs", "planar", path, plane.matches, None)
        for name, (group, truth, make) in MAKERS.items():
            view0, view1, focals = make(np.random.default_rng([seed, len(name)]), small(path))
            yield _with_cameras(group, truth, path, matched(view0, view1), focals)
        yield _with_cameras("unrelated photographs", "unrelated", path, matched(small(path), small(behind)), None)


def _with_cameras(group: str, truth: str, path: Path, c: Correspondences, focals: Array | None) -> Plane:
    sizes = sizes_of(c)
    known = [FOCAL * max(size) for size in sizes] if focals is None else focals
    K0, K1 = (calibration(f, (h, w)) for f, (h, w) in zip(known, sizes, strict=True))
    c = c.replace(K0=torch.from_numpy(K0)[None], K1=torch.from_numpy(K1)[None])
    item = item_of(group, path, 0, c, K0=K0, K1=K1)
    item.facts |= {"truth": truth, "group": group}
    return item


def _rotated(rng: np.random.Generator, photograph: Array) -> tuple[Array, Array, Array]:
    """Two views from the centre of a photograph's camera, of different focal lengths, within its field of view."""
    h, w = photograph.shape[:2]
    K, size = calibration(WIDE_FOCAL * max(h, w), (h, w)), (round(0.7 * h), round(0.7 * w))
    views, focals = [], []
    for side in (-1, 1):
        focal = rng.uniform(0.9, 1.3) * max(size)
        angles = np.radians([rng.uniform(-6, 6), side * rng.uniform(3, 10), rng.uniform(-8, 8)])
        H = calibration(focal, size) @ cv2.Rodrigues(angles)[0] @ np.linalg.inv(K)
        view = cv2.warpPerspective(photograph, H, size[::-1], flags=cv2.INTER_AREA)
        noisy = cv2.GaussianBlur(view.astype(np.float32), (0, 0), 0.6) + rng.normal(0, 3, view.shape)
        views.append(_compressed(np.clip(noisy, 0, 255).astype(np.uint8), 90))
        focals.append(focal)
    return views[0], views[1], np.array(focals)


def _copied(rng: np.random.Generator, photograph: Array) -> tuple[Array, Array, None]:
    scale = rng.choice([1.0, rng.uniform(0.5, 1.0)])
    copy = cv2.resize(photograph, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return photograph, _compressed(copy, int(rng.integers(50, 95))), None


def _cropped(rng: np.random.Generator, photograph: Array) -> tuple[Array, Array, None]:
    h, w = photograph.shape[:2]
    share = rng.uniform(0.6, 0.9)
    height, width = round(share * h), round(share * w)
    top, left = rng.integers(h - height + 1), rng.integers(w - width + 1)
    part = photograph[top : top + height, left : left + width]
    return photograph, _compressed(part, int(rng.integers(50, 95))), None


def _compressed(image: Array, quality: int) -> Array:
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR))


MAKERS: dict[str, tuple[str, str, Callable[..., tuple[Array, Array, Array | None]]]] = {
    "rotations": ("rotations cut from photographs", "rotation", _rotated),
    "copies": ("copies, resized", "identical", _copied),
    "crops": ("crops", "identical", _cropped),
}


def small(path: Path) -> Array:
    image = np.asarray(read_image(path)[..., ::-1])
    scale = SIDE / max(image.shape[:2])
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def matched(image0: Array, image1: Array) -> Correspondences:
    images = [np.ascontiguousarray(image[..., ::-1]) for image in (image0, image1)]
    return match(images[0], images[1], pipeline="sift_fmtorch").correspondences


def mapped(H: Array, x: Array) -> Array:
    y = np.c_[x, np.ones(len(x))] @ H.T
    return np.asarray(y[:, :2] / y[:, 2:])


def points(c: Correspondences) -> tuple[Array, Array]:
    """The matches of a batch of one, (n, 2) each."""
    x0, x1 = (x[0][c.mask[0]].double().numpy() for x in (c.x0, c.x1))
    return x0, x1
