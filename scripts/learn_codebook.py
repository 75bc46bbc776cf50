"""Learns the codebooks of VLAD from photographs: `python scripts/learn_codebook.py --photos FOLDER`.

Writes models/vlad_rootsift_pca.npz and models/vlad_hardnet.npz: mean and principal axes of local descriptors, and
centres of the projected ones by k-means. Images: those of scripts/learn_pca.py, all under permissive licences.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from fmtorch.core.files import models_dir, replacing
from fmtorch.features import learn_projection
from fmtorch.features.vlad import Codebook, Kind, local_descriptors
from fmtorch.pipeline.build import load_pipeline
from scripts.learn_pca import SOURCES, images

FEATURES: dict[str, tuple[str, Kind]] = {"rootsift_pca": ("sift", "sift"), "hardnet": ("hesaffnet", "hardnet")}
PER_IMAGE = 1500  # descriptors, so that no image weighs more than another
CENTERS, DIMENSIONS = 64, 64
ITERATIONS = 50


def k_means(x: Tensor, count: int, seed: int = 0) -> Tensor:
    """Centres (count, d) of x (n, d) by Lloyd's iterations from k-means++ (Arthur and Vassilvitskii, 2007)."""
    generator = torch.Generator().manual_seed(seed)
    centers = x[torch.randint(len(x), (1,), generator=generator)]
    nearest = (x - centers[0]).square().sum(1)
    while len(centers) < count:
        centers = torch.cat([centers, x[torch.multinomial(nearest, 1, generator=generator)]])
        nearest = torch.minimum(nearest, (x - centers[-1]).square().sum(1))
    for _ in range(ITERATIONS):
        assigned = torch.cdist(x, centers).argmin(1)
        counts = torch.bincount(assigned, minlength=count)
        sums = torch.zeros_like(centers).index_add_(0, assigned, x)
        centers = torch.where(counts[:, None] > 0, sums / counts.clamp(min=1)[:, None], centers)
    return centers


def learned(parts: list[Tensor], centers: int, dimensions: int) -> Codebook:
    """The codebook of these local descriptors."""
    descriptors = torch.cat(parts)
    mean, basis = learn_projection(descriptors, dimensions)
    return Codebook(mean, basis, k_means((descriptors - mean) @ basis, centers))


def main() -> None:
    torch.set_num_threads(1)  # many small steps: threads would wait for one another
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--sources", nargs="+", default=SOURCES, help="as in the fourth column of sources.txt")
    parser.add_argument("--only", choices=[*FEATURES], nargs="+", default=[*FEATURES])
    parser.add_argument("--every", type=int, default=1, help="of the photographs, every so many-th")
    parser.add_argument("--centers", type=int, default=CENTERS)
    parser.add_argument("--dimensions", type=int, default=DIMENSIONS)
    parser.add_argument("--output", type=Path, default=models_dir())
    arguments = parser.parse_args()
    for name in arguments.only:
        features, kind = FEATURES[name]
        options = [f"features={features}", f"features.max_features={PER_IMAGE}"]
        extract = load_pipeline("sift_ratio", overrides=options).extractor
        selected = itertools.islice(images(arguments.photos, arguments.sources), 0, None, arguments.every)
        parts = [local_descriptors(extract(image).descriptors, kind) for image in selected]
        book = learned(parts, arguments.centers, arguments.dimensions)
        file = arguments.output / f"vlad_{name}.npz"
        with replacing(file) as path, open(path, "wb") as stream:
            np.savez(stream, **{field: value.numpy() for field, value in book._asdict().items()})  # type: ignore[arg-type]
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        Console().print(f"{sum(map(len, parts))} descriptors of {len(parts)} images; {file}: sha256 {digest}")


if __name__ == "__main__":
    main()
