"""Draws docs/overview.jpg, the picture of the README: one test pair of each rendered family through a pipeline.

python scripts/draw_overview.py [--output docs/overview.jpg] [--estimator lmeds]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from fmtorch import data, presets
from fmtorch.evaluation.pictures import draw_matches
from fmtorch.pipeline.pipeline import Pipeline

HEIGHT, GAP, WIDTH = 400, 8, 1600


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path(__file__).resolve().parents[1] / "docs" / "overview.jpg")
    parser.add_argument("--estimator", default="lmeds")
    parser.add_argument("--pair", type=int, default=3, help="which pair of each family")
    arguments = parser.parse_args()
    dataset = data.load("rendered", "test")
    pipeline = Pipeline(
        presets.build("features", "sift"),
        presets.build("matcher", "nearest"),
        {name: presets.build("pruner", name) for name in ("ratio", "one_to_one")},
        presets.build("estimator", arguments.estimator),
    )
    families: dict[str, list[int]] = {}
    for i in range(len(dataset)):
        families.setdefault(dataset[i].family, []).append(i)
    strips = []
    for members in families.values():
        pair = dataset[members[arguments.pair]]
        outcome = pipeline.run([pair])[0]
        assert outcome.correspondences is not None
        assert outcome.estimate is not None
        c = outcome.correspondences.compact()
        images = (data.read_image(pair.image0), data.read_image(pair.image1))
        count = int(c.count())
        points = (c.x0[0, :count].numpy(), c.x1[0, :count].numpy())
        inliers = outcome.estimate.inliers[0, :count].numpy()
        strips.append(draw_matches(*images, *points, inliers, height=HEIGHT, most=40))
    rows = [np.hstack([a, np.full((HEIGHT, GAP, 3), 255, np.uint8), b]) for a, b in _balanced(strips)]
    rows = [
        cv2.resize(row, (WIDTH, round(row.shape[0] * WIDTH / row.shape[1])), interpolation=cv2.INTER_AREA)
        for row in rows
    ]
    between = np.full((GAP, WIDTH, 3), 255, np.uint8)
    picture = np.vstack([part for row in rows for part in (row, between)][:-1])
    arguments.output.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(arguments.output), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


def _balanced(strips: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The widest beside the narrowest."""
    ordered = sorted(strips, key=lambda strip: strip.shape[1])
    return [(ordered[i], ordered[-1 - i]) for i in range(len(ordered) // 2)]


if __name__ == "__main__":
    main()
