"""Draws the pictures of docs/gallery.md from rendered test scenes, and prints the figures that the page gives.

python scripts/draw_gallery.py [--output docs/gallery]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

import fmtorch
from fmtorch import data, metrics, presets
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import ImagePair
from fmtorch.evaluation.pictures import draw_epipolar_lines, draw_matches
from fmtorch.pipeline.build import load_pipeline

WIDTH, QUALITY = 1200, 80
PIPELINE, PEER = "sift_fmtorch", ("opencv", {"method": "usac_magsac"})


Points = NDArray[np.float64]


def points(c: Correspondences, estimate: Estimate) -> tuple[Points, Points, NDArray[np.bool_]]:
    """Of a batch of one pair: both ends of its matches (N, 2), px, and which are inliers."""
    mask = c.mask[0]
    x0, x1 = (x[0][mask].double().numpy() for x in (c.x0, c.x1))
    return x0, x1, estimate.inliers[0][mask].numpy()


class Row(NamedTuple):
    """A pair, its matches, and what two estimators make of them; errors: NSGD of both."""

    pair: ImagePair
    matches: Correspondences
    ours: Estimate
    theirs: Estimate
    errors: tuple[float, float]


class Gallery:
    """The folder, and what a picture needs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.pipeline = load_pipeline(PIPELINE)
        self.peer = presets.build("estimator", PEER[0], **PEER[1])

    def save(self, name: str, picture: NDArray[np.uint8]) -> None:
        height = round(picture.shape[0] * WIDTH / picture.shape[1])
        smaller = cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(self.folder / f"{name}.jpg"), smaller[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])

    def estimates(self, pair: ImagePair) -> Row | None:
        """None where a stage failed."""
        outcome = self.pipeline.run([pair])[0]
        c, ours = outcome.correspondences, outcome.estimate
        if c is None or ours is None:
            return None
        theirs = self.peer(c, 0)
        F = torch.as_tensor(pair.F)[None]
        ours_error, theirs_error = (float(metrics.nsgd(F, e.F.double(), c.size0, c.size1)) for e in (ours, theirs))
        return Row(pair, c, ours, theirs, (ours_error, theirs_error))

    def epipolar(self, name: str, row: Row, estimate: Estimate) -> None:
        """The lines of an estimate at inliers of ours; the true lines are dashed."""
        x0, x1, good = points(row.matches, row.ours)
        images = data.read_image(row.pair.image0), data.read_image(row.pair.image1)
        F, truth = estimate.F[0].numpy(), row.pair.F
        self.save(name, draw_epipolar_lines(*images, x0[good], x1[good], F, truth=truth, most=10))


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path(__file__).resolve().parents[1] / "docs" / "gallery")
    gallery = Gallery(parser.parse_args(argv).output)
    pairs = data.load("rendered", families=["orbit", "collection"])
    rows = [row for i in range(len(pairs)) if (row := gallery.estimates(pairs[i])) is not None]

    row = max((row for row in rows if row.pair.family == "orbit"), key=lambda row: int(row.matches.count()))
    images = data.read_image(row.pair.image0), data.read_image(row.pair.image1)
    x0, x1, inliers = points(row.matches, row.ours)
    gallery.save("matches", draw_matches(*images, x0, x1, inliers, most=60))
    gallery.epipolar("epipolar", row, row.ours)

    row = max(rows, key=lambda row: min(row.errors[1], 0.3) - 5 * row.errors[0])
    gallery.epipolar("wrong", row, row.theirs)
    gallery.epipolar("right", row, row.ours)
    right, wrong = row.errors
    count = int(row.matches.count())
    print(f"{row.pair.identity}: {count} matches; NSGD {right:.4f} of fmtorch, {wrong:.4f} of {PEER[1]['method']}")

    orbits = [pairs[i] for i in range(len(pairs)) if pairs[i].family == "orbit"]
    first, second = orbits[0].image0, orbits[-1].image0
    result = fmtorch.match(data.read_image(first), data.read_image(second), pipeline=PIPELINE)
    x0, x1 = (t[0].double().numpy() for t in (result.correspondences.x0, result.correspondences.x1))
    inliers = result.inliers.numpy()
    gallery.save("unrelated", draw_matches(data.read_image(first), data.read_image(second), x0, x1, inliers))
    print(f"unrelated: {int(inliers.sum())} inliers of {len(x0)}, significance {result.significance:.1f}")


if __name__ == "__main__":
    main()
