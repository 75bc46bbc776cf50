"""Learns the projection of RootSIFT-PCA from photographs: `python scripts/learn_pca.py --photos FOLDER`.

Writes models/rootsift_pca.npz: the mean and the 80 principal axes of RootSIFT descriptors at DoG keypoints (Bursuc,
Tolias and Jégou, ICMR 2015, section 4, there on patches of Brown et al.). Images: scikit-image's photographs of the
train split and, with --photos, a folder whose sources.txt names each file's source; only those of --sources are read.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from fmtorch.core.files import models_dir, replacing
from fmtorch.data import read_image
from fmtorch.features import learn_projection, local_feature
from fmtorch.scenes.textures import PICTURES, photograph

# Repositories under BSD, MIT or Apache licences.
SOURCES = (
    "danini/magsac", "mapillary/OpenSfM", "3DOM-FBK/deep-image-matching", "vbalnt/tfeat", "ducha-aiki/affnet",
    "cvg/LightGlue",
)  # fmt: skip
PER_IMAGE = 1500  # descriptors, so that no image weighs more than another


def images(photos: Path | None, sources: Sequence[str]) -> Iterator[NDArray[np.uint8]]:
    """The photographs to learn from."""
    for name in PICTURES["train"]:
        yield photograph(name)
    if photos is None:
        return
    for line in (photos / "sources.txt").read_text().splitlines():
        if line.startswith("#"):
            continue
        name, _, _, source = line.split()[:4]
        if source in sources:
            yield read_image(photos / name)


def main() -> None:
    torch.set_num_threads(1)  # many small steps: threads would wait for one another
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--sources", nargs="+", default=SOURCES, help="as in the fourth column of sources.txt")
    parser.add_argument("--output", type=Path, default=models_dir() / "rootsift_pca.npz")
    arguments = parser.parse_args()
    extract = local_feature("dog", "rootsift", max_features=PER_IMAGE)
    parts = [extract(image).descriptors for image in images(arguments.photos, arguments.sources)]
    descriptors = torch.cat(parts)
    mean, basis = learn_projection(descriptors[descriptors.any(1)])
    with replacing(arguments.output) as path, open(path, "wb") as file:
        np.savez(file, mean=mean.numpy(), basis=basis.numpy())
    digest = hashlib.sha256(arguments.output.read_bytes()).hexdigest()
    Console().print(f"{len(descriptors)} descriptors of {len(parts)} images; {arguments.output}: sha256 {digest}")


if __name__ == "__main__":
    main()
