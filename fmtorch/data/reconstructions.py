"""Scenes reconstructed by COLMAP (Tanks and Temples, CPC) and by Bundler (1DSfM), as pairs of their images."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.cameras import Lens, nearest_rotation
from fmtorch.data.files import DataError, given_root, numbered, read_lines, to_finite, to_whole
from fmtorch.data.image_cameras import Model, read_model
from fmtorch.data.images import stored_size
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

_MODELS = ("sparse/0", "sparse", "dense/sparse", ".")  # below a scene's folder, in the order in which they are tried
_FILES = ("cameras.bin", "cameras.txt")


def colmap_pairs(
    root: str | Path | None = None, split: str = "test", sequences: Sequence[str] | None = None,
    model: str | None = None, images: str = "images", candidates: Literal["all", "points"] = "all",
    shared: int = MIN_SHARED, pairs: int | None = 1000, seed: int = 0, family: str | None = None, depth: bool = True,
) -> ScenePairs:  # fmt: skip
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
    point and size (`fmtorch.data.cameras`). Principal points are lowered by COLMAP's half pixel. An image of another
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


# Scenes reconstructed by Bundler (Snavely et al., SIGGRAPH 2006), as 1DSfM (Wilson and Snavely, ECCV 2014) has them


_BUNDLES = ("gt_bundle.out", "bundle.out", "bundle/bundle.out")  # within a scene's folder, in the order they are tried
_LIST = "list.txt"
_HEADER = "# Bundle file v0.3"
_FLIP = np.diag([1.0, -1.0, -1.0])  # Bundler's y points up and its camera looks along -z
_LINES = 5  # a camera: f k1 k2, R in three lines, t
_COLUMNS = ("f k1 k2", "the first row of R", "the second row of R", "the third row of R", "t")


class BundlerPairs(ScenePairs):
    """Pairs of the images of Bundler files, one folder a scene.

    root: a folder of scenes, or one scene's folder, with ``list.txt`` and ``gt_bundle.out``, ``bundle.out`` or
    ``bundle/bundle.out``. split, sequences, candidates, shared, pairs, seed, family: as in `colmap_pairs`.

    Cameras without a focal length, which Bundler did not register, are left out. Radial distortion is taken out when an
    image is read. The principal point is the middle of each image, whose size is read from its file.
    """

    def __init__(
        self, root: str | Path | None = None, split: str = "test", sequences: Sequence[str] | None = None,
        candidates: Literal["all", "points"] = "all", shared: int = MIN_SHARED, pairs: int | None = 1000,
        seed: int = 0, family: str | None = None,
    ) -> None:  # fmt: skip
        home = given_root(
            root, "bundler", "a folder of scenes with list.txt and a Bundler file each, or one such scene"
        ).absolute()
        if sequences is None and (home / _LIST).is_file():
            home, sequences = home.parent, [home.name]
        scene_folders = folders(home, chosen("colmap", split, sequences, ()), f"a folder for each scene, with {_LIST}")
        files = [_bundle(folder) for folder in scene_folders]
        scenes = [
            _bundler_scene(folder, file, candidates, shared, family or home.name)
            for folder, file in zip(scene_folders, files, strict=True)
        ]
        sources = [(f.name, path) for f, file in zip(scene_folders, files, strict=True) for path in (file, f / _LIST)]
        super().__init__("bundler", scenes, sources, (candidates, shared, family or home.name), pairs, seed)
        self.points = [functools.partial(_bundler_points, file) for file in files]


def _bundle(folder: Path) -> Path:
    for name in _BUNDLES:
        if (folder / name).is_file():
            return folder / name
    raise DataError(f"{folder}: no Bundler file; it must hold one of {', '.join(_BUNDLES)}")


def _bundler_scene(folder: Path, file: Path, candidates: Literal["all", "points"], shared: int, family: str) -> Scene:
    names = [line.split()[0] for _, line in numbered(folder / _LIST)]  # a focal length may stand behind
    lines = read_lines(file)
    if not lines or lines[0].strip() != _HEADER:
        raise DataError(f"{file}, line 1: {lines[0][:40] if lines else ''!r}; it must be {_HEADER!r}")
    cameras, points = _counts(file, lines)
    if cameras != len(names):
        raise DataError(
            f"{file}, line 2: {cameras} cameras and {folder / _LIST} has {len(names)} images; both must agree"
        )
    end = 2 + _LINES * cameras + 3 * points
    if len(lines) < end:
        raise DataError(
            f"{file} ends at line {len(lines)}; {cameras} cameras and {points} points need {end}: truncated?"
        )
    views, numbers = list[View](), dict[int, int]()
    for i, name in enumerate(names):
        view = _view(file, lines, i, ImageSource(f"{family}/{folder.name}/{name}", folder / name))
        if view is not None:
            numbers[i] = len(views)
            views.append(view)
    if not views:
        raise DataError(f"{file}: no camera has a focal length; none was registered")
    pairs: Candidates = AllPairs(len(views))
    if candidates == "points":
        pairs = sharing_points(_seen(file, lines, cameras, points, numbers), shared)
    return Scene(folder.name, family, views, pairs)


def _bundler_points(file: Path) -> list[NDArray[np.int64]]:
    """The points that each registered camera of a file sees; the file was read before."""
    lines = read_lines(file)
    cameras, points = _counts(file, lines)
    registered = [i for i in range(cameras) if float(lines[2 + _LINES * i].split()[0]) != 0]
    return _seen(file, lines, cameras, points, {i: number for number, i in enumerate(registered)})


def _counts(file: Path, lines: list[str]) -> tuple[int, int]:
    words = lines[1].split() if len(lines) > 1 else []
    if len(words) != 2:
        raise DataError(f"{file}, line 2: {len(words)} columns; it must hold the numbers of cameras and of points")
    return to_whole(file, 2, words[0], "the number of cameras"), to_whole(file, 2, words[1], "the number of points")


def _view(file: Path, lines: list[str], i: int, source: ImageSource) -> View | None:
    """The view of camera i, if it was registered; an image that cannot be opened has a size that no pair will use."""
    first = 2 + _LINES * i
    rows = [to_finite(file, first + k + 1, lines[first + k].split(), _COLUMNS[k], 3) for k in range(_LINES)]
    focal, k1, k2 = (float(value) for value in rows[0])
    if focal == 0:
        return None
    place = f"{file}, line {first + 1}"
    if focal < 0:
        raise DataError(f"{place}: focal length {focal:g}; it must be positive")
    h, w = stored_size(source.path) or (1, 1)  # reading an image without a header tells
    lens = Lens(focal, focal, (w - 1) / 2, (h - 1) / 2, "RADIAL", (k1, k2))
    R = _FLIP @ nearest_rotation(np.stack(rows[1:4]), place)
    image = ImageSource(source.identity, source.path, (h, w), lens if lens.bends else None)
    return View(image, lens.K, R, _FLIP @ rows[4], place)


def _seen(file: Path, lines: list[str], cameras: int, points: int, numbers: dict[int, int]) -> list[NDArray[np.int64]]:
    seen: list[list[int]] = [[] for _ in numbers]
    for point in range(points):
        number = 2 + _LINES * cameras + 3 * point + 3  # of the line, from 1
        words = lines[number - 1].split()
        count = to_whole(file, number, words[0], "the length of the view list") if words else -1
        if len(words) != 1 + 4 * count:
            raise DataError(f"{file}, line {number}: {len(words)} columns; it must hold n and n times camera key x y")
        for word in words[1::4]:
            camera = to_whole(file, number, word, "the number of a camera")
            if camera in numbers:
                seen[numbers[camera]].append(point)
    return [np.array(indices, dtype=np.int64) for indices in seen]
