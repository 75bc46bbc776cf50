"""Scenes reconstructed by COLMAP, such as those of Tanks and Temples (SIGGRAPH 2017) and CPC / 1DSfM (ECCV 2014)."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.colmap_model import Model, read_model
from fmtorch.data.pairs import ImageSource
from fmtorch.data.scenes import (
    MIN_SHARED,
    AllPairs,
    Candidates,
    DepthImages,
    DepthScenePairs,
    Scene,
    ScenePairs,
    View,
    chosen,
    folders,
    read_colmap,
    sharing_points,
)
from fmtorch.data.text_files import DataError, given_root

_MODELS = ("sparse/0", "sparse", "dense/sparse", ".")  # below a scene's folder, in the order in which they are tried
_FILES = ("cameras.bin", "cameras.txt")


def colmap_pairs(
    root: str | Path | None = None,
    split: str = "test",
    sequences: Sequence[str] | None = None,
    model: str | None = None,
    images: str = "images",
    candidates: Literal["all", "points"] = "all",
    shared: int = MIN_SHARED,
    pairs: int | None = 1000,
    seed: int = 0,
    family: str | None = None,
    depth: bool = True,
) -> ScenePairs:
    """Pairs of the images of COLMAP models, text or binary, one folder a scene.

    Args:
        root: a folder of scenes, or one scene's folder, which is taken whatever the split.
        split: test (Panther, Playground, Train, Roman_Forum) or train (Family, Francis, Horse, Lighthouse, M60), as in
            the paper.
        sequences: names of scenes to take instead.
        model: folder within the scene's; None: the first of sparse/0, sparse, dense/sparse and the scene's.
        images: folder within the scene's.
        candidates: all pairs of a scene, or those whose images share at least `shared` points of the reconstruction.
        shared: that number.
        pairs, seed: as in `ScenePairs`.
        family: of the pairs; None: the name of the folder of scenes.
        depth: know the depth of points, for labels, where every scene has depth maps of COLMAP's dense reconstruction,
            in ``stereo/depth_maps`` beside the folder of the images; geometric ones, or else photometric.

    Images with lens distortion are undistorted when they are read, to a pinhole of the same focal lengths, principal
    point and size (`fmtorch.data.lenses`). Principal points are lowered by COLMAP's half pixel. An image of another
    size than its camera's is refused when it is read. Raises DataError for a missing or damaged model.
    """
    home, model_folders = scene_folders(root, split, sequences, model)
    scenes, files = [], []
    for folder in model_folders:
        reconstruction = read_model(_model_folder(folder, model), points=candidates == "points")
        scenes.append(_scene(folder, reconstruction, images, candidates, shared, family or home.name))
        files += [(f"{folder.name}/{path.name}", path) for path in reconstruction.files]
    options = (candidates, shared, family or home.name)
    dataset: ScenePairs
    if not depth or not all(_depth_folder(folder / images).is_dir() for folder in model_folders):
        dataset = ScenePairs("colmap", scenes, files, options, pairs, seed)
        dataset.points = [functools.partial(_points, _model_folder(folder, model)) for folder in model_folders]
        return dataset
    dataset = DepthScenePairs("colmap", scenes, files, (*options, "depth"), pairs, seed)
    paths = [_depth_paths(folder / images, scene) for folder, scene in zip(model_folders, scenes, strict=True)]
    by_image = {key: path for by_identity in paths for key, path in by_identity.items()}
    dataset.depth_images = DepthImages(by_image, 1.0, read_colmap, reduced=True)
    return dataset


def _depth_folder(images: Path) -> Path:
    """Where COLMAP's dense reconstruction keeps the depth maps of a folder of images."""
    return images.parent / "stereo" / "depth_maps"


def _depth_paths(images: Path, scene: Scene) -> dict[str, Path]:
    """The depth map of each view that has one, by the identity of its image."""
    paths = {}
    for view in scene.views:
        name = view.image.path.relative_to(images)
        for kind in ("geometric", "photometric"):
            path = _depth_folder(images) / f"{name}.{kind}.bin"
            if path.is_file():
                paths[view.image.identity] = path
                break
    return paths


def _points(folder: Path) -> list[NDArray[np.int64]]:
    """The points that each image of a model sees."""
    return [image.points for image in read_model(folder).images]


def scene_folders(
    root: str | Path | None, split: str, sequences: Sequence[str] | None, model: str | None
) -> tuple[Path, list[Path]]:
    """The folder of scenes, and the scenes' folders: `root` itself where it is one."""
    home = given_root(root, "colmap", "a folder of scenes with a COLMAP model each, or one such scene").absolute()
    if sequences is None and any((home / place / file).is_file() for place in _places(model) for file in _FILES):
        return home.parent, [home]
    return home, folders(
        home, chosen("colmap", split, sequences, ()), "a folder for each scene, with sparse/ and images/"
    )


def _places(model: str | None) -> tuple[str, ...]:
    return _MODELS if model is None else (model,)


def _model_folder(folder: Path, model: str | None) -> Path:
    for place in _places(model):
        if any((folder / place / file).is_file() for file in _FILES):
            return folder / place
    tried = ", ".join(_places(model))
    raise DataError(f"{folder}: no COLMAP model in {tried}; one of these must hold {' or '.join(_FILES)}")


def _scene(
    folder: Path, model: Model, images: str, candidates: Literal["all", "points"], shared: int, family: str
) -> Scene:
    views = []
    for image in model.images:
        camera = model.cameras[image.camera]
        lens = camera.lens if camera.lens.bends else None
        source = ImageSource(f"{family}/{folder.name}/{image.name}", folder / images / image.name, camera.size, lens)
        views.append(View(source, camera.lens.K, image.R, image.t, image.place))
    pairs: Candidates = AllPairs(len(views))
    if candidates == "points":
        pairs = sharing_points([image.points for image in model.images], shared)
    return Scene(folder.name, family, views, pairs)
