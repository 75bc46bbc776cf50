"""Draws the pictures of the pages from rendered test scenes.

python scripts/draw.py gallery [--output docs/gallery]          those of docs/gallery.md; prints the page's figures
python scripts/draw.py overview [--output docs/overview.jpg]    that of the README: a pair of each rendered family
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

import fmtorch
from fmtorch import Correspondences, Estimate, data, metrics, presets
from fmtorch.data import ImagePair, read_image
from fmtorch.pipeline.pictures import draw_epipolar_lines, draw_matches
from fmtorch.pipeline.pipeline import load_pipeline

DOCS = Path(__file__).resolve().parents[1] / "docs"
GALLERY_WIDTH, OVERVIEW_WIDTH, HEIGHT, GAP = 1200, 1600, 400, 8  # px
PIPELINE, PEER = "sift_fmtorch", ("opencv", {"method": "usac_magsac"})
OVERVIEW_PAIR = 3  # of each family

Picture = NDArray[np.uint8]


class Row(NamedTuple):
    """A pair, its matches, and what two estimators make of them; errors: NSGD of both."""

    pair: ImagePair
    matches: Correspondences
    ours: Estimate
    theirs: Estimate
    errors: tuple[float, float]


def images_of(pair: ImagePair) -> tuple[Picture, Picture]:
    return read_image(pair.image0), read_image(pair.image1)


def points(c: Correspondences, estimate: Estimate) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_]]:
    """Both ends of the matches (N, 2), px, and which are inliers."""
    mask = c.mask[0]
    x0, x1 = (x[0][mask].double().numpy() for x in (c.x0, c.x1))
    return x0, x1, estimate.inliers[0][mask].numpy()


def resized(picture: Picture, width: int) -> Picture:
    size = width, round(picture.shape[0] * width / picture.shape[1])
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def save(path: Path, picture: Picture, quality: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])


def gallery(folder: Path) -> None:
    pipeline, peer = load_pipeline(PIPELINE), presets.build("estimator", PEER[0], **PEER[1])
    pairs = list(data.load("rendered", families=["orbit", "collection"]))
    rows = []
    for pair, outcome in zip(pairs, (pipeline.run([pair])[0] for pair in pairs), strict=True):
        c, ours = outcome.correspondences, outcome.estimate
        if c is not None and ours is not None:
            theirs, F = peer(c, 0), torch.as_tensor(pair.F)[None]
            right, wrong = (float(metrics.nsgd(F, e.F.double(), c.size0, c.size1)) for e in (ours, theirs))
            rows.append(Row(pair, c, ours, theirs, (right, wrong)))

    def keep(name: str, picture: Picture) -> None:
        save(folder / f"{name}.jpg", resized(picture, GALLERY_WIDTH), 80)

    def epipolar(name: str, row: Row, estimate: Estimate) -> None:
        """The lines of an estimate at inliers of ours; the true lines are dashed."""
        x0, x1, good = points(row.matches, row.ours)
        ends = *images_of(row.pair), x0[good], x1[good]
        keep(name, draw_epipolar_lines(*ends, estimate.F[0].numpy(), truth=row.pair.F, most=10))

    most = max((row for row in rows if row.pair.family == "orbit"), key=lambda row: int(row.matches.count()))
    keep("matches", draw_matches(*images_of(most.pair), *points(most.matches, most.ours), most=60))
    epipolar("epipolar", most, most.ours)
    apart = max(rows, key=lambda row: min(row.errors[1], 0.3) - 5 * row.errors[0])
    epipolar("wrong", apart, apart.theirs)
    epipolar("right", apart, apart.ours)
    errors = "NSGD {:.4f} of fmtorch, {:.4f} of ".format(*apart.errors) + PEER[1]["method"]
    print(f"{apart.pair.identity}: {int(apart.matches.count())} matches; {errors}")

    orbits = [pair for pair in pairs if pair.family == "orbit"]
    images = read_image(orbits[0].image0), read_image(orbits[-1].image0)
    result = fmtorch.match(*images, pipeline=PIPELINE)
    x0, x1 = (t[0].double().numpy() for t in (result.correspondences.x0, result.correspondences.x1))
    keep("unrelated", draw_matches(*images, x0, x1, result.inliers.numpy()))
    print(f"unrelated: {int(result.inliers.sum())} inliers of {len(x0)}, significance {result.significance:.1f}")


def overview(path: Path) -> None:
    """One test pair of each rendered family, its matches classified by LMedS."""
    pipeline = load_pipeline("sift_ratio", overrides=["pruner=[ratio,one_to_one]", "estimator=lmeds"])
    families: dict[str, list[ImagePair]] = {}
    for pair in data.load("rendered", "test"):
        families.setdefault(pair.family, []).append(pair)
    strips = []
    for pair in (members[OVERVIEW_PAIR] for members in families.values()):
        outcome = pipeline.run([pair])[0]
        assert outcome.correspondences is not None
        assert outcome.estimate is not None
        matches = points(outcome.correspondences.compact(), outcome.estimate)
        strips.append(draw_matches(*images_of(pair), *matches, height=HEIGHT, most=40))
    strips.sort(key=lambda strip: strip.shape[1])
    between = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    beside = zip(strips, reversed(strips[len(strips) // 2 :]), strict=False)  # the widest beside the narrowest
    rows = [resized(np.hstack([a, between, b]), OVERVIEW_WIDTH) for a, b in beside]
    below = np.full((GAP, OVERVIEW_WIDTH, 3), 255, np.uint8)
    save(path, np.vstack([part for row in rows for part in (row, below)][:-1]), 85)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["gallery", "overview"])
    parser.add_argument("--output", type=Path, help="a folder, or the file of the overview")
    arguments = parser.parse_args()
    draw, usual = {"gallery": (gallery, "gallery"), "overview": (overview, "overview.jpg")}[arguments.what]
    draw(arguments.output or DOCS / usual)


if __name__ == "__main__":
    main()
