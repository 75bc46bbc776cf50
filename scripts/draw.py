"""Draws the pictures of the pages from rendered test scenes.

python scripts/draw.py gallery [--output docs/gallery]          those of docs/gallery.md; prints the page's figures
python scripts/draw.py overview [--output docs/overview.jpg]    that of the README: a pair of each rendered family
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

import fmtorch
from fmtorch import Correspondences, Estimate, data, metrics, presets
from fmtorch.data import ImagePair, read_image
from fmtorch.pipeline.pictures import draw_epipolar_lines, draw_matches
from fmtorch.pipeline.pipeline import load_pipeline

DOCS = Path(__file__).resolve().parents[1] / "docs"
GALLERY_WIDTH, OVERVIEW_WIDTH, HEIGHT, GAP = 1200, 1600, 400, 8  # px
PIPELINE, METHOD = "sift_fmtorch", "usac_magsac"  # ours; OpenCV's
OVERVIEW_PAIR = 3  # of each family

Picture = NDArray[np.uint8]


def images_of(pair: ImagePair) -> tuple[Picture, Picture]:
    return read_image(pair.image0), read_image(pair.image1)


def points(c: Correspondences, estimate: Estimate) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_]]:
    """Both ends of the matches (N, 2), px, and which are inliers."""
    x0, x1, inliers = (x[0][c.mask[0]] for x in (c.x0, c.x1, estimate.inliers))
    return x0.double().numpy(), x1.double().numpy(), inliers.numpy()


def resized(picture: Picture, width: int) -> Image.Image:
    size = width, round(picture.shape[0] * width / picture.shape[1])
    return Image.fromarray(picture).resize(size, Image.Resampling.BOX)


def gallery(folder: Path) -> None:
    pipeline, peer = load_pipeline(PIPELINE), presets.build("estimator", "opencv", method=METHOD)
    rows: list[tuple[ImagePair, Correspondences, list[Estimate], list[float]]] = []  # estimates and NSGD, ours first
    pairs = list(data.load("rendered", families=["orbit", "collection"]))
    for pair in pairs:
        (outcome,) = pipeline.run([pair])
        c, ours = outcome.correspondences, outcome.estimate
        if c is not None and ours is not None:
            both, F = [ours, peer(c, 0)], torch.as_tensor(pair.F)[None]
            rows.append((pair, c, both, [float(metrics.nsgd(F, e.F.double(), c.size0, c.size1)) for e in both]))

    def keep(name: str, picture: Picture) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        resized(picture, GALLERY_WIDTH).save(folder / f"{name}.jpg", quality=80)

    def epipolar(name: str, row: Any, estimate: Estimate) -> None:
        """The lines of an estimate at inliers of ours; the true lines are dashed."""
        pair, c, (ours, _), _ = row
        x0, x1, good = points(c, ours)
        ends = *images_of(pair), x0[good], x1[good]
        keep(name, draw_epipolar_lines(*ends, estimate.F[0].numpy(), truth=pair.F, most=10))

    most = max((row for row in rows if row[0].family == "orbit"), key=lambda row: int(row[1].count()))
    keep("matches", draw_matches(*images_of(most[0]), *points(most[1], most[2][0]), most=60))
    epipolar("epipolar", most, most[2][0])
    apart = max(rows, key=lambda row: min(row[3][1], 0.3) - 5 * row[3][0])
    for name, estimate in zip(("right", "wrong"), apart[2], strict=True):
        epipolar(name, apart, estimate)
    errors = "NSGD {:.4f} of fmtorch, {:.4f} of ".format(*apart[3]) + METHOD
    print(f"{apart[0].identity}: {int(apart[1].count())} matches; {errors}")

    orbits = [pair for pair in pairs if pair.family == "orbit"]
    images = read_image(orbits[0].image0), read_image(orbits[-1].image0)
    result = fmtorch.match(*images, pipeline=PIPELINE)
    x0, x1 = (t[0].double().numpy() for t in (result.correspondences.x0, result.correspondences.x1))
    keep("unrelated", draw_matches(*images, x0, x1, result.inliers.numpy()))
    print(f"unrelated: {int(result.inliers.sum())} inliers of {len(x0)}, significance {result.significance:.1f}")


def overview(path: Path) -> None:
    """One test pair of each rendered family, its matches classified by LMedS, two in a row."""
    pipeline = load_pipeline("sift_ratio", overrides=["pruner=[ratio,one_to_one]", "estimator=lmeds"])
    families: dict[str, list[ImagePair]] = {}
    for pair in data.load("rendered", "test"):
        families.setdefault(pair.family, []).append(pair)
    strips = []
    for pair in (members[OVERVIEW_PAIR] for members in families.values()):
        (outcome,) = pipeline.run([pair])
        assert outcome.correspondences is not None
        assert outcome.estimate is not None
        matches = points(outcome.correspondences.compact(), outcome.estimate)
        strips.append(draw_matches(*images_of(pair), *matches, height=HEIGHT, most=40))
    strips.sort(key=lambda strip: strip.shape[1])
    between = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    beside = zip(strips, reversed(strips[len(strips) // 2 :]), strict=False)  # the widest beside the narrowest
    rows = [resized(np.hstack([a, between, b]), OVERVIEW_WIDTH) for a, b in beside]
    whole = Image.new("RGB", (OVERVIEW_WIDTH, sum(row.height + GAP for row in rows) - GAP), "white")
    for i, row in enumerate(rows):
        whole.paste(row, (0, sum(above.height + GAP for above in rows[:i])))
    whole.save(path, quality=85)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["gallery", "overview"])
    parser.add_argument("--output", type=Path, help="a folder, or the file of the overview")
    arguments = parser.parse_args()
    draw, usual = {"gallery": (gallery, "gallery"), "overview": (overview, "overview.jpg")}[arguments.what]
    draw(arguments.output or DOCS / usual)


if __name__ == "__main__":
    main()
