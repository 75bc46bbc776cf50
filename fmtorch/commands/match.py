"""What `fmtorch match` is told of cameras: ``cameras=exif``, ``cameras=FILE``, ``K=fx,fy,cx,cy``."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig
from rich.table import Table

from fmtorch import presets
from fmtorch.commands.config import chosen_pipeline, job, run_command
from fmtorch.commands.match_folder import match_folder
from fmtorch.commands.options import MATCH, MatchOptions
from fmtorch.core.files import expect_writable, replacing
from fmtorch.core.terminal import console, errors
from fmtorch.core.types import RELATED
from fmtorch.core.version import __version__
from fmtorch.data.images import read_image
from fmtorch.data.lenses import undistorted
from fmtorch.evaluation.pictures import draw_epipolar_lines, draw_matches
from fmtorch.metrics import nsgd
from fmtorch.pipeline.build import build_pipeline
from fmtorch.pipeline.folder import EXHAUSTIVE
from fmtorch.pipeline.photograph_cameras import PhotographCameras
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.pipeline.reduced_images import Image
from fmtorch.pipeline.two_images import MatchResult, match
from fmtorch.presets.fields import read_fields
from fmtorch.runs.feature_cache import CachedFeatures


@dataclasses.dataclass(frozen=True, eq=False)
class Photographs:
    """Two photographs, and what is known of their cameras as `fmtorch.match` takes it; notes: what is said of these."""

    images: tuple[Image, Image]
    knowledge: dict[str, Any]
    notes: tuple[str, ...] = ()

    @property
    def pinholes(self) -> tuple[Image, Image]:
        """The photographs without the distortion of their lenses."""
        lenses = [self.knowledge.get(f"lens{i}") for i in (0, 1)]
        bent = zip(self.images, lenses, strict=True)
        image0, image1 = (image if lens is None else undistorted(image, lens) for image, lens in bent)
        return image0, image1


def photographs(
    paths: Sequence[Path], cameras: Path | None, K: str | list[float | int] | None, orient: bool
) -> Photographs:
    """Read two photographs with what is known of their cameras.

    Args:
        paths: of the two.
        cameras: one of `WORDS`, a file of cameras (`ImageCameras`), or None.
        K: fx, fy, cx, cy of both in pixels, or None.
        orient: turn them as their EXIF orientation says.

    Raises:
        ValueError: where both are given, or for what no camera is.
        ImageError: for a file that is no image, or is not of its camera's size.
    """
    known = PhotographCameras(cameras, K)
    image0, image1 = (read_image(known.source(path), orient=orient) for path in paths)
    ends = zip(paths, (image0, image1), strict=True)
    camera0, camera1 = (known.of(path, (image.shape[0], image.shape[1])) for path, image in ends)
    notes = tuple(filter(None, (camera0.note, camera1.note)))
    return Photographs((image0, image1), known.knowledge(camera0, camera1), notes)


def pose_report(result: MatchResult) -> dict[str, Any]:
    """R, t and focal lengths of result.json; None where they are not determined, nothing where nobody asked."""
    if result.R is None or result.t is None or result.focals is None:
        return {}
    determined = result.ok and bool(torch.isfinite(result.R).all())
    focals = [focal if math.isfinite(focal) else None for focal in result.focals.tolist()]
    R, t = (value.tolist() if determined else None for value in (result.R, result.t))
    return {"R": R, "t": t, "focals": focals}


def pose_line(result: MatchResult) -> str:
    """``rotation 12.3°, translation (0.98, -0.10, 0.17), focal lengths 702, 702 px``; empty where nobody asked."""
    if result.R is None or result.t is None or result.focals is None or not result.ok:
        return ""
    focals = ", ".join(f"{focal:.0f}" if math.isfinite(focal) else "?" for focal in result.focals.tolist())
    if not bool(torch.isfinite(result.R).all()):
        return f"no pose: it is not determined; focal lengths {focals} px"
    half = (result.R - torch.eye(3).to(result.R)).norm() / math.sqrt(8)  # the sine of half the angle
    angle = math.degrees(2 * math.asin(min(1.0, float(half))))
    direction = ", ".join(f"{value:.3f}" for value in result.t.tolist())
    return f"rotation {angle:.2f}°, translation ({direction}), focal lengths {focals} px"


# `fmtorch match image0=a.jpg image1=b.jpg`: the fundamental matrix of two photographs, with pictures


MAX_RANK3 = 0.01  # third singular value of a true F over the second one: its numbers may be rounded


def run(config: DictConfig, pipeline_name: str, overrides: Sequence[str] = ()) -> Path:
    """Match the two photographs of a composed config and return the folder with the results.

    overrides: what the command line changed of the pipeline of that name; said beside it.
    """
    fields = read_fields(MatchOptions, config)
    if fields.images is not None:
        if fields.image0 is not None or fields.image1 is not None or fields.truth is not None:
            raise ValueError("images takes a folder; image0, image1 and truth are of a single pair")
        return match_folder(config, fields, PhotographCameras(fields.cameras, fields.K), pipeline_name, overrides)
    if fields.export is not None or str(fields.pairs or EXHAUSTIVE) != EXHAUSTIVE:
        raise ValueError("export and pairs are of a folder of images: give images=FOLDER")
    paths = [_given(fields.image0, "image0"), _given(fields.image1, "image1")]
    presets.expect_stages(config)
    truth = None if fields.truth is None else read_matrix(fields.truth)
    given = photographs(paths, fields.cameras, fields.K, fields.orient)
    image0, image1 = given.images
    folder = fields.output or _default_output(paths)
    expect_writable(folder)
    pipeline: Pipeline = build_pipeline(config, presets.resolve_device(fields.device))
    result = match(
        image0, image1, pipeline=pipeline, longest_side=fields.longest_side, seed=fields.seed, **given.knowledge
    )
    report = {
        "version": __version__, "pipeline": pipeline_name, "overrides": list(overrides), "seed": fields.seed,
        "image0": str(paths[0]), "image1": str(paths[1]),
        **_report(result, image0, image1, truth), **pose_report(result),
    }  # fmt: skip
    with replacing(folder / "result.json") as path:
        path.write_text(json.dumps(report) + "\n")
    written = ["result.json", *_draw(folder, result, given, truth)]
    heading = f"{' '.join([pipeline_name, *overrides])}: {paths[0].name}, {paths[1].name}"
    console.print(heading, style="italic", markup=False, highlight=False)
    extractor = pipeline.extractor
    console.print(_table(result, isinstance(extractor, CachedFeatures) and not extractor.computed))
    if "nsgd" in report:
        console.print(f"NSGD to the true F: {report['nsgd']:.4f}", highlight=False)
    if line := pose_line(result):
        console.print(line, highlight=False)
    for trouble in (*given.notes, *_troubles(result)):
        errors.print(trouble, style="bold", highlight=False, soft_wrap=True)
    console.print(f"{folder}: {', '.join(written)}", style="dim", highlight=False)
    if isinstance(pipeline.extractor, CachedFeatures):
        console.print(pipeline.extractor.report(), style="dim", highlight=False)
    return folder


def read_matrix(path: Path) -> NDArray[np.float64]:
    """The 3 x 3 matrix of a text file of nine numbers, row by row, apart by spaces, commas or new lines.

    Raises ValueError for a file of anything else.
    """
    words = path.read_text().replace(",", " ").split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise ValueError(f"{path}: {error}; it must hold nine numbers, F row by row") from error
    if numbers.shape != (9,) or not np.isfinite(numbers).all() or not numbers.any():
        raise ValueError(f"{path}: holds {len(words)} numbers; it must hold nine finite ones, F row by row")
    F = numbers.reshape(3, 3)
    singular = np.linalg.svd(F, compute_uv=False)
    if singular[2] > MAX_RANK3 * singular[1]:
        raise ValueError(f"{path}: a matrix of rank three (its determinant is not 0); F has rank two")
    return F


def _given(path: Path | None, name: str) -> Path:
    if path is None:
        raise ValueError(f"{name} is missing; give two image files: fmtorch match a.jpg b.jpg")
    return path


def _default_output(paths: Sequence[Path]) -> Path:
    """``matches/NAME0-NAME1``, with some digits behind where that holds what was found of others of these names."""
    folder = Path(f"matches/{paths[0].stem}-{paths[1].stem}")
    with contextlib.suppress(OSError, ValueError, KeyError):
        earlier = json.loads((folder / "result.json").read_text())
        if [Path(earlier[name]).absolute() for name in ("image0", "image1")] != [path.absolute() for path in paths]:
            identity = "\0".join(str(path.absolute()) for path in paths)
            return folder.with_name(f"{folder.name}-{hashlib.blake2b(identity.encode(), digest_size=4).hexdigest()}")
    return folder


def _report(result: MatchResult, image0: Image, image1: Image, truth: NDArray[np.float64] | None) -> dict[str, Any]:
    """What result.json holds of a result; points in pixels of the images."""
    c = result.correspondences
    report: dict[str, Any] = {
        "size0": image0.shape[:2], "size1": image1.shape[:2],
        "F": result.F.tolist() if result.ok else None, "reason": result.reason, "warning": result.warning,
        "pair_type": result.pair_type or None,
        "homography": None if result.homography is None else result.homography.tolist(),
        "related": result.related, "significance": result.significance if math.isfinite(result.significance) else None,
        "features": [len(result.keypoints0), len(result.keypoints1)],
        "matches": result.counts, "seconds": result.seconds,
        "x0": c.x0[0].tolist(), "x1": c.x1[0].tolist(), "inliers": result.inliers.tolist(),
        "ratio": None if c.ratio is None else c.ratio[0].tolist(),
        "score": None if c.score is None else c.score[0].tolist(),
    }  # fmt: skip
    if (pinhole := result.undistorted) is not None:
        report |= {"undistorted_x0": pinhole.x0[0].tolist(), "undistorted_x1": pinhole.x1[0].tolist()}
    if truth is not None and result.ok:
        sizes = (torch.tensor([image.shape[:2]]) for image in (image0, image1))
        report["nsgd"] = float(nsgd(torch.from_numpy(truth)[None], result.F.cpu()[None], *sizes)[0])
    return report


def _draw(folder: Path, result: MatchResult, given: Photographs, truth: NDArray[np.float64] | None) -> list[str]:
    """Draw the pictures into the folder, matches in the photographs and epipolar lines in pinholes; their names."""
    image0, image1 = given.images
    x0, x1 = (x[0].cpu().numpy().astype(np.float64) for x in (result.putative.x0, result.putative.x1))
    kept = result.kept.cpu().numpy()
    good = kept.copy()
    if result.ok:
        good[good] = result.inliers.cpu().numpy()
    names = (
        ("inliers of F", "others, dropped by pruning or estimation") if result.ok else ("kept", "dropped by pruning")
    )
    pictures = {"matches.png": draw_matches(image0, image1, x0, x1, good, names=names)}
    pruners = [step for step in result.counts if step not in ("matching", "estimation")]
    if pruners:
        names = (f"kept by pruning ({', '.join(pruners)})", "dropped")
        pictures["pruning.png"] = draw_matches(image0, image1, x0, x1, kept, names=names)
    F = result.F.cpu().numpy() if result.ok else truth
    if F is not None:
        dashed = truth if result.ok else None
        if (c := result.undistorted) is None:
            ends = x0[good], x1[good]
        else:
            seen = (result.inliers if result.ok else c.mask[0]).cpu()
            ends = c.x0[0].cpu()[seen].double().numpy(), c.x1[0].cpu()[seen].double().numpy()
        pictures["epipolar.png"] = draw_epipolar_lines(*given.pinholes, *ends, F, truth=dashed)
    for name, picture in pictures.items():
        with replacing(folder / name) as path:
            path.write_bytes(cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
    for name in {"pruning.png", "epipolar.png"} - pictures.keys():  # of an earlier run
        (folder / name).unlink(missing_ok=True)
    return list(pictures)


def _troubles(result: MatchResult) -> list[str]:
    """What is said of a result that is not to be relied on."""
    warning = result.warning if result.related or result.pair_type != "unrelated" else ""  # which is said already
    if not result.ok:
        return list(filter(None, (f"no F: {result.reason}", warning)))
    chance = (
        "probably not the same scene: so much support is no surprise by chance alone "
        f"(significance {result.significance:.1f}; related from {RELATED:g} on)"
    )
    return list(filter(None, ("" if result.related else chance, warning)))


def _table(result: MatchResult, cached: bool) -> Table:
    """What each step left and took; cached: the features were computed by an earlier run, which took the seconds."""
    table = Table()
    table.add_column("step")
    table.add_column("left", justify="right")
    table.add_column("seconds", justify="right")
    for step, seconds in result.seconds.items():
        counts = (
            [len(result.keypoints0), len(result.keypoints1)] if step == "features" else [result.counts.get(step, 0)]
        )
        unit = {"features": "keypoints", "estimation": "inliers"}.get(step, "matches")
        left = f"{' + '.join(f'{count:,}' for count in counts)} {unit}"
        table.add_row(
            step, result.pair_type if step == "pair_type" else left,
            "cached" if cached and step == "features" else f"{seconds:.3f}",
        )  # fmt: skip
    return table


@job
def task(config: DictConfig) -> None:
    """What Hydra runs."""
    run(config, *chosen_pipeline())


def main() -> None:
    """The command."""
    run_command(MATCH, task)
