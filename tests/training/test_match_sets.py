"""The geometry of tracks: viewing angles, similarity of patches and of photographs, and what is drawn from them."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch

from fmtorch.features.networks import GeoDesc, read_checkpoint
from fmtorch.scenes.generate import Plan, Task
from fmtorch.scenes.textures import photograph
from fmtorch.training.correspondences import Tolerance
from fmtorch.training.geodesc_loss import geodesc
from fmtorch.training.match_set_training import MatchSetTraining
from fmtorch.training.match_sets import Tracks, match_sets
from fmtorch.training.model_card import model_card
from fmtorch.training.patch_loop import TrainingOptions
from fmtorch.training.patch_metrics import validation_pairs
from fmtorch.training.planes import PlaneViews
from fmtorch.training.scenes import View
from fmtorch.training.track_geometry import patch_similarity, rays_and_incidence
from fmtorch.training.track_store import TrackStore, build_track_store, tracks_of_views, views_of_plane
from tests.reference import geodesc as reference
from tests.training.test_scene_patches import SCREEN, SIZE, WALL, view

PLANES = PlaneViews(views=4, tilt=15.0, scale=(0.5, 0.6))


def world_points(v: View) -> np.ndarray:
    """Where the keypoints of `view` lie: on the screen y = SCREEN, x < 0, or on the wall y = WALL."""
    rays = np.c_[v.keypoints[:, :2], np.ones(len(v.keypoints))] @ np.linalg.inv(v.camera.K).T @ v.camera.R
    screen, wall = (v.camera.centre + (y - v.camera.centre[1]) / rays[:, 1:2] * rays for y in (SCREEN, WALL))
    return np.where(screen[:, :1] < 0, screen, wall)


def test_angles_and_similarity_are_their_definitions() -> None:
    a, b = view(0.0), view(1.2, -0.25)
    points = world_points(a)
    pixels, _ = b.camera.project(points)
    b = View(b.image, b.camera, b.inverse_depth, np.c_[pixels, a.keypoints[:, 2:]])
    found = [rays_and_incidence(v.keypoints, v) for v in (a, b)]
    seen = np.isfinite(found[0][1]) & np.isfinite(found[1][1]) & (np.abs(world_points(b) - points) < 1e-6).all(1)
    assert seen.sum() > 300
    similarity = patch_similarity(found[0][0], found[1][0], found[0][1], found[1][1])
    normal = (0.0, -1.0, 0.0)  # of both surfaces, towards the cameras
    for i in np.flatnonzero(seen)[::7]:
        point = points[i].tolist()
        for v, (rays, incidence) in zip((a, b), found, strict=True):
            towards = v.camera.centre - points[i]
            np.testing.assert_allclose(rays[i], towards / np.linalg.norm(towards), atol=1e-9)
            assert incidence[i] == pytest.approx(reference.angle(towards.tolist(), normal), abs=1e-6)
        centres = a.camera.centre.tolist(), b.camera.centre.tolist()
        assert similarity[i] == pytest.approx(reference.patch_similarity(point, normal, *centres), abs=1e-6)
    assert similarity[seen].max() - similarity[seen].min() > 0.1
    np.testing.assert_allclose(patch_similarity(found[0][0], found[0][0], found[0][1], found[0][1])[seen], 1.0)


def test_the_angle_on_an_edge_of_depth_is_unknown() -> None:
    v = view(0.0)
    _, incidence = rays_and_incidence(v.keypoints, v)
    on_edge = np.abs(v.keypoints[:, 0] - (SIZE[1] - 1) / 2) < 1.5
    assert np.isnan(incidence[on_edge]).all()
    assert np.isfinite(incidence[~on_edge]).mean() > 0.9


def random_tracks(seed: int) -> tuple[Tracks, dict[tuple[int, int], float]]:
    """Points in up to five views, and S_patch of every two patches of a point."""
    rng = np.random.default_rng(seed)
    first, views, names = [0], [], []
    for point in range(60):
        shown = rng.permutation(5)[: rng.integers(2, 6)]
        views += shown.tolist()
        names += [1000 * int(v) + point for v in shown]
        first.append(len(views))
    rays = rng.normal(size=(len(views), 3)) * 0.2 + [0, 0, 1]
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    incidence = rng.uniform(0, 40, len(views)).astype(np.float32)
    incidence[rng.random(len(views)) < 0.1] = np.nan
    similarity = {}
    for begin, end in itertools.pairwise(first):
        for i in range(begin, end):
            for j in range(i + 1, end):
                if np.isfinite(incidence[[i, j]]).all():
                    value = patch_similarity(rays[[i]], rays[[j]], incidence[[i]], incidence[[j]])[0]
                    similarity[names[i], names[j]] = float(value)
    return Tracks(np.array(first), np.array(views), rays, incidence), similarity


@pytest.mark.parametrize("seed", range(3))
def test_match_sets_are_their_definition(seed: int) -> None:
    tracks, similarity = random_tracks(seed)
    names = 1000 * tracks.view + np.repeat(np.arange(60), np.diff(tracks.first))
    everything = match_sets(tracks, 2, 1.0)
    assert len(everything) == 10
    limit = float(np.median(everything.image_similarity))
    sets, expected = match_sets(tracks, 15, limit), reference.match_sets(similarity, 15, limit)
    assert 0 < len(sets) < len(everything)
    assert len(sets) == len(expected)
    for i, (a, b) in enumerate(zip(sets.first[:-1], sets.first[1:], strict=True)):
        patches = names[sets.patches[:, a:b]]
        members, image = expected[patches[0, 0] // 1000, patches[1, 0] // 1000]
        assert sorted(zip(*patches.tolist(), strict=True)) == members
        assert sets.image_similarity[i] == pytest.approx(image)
        assert sets.similarity[a:b].mean() == pytest.approx(image)


def test_draws_are_different_matches_of_their_sets() -> None:
    sets = match_sets(random_tracks(0)[0], 15, 1.0)
    chosen, numbers = [3, 0], torch.rand(2, 12, generator=torch.Generator().manual_seed(0))
    patches, similarity = sets.draw(chosen, 12, numbers)
    assert patches.shape == (2, 2, 12)
    for row, i in enumerate(chosen):
        members = sets.patches[:, sets.first[i] : sets.first[i + 1]].T.tolist()
        drawn = patches[:, row].T.tolist()
        assert all(pair in members for pair in drawn)
        assert len({tuple(pair) for pair in drawn}) == 12
        values = sets.similarity[sets.first[i] : sets.first[i + 1]]
        assert similarity[row].tolist() == [values[members.index(pair)] for pair in drawn]


def test_no_pair_of_photographs_left() -> None:
    tracks, _ = random_tracks(0)
    with pytest.raises(ValueError, match=r"shares 500 points .* at most 0\.85: lower match_sets\.matches"):
        match_sets(tracks, 500)


@pytest.fixture(scope="module")
def store() -> TrackStore:
    views = views_of_plane(photograph("chelsea.png"), np.random.default_rng(0), planes=PLANES, points=150)
    patches, point, columns = tracks_of_views(views, Tolerance())
    first = np.r_[0, np.cumsum(np.bincount(point))]
    tracks = Tracks(first, columns["view"], columns["rays"], columns["incidence"])
    return TrackStore(patches, first, {"photographs": {"scikit-image": 1}, "points": len(first) - 1,
                                      "patches": len(patches), "views": 4, "limits": {}}, tracks)  # fmt: skip


def test_tracks_of_a_plane_show_the_same_point_under_its_angles(store: TrackStore) -> None:
    pairs = validation_pairs(store, 40)
    a, b = (x.flatten(1) for x in pairs)
    same = torch.stack([torch.corrcoef(torch.stack([x, y]))[0, 1] for x, y in zip(a, b, strict=True)])
    other = torch.stack([torch.corrcoef(torch.stack([x, y]))[0, 1] for x, y in zip(a, b.roll(1, 0), strict=True)])
    assert float(same.median()) > 0.6
    assert float(other.median()) < 0.3
    # The plane is z = 0, seen from z < 0: its normal is (0, 0, -1).
    angles = np.degrees(np.arccos(-store.tracks.rays[:, 2]))
    np.testing.assert_allclose(store.tracks.incidence, angles, atol=0.02)  # float32 rays: eps / sin


def training(store: TrackStore, batch: int = 32) -> MatchSetTraining:
    torch.manual_seed(0)
    options = TrainingOptions(batch=batch, steps=20, learning_rate=3e-4, bf16=False, checkpoint_steps=1000)
    description = {"architecture": "geodesc", "loss": {"name": "geodesc"}, "match_sets": {"matches": 16}}
    return MatchSetTraining(GeoDesc(), geodesc, store, options, description, matches=16, max_similarity=1.0)


def test_training_on_match_sets_lowers_the_loss_and_resumes(store: TrackStore, tmp_path: Path) -> None:
    whole = training(store)
    before = whole.objective.evaluate(whole.network.eval(), validation_pairs(store, 100))
    whole.run()
    assert sum(whole.losses[-4:]) < 0.7 * sum(whole.losses[:4])
    assert whole.objective.evaluate(whole.network.eval(), validation_pairs(store, 100))["map"] > before["map"]
    whole.save(tmp_path / "whole.pt")
    card = model_card(tmp_path / "whole.pt", "geodesc", "fp32", read_checkpoint(tmp_path / "whole.pt"))
    assert "| match sets | matches 16 |" in card
    assert "the authors' weights are not" in card
    first = training(store)
    first.run(until=3, checkpoint=tmp_path / "run.pt")
    second = training(store)
    second.resume(tmp_path / "run.pt")
    second.run(until=6)
    assert second.losses == whole.losses[:6]
    second.description["match_sets"] = {"matches": 8}
    with pytest.raises(ValueError, match=r"was trained with match_sets \{'matches': 16\}, not \{'matches': 8\}"):
        second.resume(tmp_path / "run.pt")


def test_batches_that_do_not_fit_are_refused(store: TrackStore) -> None:
    with pytest.raises(ValueError, match=r"batch=40 must be a multiple of match_sets\.matches=16"):
        training(store, batch=40)
    with pytest.raises(ValueError, match="batch=3200 is more than 16 matches of the"):
        training(store, batch=3200)


def test_a_store_of_tracks_is_the_same_again(tmp_path: Path) -> None:
    task = Task("indoor", "train", 0, 3, Plan(1, 3, 0, scale=0.4))
    options = {"seed": 0, "points": 100, "planes": PLANES, "tolerance": Tolerance(), "scenes": [task]}
    one, two = (build_track_store(tmp_path / name, [], **options) for name in ("a", "b"))  # type: ignore[arg-type]
    assert len(one) > 20
    assert one.description["scenes"] == {"indoor": 1}
    np.testing.assert_array_equal(one.patches, two.patches)
    for a, b in zip(one.tracks, two.tracks, strict=True):
        np.testing.assert_array_equal(a, b)
    assert len(one.tracks.view) == len(one.patches) == one.first[-1]
    with pytest.raises(FileExistsError, match="delete it to cut the patches again"):
        build_track_store(tmp_path / "a", [], **options)  # type: ignore[arg-type]
    (tmp_path / "a" / "rays.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"without geometry \(rays.npy is absent\)"):
        TrackStore.open(tmp_path / "a")
