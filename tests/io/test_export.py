"""Export: pycolmap reads the database, verifies the same matches and finds the cameras; hloc's files come back.
Exchange: keypoints, matches and geometries of other libraries are taken, and given back the same."""

import csv
import dataclasses
import itertools
import json
import math
import sqlite3
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation
from torch import Tensor

import fmtorch
from fmtorch import io
from fmtorch.evaluation import MAX_THUMBNAILS, view_graph_svg
from fmtorch.features import keypoints_to_lafs
from fmtorch.geometry import sampson
from fmtorch.io import ORIGIN, write_database
from fmtorch.pipeline import FolderMatches, chosen_pairs, folder_workers, images_below, load_pipeline
from tests.conftest import shared_path
from tests.laws import scene
from tests.reference.known_cameras import fundamental

K = np.array([[1000.0, 0, 480], [0, 1000, 410], [0, 0, 1]])
SIZE, POINTS, IMAGES, WRONG = (800, 1000), 250, 6, 25


class Circle:
    """Cameras on an arc around points; each pair's matches hold some that are wrong, and are no inliers of F."""

    def __init__(self, known: bool = True) -> None:
        rng = np.random.default_rng(0)
        X = rng.uniform(-2, 2, (POINTS, 3))
        self.R = [Rotation.from_euler("y", 12 * i, degrees=True).as_matrix() for i in range(IMAGES)]
        self.t = [np.array([0.0, 0.2 * i, 8.0]) for i in range(IMAGES)]
        self.images, self.pairs = [], []
        for i, (R, t) in enumerate(zip(self.R, self.t, strict=True)):
            x = (X @ R.T + t) @ K.T
            x = x[:, :2] / x[:, 2:] + 0.3 * rng.normal(size=(POINTS, 2))
            lonely = rng.uniform(0, 800, (i, 2))  # so that the same point has another index in each image
            points = np.concatenate([lonely, x]).astype(np.float32)
            scores = np.ones(len(points), np.float32)
            self.images.append(io.StoredImage(f"{i}.png", points, scores, SIZE, K if known else None))
        for i in range(IMAGES):
            for j in range(i + 1, IMAGES):
                partner = np.arange(POINTS)
                partner[:WRONG] = rng.permutation(WRONG)
                right = partner == np.arange(POINTS)
                matches = np.stack([np.arange(POINTS) + i, partner + j], 1).astype(np.int32)
                scores = rng.uniform(0.1, 1, POINTS).astype(np.float32)
                self.pairs.append(io.StoredPair(f"{i}.png", f"{j}.png", matches, scores, right, self.F(i, j)))

    def F(self, i: int, j: int) -> np.ndarray:
        R = self.R[j] @ self.R[i].T
        return fundamental(R, self.t[j] - R @ self.t[i], (K, K))


def errors(model: Any, names: list[str], R: list[np.ndarray], centres: np.ndarray) -> tuple[float, float]:
    """Largest error of rotations, in degrees, and of centres, as a share of their spread, after the best similarity."""
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    index = [names.index(image.name) for image in images]
    C, true = np.array([image.projection_center() for image in images]), centres[index]
    a, b = C - C.mean(0), true - true.mean(0)
    turn, _ = Rotation.align_vectors(b, a)
    moved = turn.apply(a)
    moved *= (moved * b).sum() / (a**2).sum()
    rotations = Rotation.from_matrix([image.cam_from_world().rotation.matrix() for image in images])
    turns = rotations * (Rotation.from_matrix([R[i] for i in index]) * turn).inv()
    shift = np.linalg.norm(moved - b, axis=1).max() / pdist(true).max()
    return float(np.rad2deg(turns.magnitude().max())), float(shift)


def mapped(database: Path, folder: Path, **options: Any) -> Any:
    pycolmap.set_random_seed(0)
    own = {"extract_colors": False, "min_model_size": 3, "random_seed": 0, "num_threads": 1}
    config = pycolmap.IncrementalPipelineOptions(**own, **options)
    models = pycolmap.incremental_mapping(database, folder, folder, config)
    return max(models.values(), key=lambda model: model.num_reg_images())


def geometries(database: Path) -> dict[int, Any]:
    with pycolmap.Database.open(database) as file:
        return {key: g for key, g in zip(*file.read_two_view_geometries(), strict=True) if len(g.inlier_matches)}


def verified(database: Path) -> dict[int, Any]:
    """COLMAP's own geometric verification of the database's matches, in place of ours."""
    with pycolmap.Database.open(database) as file:
        file.clear_two_view_geometries()
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    pycolmap.geometric_verification(database, two_view_geometry_options=options)
    return geometries(database)


@pytest.mark.parametrize("known", [True, False])
def test_pycolmap_reads_verifies_and_reconstructs(known: bool, tmp_path: Path) -> None:
    circle = Circle(known)
    write_database(tmp_path / io.DATABASE, circle.images, circle.pairs, shared_camera=True)
    with pycolmap.Database.open(tmp_path / io.DATABASE) as file:
        assert (file.num_images(), file.num_cameras(), file.num_rigs(), file.num_frames()) == (IMAGES, 1, 1, IMAGES)
        image = file.read_image_with_name("3.png")
        np.testing.assert_array_equal(file.read_keypoints(image.image_id)[:, :2], circle.images[3].points + 0.5)
        camera = file.read_camera(image.camera_id)
        assert camera.has_prior_focal_length == known
        if known:
            np.testing.assert_allclose(camera.calibration_matrix()[:2, 2], K[:2, 2] + ORIGIN)
        two = file.read_two_view_geometry(2, 5)
    pair = next(p for p in circle.pairs if (p.name0, p.name1) == ("1.png", "4.png"))
    assert set(map(tuple, two.inlier_matches.tolist())) == set(map(tuple, pair.matches[pair.inliers].tolist()))
    x0, x1 = (circle.images[k].points[two.inlier_matches[:, i]] + 0.5 for i, k in ((0, 1), (1, 4)))
    ends = [np.column_stack([x, np.ones(len(x))]) for x in (x0, x1)]
    lines = ends[0] @ two.F.T
    distance = np.abs((ends[1] * lines).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)
    assert distance.max() < 5 * 0.3 * np.sqrt(2)  # five standard deviations of the noise of both ends
    # The same matches by COLMAP's own RANSAC, whose threshold is 4 px: all of ours, and of the wrong ones few.
    model = mapped(tmp_path / io.DATABASE, tmp_path, ba_refine_focal_length=not known)
    ours, theirs = geometries(tmp_path / io.DATABASE), verified(tmp_path / io.DATABASE)
    assert ours.keys() == theirs.keys()
    for key, geometry in ours.items():
        a, b = (set(map(tuple, g.inlier_matches.tolist())) for g in (geometry, theirs[key]))
        assert len(a - b) <= 0.02 * len(a)
        assert len(b - a) <= WRONG
    centres = np.array([-R.T @ t for R, t in zip(circle.R, circle.t, strict=True)])
    turn, shift = errors(model, [image.name for image in circle.images], circle.R, centres)
    assert model.num_reg_images() == IMAGES
    # With K given, as exact as some hundred points at 0.3 px of f = 1000 px allow; else the principal point is off by
    # 20 px, which turns the cameras by 20 / 1000.
    assert turn < (0.1 if known else 1.5)
    assert shift < (0.005 if known else 0.05)


def test_matches_that_share_a_keypoint_are_sorted_out_for_tracks(tmp_path: Path) -> None:
    image = [io.StoredImage(f"{i}.png", np.eye(4, 2, dtype=np.float32), np.ones(4, np.float32), SIZE) for i in (0, 1)]
    matches = np.array([[0, 0], [0, 1], [1, 1], [2, 2]], np.int32)
    scores = np.array([0.2, 0.9, 0.5, 0.5], np.float32)
    inliers = np.array([True, False, False, True])
    pair = io.StoredPair("0.png", "1.png", matches, scores, inliers, np.eye(3))
    write_database(tmp_path / io.DATABASE, image, [pair])
    with pycolmap.Database.open(tmp_path / io.DATABASE) as file:
        assert sorted(file.read_matches(1, 2).tolist()) == [[0, 0], [1, 1], [2, 2]]  # an inlier before a better score
        assert file.read_two_view_geometry(1, 2).inlier_matches.tolist() == [[0, 0], [2, 2]]


def test_pairs_of_different_scenes_are_not_verified(tmp_path: Path) -> None:
    circle = Circle()
    write_database(tmp_path / io.DATABASE, circle.images, [dataclasses.replace(circle.pairs[0], related=False)])
    with pycolmap.Database.open(tmp_path / io.DATABASE) as file:
        assert (file.num_matched_image_pairs(), file.num_verified_image_pairs()) == (1, 0)


def test_keypoints_are_recovered() -> None:
    points = np.array([[1, 2], [3, 4], [1, 2], [5, 6]], np.float32)
    assert io.indices(points, points[[3, 2, 0]]).tolist() == [3, 0, 0]  # of several at one place the first
    assert io.indices(points, points[:0]).shape == (0,)
    with pytest.raises(ValueError, match=r"the match at \(1.5, 2.0\) is at no keypoint"):
        io.indices(points, np.array([[1.5, 2.0]], np.float32))
    with pytest.raises(ValueError, match=r"the match at \(1.0, 2.0\) is at no keypoint"):
        io.indices(points[:0], points[:1])


def journal(folder: Path, circle: Circle) -> tuple[io.MatchStore, list[tuple[Path, Path]]]:
    (folder / "images").mkdir(parents=True)
    paths = [folder / "images" / image.name for image in circle.images]
    for i, path in enumerate(paths):
        cv2.imwrite(str(path), np.full((8, 10), i, np.uint8))
    kept = io.MatchStore(folder / "export", folder / "images")
    for path, image in zip(paths, circle.images, strict=True):
        kept.add_image(path, image)
    ends = []
    for pair in circle.pairs:
        ends.append((folder / "images" / pair.name0, folder / "images" / pair.name1))
        kept.add_pair(*ends[-1], pair)
    return kept, ends


def test_what_a_journal_keeps_comes_back_and_is_of_the_image_it_was_made_of(tmp_path: Path) -> None:
    circle = Circle()
    kept, ends = journal(tmp_path, circle)
    again = kept.pair(*ends[4])
    for name in ("name0", "name1", "related"):
        assert getattr(again, name) == getattr(circle.pairs[4], name)
    for name in ("matches", "scores", "inliers", "F"):
        np.testing.assert_array_equal(getattr(again, name), getattr(circle.pairs[4], name))
    image = kept.image(ends[0][0])
    assert (image.name, image.size) == ("0.png", SIZE)
    np.testing.assert_array_equal(image.K, K)
    cv2.imwrite(str(ends[0][0]), np.full((8, 11), 77, np.uint8))  # another image of the same name
    assert not kept.has_image(ends[0][0])
    assert not kept.has_pair(*ends[0])
    assert kept.has_pair(*ends[-1])


def test_hloc_files(tmp_path: Path) -> None:
    circle = Circle()
    kept, ends = journal(tmp_path, circle)
    names = io.write_exports(kept, ends, io.export_kinds("h5,colmap"), tmp_path)
    assert names == ["features.h5", "matches.h5", io.DATABASE]
    pair = circle.pairs[4]
    with h5py.File(tmp_path / "features.h5") as features, h5py.File(tmp_path / "matches.h5") as matches:
        assert features["0.png/keypoints"].dtype == np.float32
        np.testing.assert_array_equal(features["0.png/keypoints"], circle.images[0].points)
        assert features["0.png/image_size"][:].tolist() == [1000, 800]
        group = matches[f"{pair.name0}/{pair.name1}"]
        assert group["matches0"].dtype == np.int32
        # What hloc's own reader makes of it: the index, and the entry where that is not -1.
        first = np.flatnonzero(group["matches0"][:] != -1)
        np.testing.assert_array_equal(np.stack([first, group["matches0"][:][first]], 1), pair.matches)
        np.testing.assert_array_equal(group["matching_scores0"][:][first], pair.scores)
        np.testing.assert_array_equal(group["inliers0"][:][first], pair.inliers)
        np.testing.assert_array_equal(group.attrs["F"], pair.F)
    with sqlite3.connect(tmp_path / io.DATABASE) as file:
        assert file.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone() == (len(circle.pairs),)


@pytest.mark.parametrize(("library", "kind"), [("h5py", "h5"), ("pycolmap", "colmap")])
def test_kinds_are_words_and_a_missing_extra_is_named(library: str, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = [io.export_kinds(given) for given in (None, "colmap, h5", [kind])]
    assert kinds == [(), ("colmap", "h5"), (kind,)]
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=rf"pip install 'fmtorch\[{kind}\]'"):
        io.export_kinds(kind)


SVG = "{http://www.w3.org/2000/svg}"


def edge(image0: str, image1: str, inliers: int = 50, related: bool = True) -> io.Edge:
    return io.Edge(image0, image1, 2 * inliers, inliers, 3.5 if related else None, related, "")


def test_of_a_journal(tmp_path: Path) -> None:
    images = [tmp_path / name for name in ("a.png", "b.png", "c.png")]
    for image in images:
        image.write_text(image.name)
    journal = io.MatchStore(tmp_path / "export", tmp_path)
    matches, scores, inliers = np.zeros((3, 2), np.int32), np.ones(3, np.float32), np.array([True, True, False])
    verdict = {"significance": 12.5, "pair_type": "planar"}
    given = io.StoredPair("a.png", "b.png", matches, scores, inliers, np.eye(3), **verdict)
    journal.add_pair(*images[:2], given)
    journal.add_pair(images[0], images[2], io.StoredPair(
        "a.png", "c.png", matches, scores, ~inliers, np.zeros((3, 3)), False, significance=-math.inf))  # fmt: skip
    pairs = [(images[0], images[1]), (images[0], images[2]), (images[1], images[2])]
    graph = io.view_graph(journal, images, pairs)
    assert graph.images == ("a.png", "b.png", "c.png")
    assert graph.edges == (
        io.Edge("a.png", "b.png", 3, 2, 12.5, True, "planar"), io.Edge("a.png", "c.png", 3, 1, None, False, ""),
    )  # fmt: skip
    assert io.write_view_graph(graph, tmp_path) == ["graph.json", "graph.csv"]
    content = json.loads((tmp_path / "graph.json").read_text())
    assert content["components"] == [["a.png", "b.png"], ["c.png"]]
    assert content["pairs"][0]["pair_type"] == "planar"
    with (tmp_path / "graph.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["image1"], row["inliers"], row["significance"]) for row in rows] == [
        ("b.png", "2", "12.5"), ("c.png", "1", ""),
    ]  # fmt: skip


@pytest.mark.parametrize("count", [1, 3, MAX_THUMBNAILS + 1, 200])
def test_a_picture_of_any_number_of_images(count: int) -> None:
    names = tuple(f"folder/<{i}>&.jpg" for i in range(count))
    edges = tuple(edge(a, b, inliers=10 * i + 1) for i, (a, b) in enumerate(itertools.pairwise(names)))
    unrelated = (edge(names[0], names[-1], related=False),)
    asked = []

    def read(name: str) -> np.ndarray | None:
        asked.append(name)
        return np.full((30, 40, 3) if len(asked) % 2 else (40, 30), 90, np.uint8) if len(asked) != 2 else None

    root = ElementTree.fromstring(view_graph_svg(io.ViewGraph(names, edges + unrelated), read))
    lines = root.findall(f"{SVG}line")
    assert len(lines) == count - 1
    widths = [float(line.get("stroke-width", "nan")) for line in lines]
    assert widths == sorted(widths)
    shown = count if count <= MAX_THUMBNAILS else 0
    assert len(asked) == shown
    assert len(root.findall(f"{SVG}g/{SVG}image")) == max(shown - (shown > 1), 0)
    titles = [title.text for title in root.iter(f"{SVG}title")]
    assert all(name in titles for name in names)
    for node in root.findall(f"{SVG}circle"):
        assert 0 < float(node.get("cx", "nan")) < 900
        assert 0 < float(node.get("cy", "nan")) < 900


CALIBRATION = torch.tensor([[800.0, 0, 479.5], [0, 800, 319.5], [0, 0, 1]], dtype=torch.float64)


@pytest.fixture(scope="module")
def points() -> tuple[Tensor, Tensor]:
    c = scene(0, 60)
    return c.x0[0], c.x1[0]


@pytest.fixture(scope="module")
def pose(points: tuple[Tensor, Tensor]) -> fmtorch.PoseEstimate:
    return fmtorch.find_essential(*points, CALIBRATION, CALIBRATION)


def keypoints(x: Tensor, turn: float) -> list[cv2.KeyPoint]:
    return [cv2.KeyPoint(float(a), float(b), 4.0 + i % 5, (10 * i + turn) % 360) for i, (a, b) in enumerate(x.tolist())]


def test_keypoints_and_matches_of_opencv(points: tuple[Tensor, Tensor]) -> None:
    keypoints0, keypoints1 = keypoints(points[0], 0), keypoints(points[1], 20)[::-1]
    n = len(keypoints0)
    best = [cv2.DMatch(i, n - 1 - i, 30.0 + i) for i in range(n)]
    given = fmtorch.from_opencv(keypoints0, keypoints1, best)
    assert given.keys() == {"x0", "x1", "lafs0", "lafs1"}
    torch.testing.assert_close(given["x1"], points[1].float())
    frames = keypoints_to_lafs(keypoints0)
    scale = frames[0, :, :2].det().sqrt() / given["lafs0"][0, :, :2].det().sqrt()
    torch.testing.assert_close(given["lafs0"][..., :2] * scale, frames[..., :2], atol=1e-4, rtol=1e-4)
    knn = [(match, cv2.DMatch(i, 0, 100.0)) for i, match in enumerate(best)] + [()]
    torch.testing.assert_close(fmtorch.from_opencv(keypoints0, keypoints1, knn)["ratio"][3], torch.tensor(0.33))
    assert fmtorch.find_fundamental(**given).inliers.shape == (1, n)
    assert fmtorch.from_opencv([], [], [])["x0"].shape == (0, 2)


def test_keypoints_without_orientation_have_no_frames(points: tuple[Tensor, Tensor]) -> None:
    ends = [[cv2.KeyPoint(float(a), float(b), 7.0) for a, b in x.tolist()] for x in points]
    given = fmtorch.from_opencv(*ends, [cv2.DMatch(i, i, 1.0) for i in range(len(ends[0]))])
    assert given.keys() == {"x0", "x1"}


@pytest.mark.parametrize("count", [None, 1, 2])
@pytest.mark.parametrize("listed", [False, True])
def test_dictionaries_of_lightglue(points: tuple[Tensor, Tensor], count: int | None, listed: bool) -> None:
    n = len(points[0])
    order = torch.randperm(n, generator=torch.Generator().manual_seed(0))
    partners = torch.argsort(order)
    partners[5] = -1
    kept = (partners > -1).nonzero()[:, 0]
    score = torch.linspace(0.1, 0.9, n)
    size = torch.tensor([960, 640])

    def batched(value: Tensor) -> Tensor:
        return value if count is None else value.expand(count, *value.shape)

    features0 = {"keypoints": batched(points[0]), "image_size": batched(size)}
    features1 = {"keypoints": batched(points[1][order]), "image_size": batched(size)}
    if listed:
        listed_values = {"matches": torch.stack([kept, partners[kept]], -1), "scores": score[kept]}
        matches = {name: value if count is None else [value] * count for name, value in listed_values.items()}
    else:
        matches = {"matches0": batched(partners), "matching_scores0": batched(score)}
    given = fmtorch.from_lightglue(features0, features1, matches)
    x0, x1 = (given[name][0] if count == 2 else given[name] for name in ("x0", "x1"))
    assert torch.equal(x0, points[0][kept])
    assert torch.equal(x1, points[1][kept])
    estimate = fmtorch.find_fundamental(**given)
    assert len(estimate) == (count or 1)
    assert bool(estimate.ok.all())
    assert given["size0"].reshape(-1).tolist()[:2] == [640, 960]


def test_dictionaries_of_kornia(points: tuple[Tensor, Tensor]) -> None:
    n = len(points[0])
    one = {"keypoints0": points[0], "keypoints1": points[1], "confidence": torch.full((n,), 0.7)}
    two = {name: torch.cat([value, value]) for name, value in one.items()}
    two["batch_indexes"] = torch.arange(2).repeat_interleave(n)
    first = fmtorch.find_fundamental(**fmtorch.from_kornia(one))
    both = fmtorch.find_fundamental(**fmtorch.from_kornia(two))
    assert torch.equal(both.F[1], first.F[0])


@pytest.mark.parametrize(("function", "values", "right"), [
    (fmtorch.from_opencv, ([cv2.KeyPoint()], [cv2.KeyPoint()], [cv2.DMatch(0, 9, 1.0)]), "matches of cv2.DMatch"),
    (fmtorch.from_lightglue, ({}, {}, {}), "features0 and features1 with keypoints"),
    (fmtorch.from_kornia, ({},), "with keypoints0"), (fmtorch.from_poselib, (None, 5), r"a poselib\."),
])  # fmt: skip
def test_what_another_library_does_not_make_is_refused(function: Any, values: tuple[Any, ...], right: str) -> None:
    with pytest.raises((TypeError, ValueError), match=rf"^what is given does not fit \(.*it must be .*{right}"):
        function(*values)


def test_a_geometry_of_colmap_and_back(points: tuple[Tensor, Tensor], pose: fmtorch.PoseEstimate) -> None:
    geometry = fmtorch.to_colmap(pose)
    assert geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    shifted = sampson(torch.tensor(geometry.F)[None], points[0] + 0.5, points[1] + 0.5)
    torch.testing.assert_close(shifted, sampson(pose.F, *points), atol=1e-4, rtol=1e-4)
    again = fmtorch.from_colmap(geometry, len(points[0]))
    torch.testing.assert_close(sampson(again.F, *points), sampson(pose.F, *points), atol=1e-4, rtol=1e-4)
    assert torch.equal(again.inliers, pose.inliers)
    torch.testing.assert_close(again.R, pose.R.double())
    torch.testing.assert_close(again.t, pose.t.double())


def test_a_homography_of_colmap_and_back(points: tuple[Tensor, Tensor]) -> None:
    H = torch.tensor([[0.9, 0.1, 20], [-0.1, 0.9, 5], [1e-5, 0, 1]], dtype=torch.float64)
    x0 = points[0].double()
    x1 = torch.cat([x0, torch.ones(len(x0), 1)], 1) @ H.T
    geometry = fmtorch.to_colmap(fmtorch.find_homography(x0, x1[:, :2] / x1[:, 2:]))
    assert geometry.F is None
    again = fmtorch.from_colmap(geometry, len(x0))
    torch.testing.assert_close(again.H / again.H[..., 2:, 2:], H[None], atol=1e-6, rtol=1e-6)


def test_what_is_no_geometry_is_degenerate_and_says_why(points: tuple[Tensor, Tensor]) -> None:
    geometry = fmtorch.to_colmap(fmtorch.find_fundamental(points[0][:5], points[1][:5]))
    assert geometry.config == pycolmap.TwoViewGeometryConfiguration.DEGENERATE
    again = fmtorch.from_colmap(geometry, 5)
    assert not bool(again.ok[0])
    assert again.reason == ("COLMAP calls it degenerate",)
    with pytest.raises(ValueError, match="to_colmap takes one pair, not 2"):
        fmtorch.to_colmap(fmtorch.find_fundamental([points[0]] * 2, [points[1]] * 2))


def test_a_pose_of_poselib_and_back(points: tuple[Tensor, Tensor], pose: fmtorch.PoseEstimate) -> None:
    pytest.importorskip("poselib")
    given = fmtorch.to_poselib(pose)
    np.testing.assert_allclose(given.R, pose.R[0].numpy(), atol=1e-12)
    again = fmtorch.from_poselib(given, pose.inliers[0].tolist(), CALIBRATION, CALIBRATION)
    torch.testing.assert_close(again.R, pose.R.double())
    exact = sampson(pose.F.double(), *points)[pose.inliers]
    torch.testing.assert_close(sampson(again.F, *points)[pose.inliers], exact, atol=1e-3, rtol=1e-3)
    with pytest.raises(ValueError, match="the estimate has no pose"):
        fmtorch.to_poselib(fmtorch.find_fundamental(*points))


def test_a_real_scene_is_reconstructed(tmp_path: Path) -> None:
    """Five images of fountain-P11: photographs -> matches and F -> COLMAP's cameras, against the laser scan's."""
    source = shared_path("data/Strecha/fountain-P11")
    images = tmp_path / "images"
    images.mkdir()
    for path in sorted((source / "Images").iterdir())[2:7]:
        (images / path.name).symlink_to(path)
    options = ["features.max_features=2500", "estimator=lmeds", "estimator.hypotheses=300"]
    pipeline = load_pipeline("sift_ratio", overrides=options)
    kept = io.MatchStore(tmp_path / "export", images)
    pairs = chosen_pairs(images, images_below(images), None)
    work = FolderMatches(pipeline, kept, folder_workers(pipeline), 1600, True, 0)
    assert len(list(work.each(pairs))) == len(pairs)
    assert not work.troubles
    io.write_exports(kept, pairs, ("colmap",), tmp_path, shared_camera=True)
    model = mapped(tmp_path / io.DATABASE, tmp_path)
    cameras = np.loadtxt(source / "Camera.txt")
    names = [f"{i:08d}.jpg" for i in range(len(cameras))]
    R, t = cameras[:, 9:18].reshape(-1, 3, 3), cameras[:, 18:]
    turn, shift = errors(model, names, list(R), np.einsum("nji,nj->ni", -R, t))
    assert model.num_reg_images() == 5
    (camera,) = model.cameras.values()
    assert camera.focal_length == pytest.approx((cameras[0, 0] + cameras[0, 4]) / 2, rel=0.02)
    assert shift < 0.01
    assert turn < 1.5  # the principal point, which stays in the middle, is off by 10 px of 1380
