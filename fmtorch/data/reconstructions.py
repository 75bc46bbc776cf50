"""Scenes reconstructed by COLMAP (Tanks and Temples, CPC) and by Bundler (1DSfM), as pairs of their images."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from fmtorch.core.lenses import Lens
from fmtorch.data import files, scenes
from fmtorch.data.files import DataError, Indices, given_root
from fmtorch.data.image_cameras import Model, read_model
from fmtorch.data.images import stored_size
from fmtorch.data.pairs import ImageSource, nearest_rotation
from fmtorch.data.scenes import MIN_SHARED, Scene, ScenePairs, View

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
        split: test (Panther, Playground, Train, Roman_Forum) or train (Family, Francis, Horse, Lighthouse, M60).
        sequences: names of scenes to take instead.
        model: folder within the scene's; None: the first of sparse/0, sparse, dense/sparse and the scene's.
        images: folder within the scene's.
        candidates, shared: all pairs of a scene, or those whose images share at least so many points of the model.
        pairs, seed: as in `ScenePairs`.
        family: of the pairs; None: the name of the folder of scenes.
        depth: know the depth of points, for labels, where every scene has depth maps of COLMAP's dense reconstruction,
            in ``stereo/depth_maps`` beside the folder of the images; geometric ones, or else photometric.

    Images with lens distortion are undistorted when they are read, to a pinhole of the same focal lengths, principal
    point and size (`undistorted`). Principal points are lowered by COLMAP's half pixel. An image of another size than
    its camera's is refused when it is read. Raises DataError for a missing or damaged model."""
    home, scene_folders = _scene_folders(root, split, sequences, model)
    model_folders = [_model_folder(folder, model) for folder in scene_folders]
    read, sources = [], []
    for folder, model_folder in zip(scene_folders, model_folders, strict=True):
        reconstruction = read_model(model_folder, points=candidates == "points")
        read.append(_scene(folder, reconstruction, images, candidates, shared, family or home.name))
        sources += [(f"{folder.name}/{path.name}", path) for path in reconstruction.files]
    options = (candidates, shared, family or home.name)
    if not depth or not all(_depth_folder(folder / images).is_dir() for folder in scene_folders):
        dataset = ScenePairs("colmap", read, sources, options, pairs, seed)
        dataset.points = [functools.partial(_points, folder) for folder in model_folders]
        return dataset
    paths = [_depth_paths(folder / images, scene) for folder, scene in zip(scene_folders, read, strict=True)]
    depth_images = scenes.DepthImages(paths, 1.0, scenes.read_colmap, reduced=True)
    return ScenePairs("colmap", read, sources, (*options, "depth"), pairs, seed, depth_images.at)


def _depth_folder(images: Path) -> Path:
    return images.parent / "stereo" / "depth_maps"


def _depth_paths(images: Path, scene: Scene) -> dict[str, Path]:
    paths = {}
    for view in scene.views:
        file = _depth_folder(images) / view.image.path.relative_to(images)
        for kind in ("photometric", "geometric"):  # the latter counts
            path = file.with_name(f"{file.name}.{kind}.bin")
            if path.is_file():
                paths[view.image.identity] = path
    return paths


def _points(folder: Path) -> list[Indices]:
    return [image.points for image in read_model(folder).images]


def _scene_folders(
    root: str | Path | None, split: str, sequences: Sequence[str] | None, model: str | None
) -> tuple[Path, list[Path]]:
    """The folder of scenes, and the scenes' folders: `root` itself where it is one."""
    home = given_root(root, "colmap", "a folder of scenes with a COLMAP model each, or one such scene").absolute()
    if sequences is None and _model_places(home, model):
        return home.parent, [home]
    names = scenes.chosen("colmap", split, sequences, ())
    return home, scenes.folders(home, names, "a folder for each scene, with sparse/ and images/")


def _model_places(folder: Path, model: str | None) -> list[Path]:
    places = _MODELS if model is None else (model,)
    return [folder / place for place in places if any((folder / place / file).is_file() for file in _FILES)]


def _model_folder(folder: Path, model: str | None) -> Path:
    if there := _model_places(folder, model):
        return there[0]
    tried = ", ".join(_MODELS if model is None else (model,))
    raise DataError(f"{folder}: no COLMAP model in {tried}; one of these must hold {' or '.join(_FILES)}")


def _scene(
    folder: Path, model: Model, images: str, candidates: Literal["all", "points"], shared: int, family: str
) -> Scene:
    views = []
    for image in model.images:
        camera = model.cameras[image.camera]
        assert camera.lens is not None  # of a model
        lens = camera.lens if camera.lens.bends else None
        source = ImageSource(f"{family}/{folder.name}/{image.name}", folder / images / image.name, camera.size, lens)
        views.append(View(camera.lens.K, image.R, image.t, source, image.place))
    points = [image.points for image in model.images] if candidates == "points" else None
    return Scene(folder.name, family, views, scenes.collection_pairs(len(views), points, shared))


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
    image is read. The principal point is the middle of each image, whose size is read from its file."""

    def __init__(
        self, root: str | Path | None = None, split: str = "test", sequences: Sequence[str] | None = None,
        candidates: Literal["all", "points"] = "all", shared: int = MIN_SHARED, pairs: int | None = 1000,
        seed: int = 0, family: str | None = None,
    ) -> None:  # fmt: skip
        wanted = "a folder of scenes with list.txt and a Bundler file each, or one such scene"
        home = given_root(root, "bundler", wanted).absolute()
        if sequences is None and (home / _LIST).is_file():
            home, sequences = home.parent, [home.name]
        names = scenes.chosen("colmap", split, sequences, ())
        bundles = [(f, _bundle(f)) for f in scenes.folders(home, names, f"a folder for each scene, with {_LIST}")]
        family = family or home.name
        read = [_bundler_scene(folder, file, candidates, shared, family) for folder, file in bundles]
        sources = [(folder.name, path) for folder, file in bundles for path in (file, folder / _LIST)]
        super().__init__("bundler", read, sources, (candidates, shared, family), pairs, seed)
        self.points = [functools.partial(_bundler_points, file) for _, file in bundles]


def _bundle(folder: Path) -> Path:
    for name in _BUNDLES:
        if (folder / name).is_file():
            return folder / name
    raise DataError(f"{folder}: no Bundler file; it must hold one of {', '.join(_BUNDLES)}")


def _bundler_scene(folder: Path, file: Path, candidates: Literal["all", "points"], shared: int, family: str) -> Scene:
    names = [line.split()[0] for _, line in files.numbered(folder / _LIST)]  # a focal length may stand behind
    lines = files.read_lines(file)
    if not lines or lines[0].strip() != _HEADER:
        raise DataError(f"{file}, line 1: {lines[0][:40] if lines else ''!r}; it must be {_HEADER!r}")
    cameras, points = _counts(file, lines)
    if cameras != len(names):
        listed = f"{folder / _LIST} has {len(names)} images"
        raise DataError(f"{file}, line 2: {cameras} cameras and {listed}; both must agree")
    end = 2 + _LINES * cameras + 3 * points
    if len(lines) < end:
        needed = f"{cameras} cameras and {points} points need {end}"
        raise DataError(f"{file} ends at line {len(lines)}; {needed}: truncated?")
    views, numbers = list[View](), dict[int, int]()
    for i, name in enumerate(names):
        view = _view(file, lines, i, ImageSource(f"{family}/{folder.name}/{name}", folder / name))
        if view is not None:
            numbers[i] = len(views)
            views.append(view)
    if not views:
        raise DataError(f"{file}: no camera has a focal length; none was registered")
    seen = _seen(file, lines, cameras, points, numbers) if candidates == "points" else None
    return Scene(folder.name, family, views, scenes.collection_pairs(len(views), seen, shared))


def _bundler_points(file: Path) -> list[Indices]:
    """The points that each registered camera of a file sees; the file was read before."""
    lines = files.read_lines(file)
    cameras, points = _counts(file, lines)
    registered = [i for i in range(cameras) if float(lines[2 + _LINES * i].split()[0]) != 0]
    return _seen(file, lines, cameras, points, {i: number for number, i in enumerate(registered)})


def _counts(file: Path, lines: list[str]) -> tuple[int, int]:
    words = lines[1].split() if len(lines) > 1 else []
    if len(words) != 2:
        raise DataError(f"{file}, line 2: {len(words)} columns; it must hold the numbers of cameras and of points")
    count = functools.partial(files.to_whole, file, 2)
    return count(words[0], "the number of cameras"), count(words[1], "the number of points")


def _view(file: Path, lines: list[str], i: int, source: ImageSource) -> View | None:
    """The view of camera i, if it was registered; an image that cannot be opened has a size that no pair will use."""
    first = 2 + _LINES * i
    rows = [files.to_finite(file, first + k + 1, lines[first + k].split(), _COLUMNS[k], 3) for k in range(_LINES)]
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
    return View(lens.K, R, _FLIP @ rows[4], image, place)


def _seen(file: Path, lines: list[str], cameras: int, points: int, numbers: dict[int, int]) -> list[Indices]:
    seen: list[list[int]] = [[] for _ in numbers]
    for point in range(points):
        number = 2 + _LINES * cameras + 3 * point + 3  # of the line, from 1
        words = lines[number - 1].split()
        count = files.to_whole(file, number, words[0], "the length of the view list") if words else -1
        if len(words) != 1 + 4 * count:
            raise DataError(f"{file}, line {number}: {len(words)} columns; it must hold n and n times camera key x y")
        for word in words[1::4]:
            camera = files.to_whole(file, number, word, "the number of a camera")
            if camera in numbers:
                seen[numbers[camera]].append(point)
    return [np.array(indices, dtype=np.int64) for indices in seen]
