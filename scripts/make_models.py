"""Makes learned files of models/ from photographs.

pca --photos FOLDER: models/rootsift_pca.npz, the mean and the 80 principal axes of RootSIFT descriptors at DoG
keypoints (Bursuc, Tolias and Jégou, ICMR 2015, section 4, there on patches of Brown et al.)
codebooks --photos FOLDER: models/vlad_rootsift_pca.npz and models/vlad_hardnet.npz, VLAD's codebooks: mean and
principal axes of local descriptors, and centres of the projected ones by k-means

Photographs: scikit-image's of the train split and, with --photos, a folder whose sources.txt names each file's source;
only those of --sources are read.
"""

import argparse
import hashlib
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from torch import Tensor

from fmtorch.core.files import models_dir, replacing
from fmtorch.core.terminal import console, exits_with_message
from fmtorch.data import read_image
from fmtorch.features import learn_projection, local_feature
from fmtorch.features.describe import Codebook, Kind, local_descriptors
from fmtorch.pipeline.pipeline import load_pipeline
from fmtorch.scenes.surfaces import PICTURES, photograph
from fmtorch.training.planes import list_photographs

SOURCES = ["danini/magsac", "mapillary/OpenSfM", "3DOM-FBK/deep-image-matching", "vbalnt/tfeat", "ducha-aiki/affnet"]
SOURCES += ["cvg/LightGlue"]  # all under BSD, MIT or Apache licences
PER_IMAGE = 1500  # descriptors, so that no image weighs more than another
FEATURES: dict[str, tuple[str, Kind]] = {"rootsift_pca": ("sift", "sift"), "hardnet": ("hesaffnet", "hardnet")}
CENTERS, DIMENSIONS = 64, 64
ITERATIONS = 50


def images(arguments: argparse.Namespace) -> Iterator[NDArray[np.uint8]]:
    for name in PICTURES["train"]:
        yield photograph(name)
    if arguments.photos is not None:
        for listed in list_photographs(arguments.photos, arguments.sources):
            yield read_image(listed.path)


def write(file: Path, arrays: Mapping[str, Tensor], parts: list[Tensor]) -> None:
    with replacing(file) as path, open(path, "wb") as stream:
        np.savez(stream, **{name: value.numpy() for name, value in arrays.items()})  # type: ignore[arg-type]
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    console.print(f"{sum(map(len, parts))} descriptors of {len(parts)} images; {file}: sha256 {digest}")


def pca(arguments: argparse.Namespace) -> None:
    extract = local_feature("dog", "rootsift", max_features=PER_IMAGE)
    parts = [extract(image).descriptors for image in images(arguments)]
    descriptors = torch.cat(parts)
    mean, basis = learn_projection(descriptors[descriptors.any(1)])
    write(arguments.output / "rootsift_pca.npz", {"mean": mean, "basis": basis}, parts)


def codebooks(arguments: argparse.Namespace) -> None:
    for name in arguments.only:
        features, kind = FEATURES[name]
        options = [f"features={features}", f"features.max_features={PER_IMAGE}"]
        extract = load_pipeline("sift_ratio", overrides=options).extractor
        selected = itertools.islice(images(arguments), 0, None, arguments.every)
        parts = [local_descriptors(extract(image).descriptors, kind) for image in selected]
        write(arguments.output / f"vlad_{name}.npz", learned(parts, CENTERS, DIMENSIONS)._asdict(), parts)


def learned(parts: list[Tensor], centers: int, dimensions: int) -> Codebook:
    """Centres by Lloyd's iterations from k-means++ (Arthur and Vassilvitskii, 2007)."""
    descriptors = torch.cat(parts)
    mean, basis = learn_projection(descriptors, dimensions)
    nearest, _ = kmeans2(((descriptors - mean) @ basis).numpy(), centers, iter=ITERATIONS, minit="++", seed=0)
    return Codebook(mean, basis, torch.from_numpy(nearest))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for function in (pca, codebooks):
        command = commands.add_parser(function.__name__)
        command.set_defaults(function=function)
        command.add_argument("--photos", type=Path)
        command.add_argument("--sources", nargs="+", default=SOURCES, help="as in the fourth column of sources.txt")
        command.add_argument("--output", type=Path, default=models_dir())
    command.add_argument("--only", choices=[*FEATURES], nargs="+", default=[*FEATURES])
    command.add_argument("--every", type=int, default=1, help="of the photographs, every so many-th")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # many small steps: threads would wait for one another
    with exits_with_message():
        arguments.function(arguments)


if __name__ == "__main__":
    main()
