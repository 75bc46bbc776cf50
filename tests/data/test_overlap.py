"""Overlap by depth and by points, against slow counting; pairs selected by it."""

import functools
import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from fmtorch.data import ImageSource, load
from fmtorch.data.construction import STEP, TOLERANCE, DepthOverlap, Seen, overlap_of, seen_share, shared_points
from fmtorch.data.scenes import DepthScenePairs, incidence
from fmtorch.scenes import Plan, RenderedPairs
from tests.data.native import write_colmap, write_kitti
from tests.helpers import call_command
from tests.reference import labels as reference

PLAN = Plan(scenes=1, shots=4, pairs=4, scale=0.15)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> DepthScenePairs:
    """All pairs of four photographs each of two families; cameras of the collection have other sizes."""
    root = tmp_path_factory.mktemp("rendered")
    families = ["indoor", "collection"]
    return RenderedPairs(families=families, root=root, plan=PLAN, workers=1).scene_pairs()


def one_by_one(dataset: DepthScenePairs, scene: int, i: int, j: int) -> float:
    """The overlap of a pair by the reference."""
    a, b = (dataset.scenes[scene].views[k] for k in (i, j))

    def depth(image: ImageSource, x: float, y: float) -> float:
        return float(dataset.depth(image, np.array([[x, y]], np.float64))[0])

    shares = []
    for first, second in ((a, b), (b, a)):
        R = second.R @ first.R.T
        shares.append(
            reference.share(
                functools.partial(depth, first.image),
                functools.partial(depth, second.image),
                first.K,
                second.K,
                (first.image.size, second.image.size),
                R,
                second.t - R @ first.t,
                STEP,
                TOLERANCE,
            )
        )
    return min(shares)


def test_overlap_of_rendered_pairs_is_that_counted_pixel_by_pixel(rendered: DepthScenePairs) -> None:
    overlaps = overlap_of(rendered)
    assert isinstance(overlaps, DepthOverlap)
    places = [rendered.candidate(rank) for rank in range(rendered.candidates)]
    assert len(places) == 2 * 6
    shares = [overlaps.of(place) for place in places]
    assert shares == [one_by_one(rendered, *place) for place in places]
    assert min(shares) < 0.4 < 0.6 < max(shares)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (2.0, 0.5),  # the same wall, of which the other camera sees the right half
        (2.0 * (1 + 0.9 * TOLERANCE), 0.5),
        (2.0 / (1 - 1.1 * TOLERANCE), 0.0),  # another wall, behind
        (1.5, 0.0),  # hidden
        (np.nan, 0.0),  # what is within the other image is unknown, all else is outside
    ],
)
def test_a_wall_of_which_half_is_seen(other: float, expected: float) -> None:
    K = np.array([[40.0, 0.0, 19.5], [0.0, 40.0, 9.5], [0.0, 0.0, 1.0]])
    sees = [Seen(K, (20, 40), lambda x, z=z: np.full(len(x), z)) for z in (2.0, other)]  # type: ignore[misc]
    assert seen_share(*sees, np.eye(3), np.array([-1.0, 0.0, 0.0]), step=1) == expected
    assert seen_share(*sees, np.eye(3), np.array([0.0, 0.0, -5.0])) == 0  # all of it is behind the other camera


def test_overlap_by_points_is_that_counted_point_by_point() -> None:
    rng = np.random.default_rng(2)
    points = [rng.integers(0, 60, rng.integers(0, 40)) for _ in range(30)]
    points[3] = np.zeros(0, np.int64)
    pairs = np.array(list(itertools.combinations(range(30), 2)))
    expected = [reference.by_points(points[i].tolist(), points[j].tolist()) for i, j in pairs]
    np.testing.assert_allclose(shared_points(incidence(points), pairs), expected, rtol=0, atol=1e-15)
    assert len(shared_points(incidence(points), pairs[:0])) == 0


def run(folder: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    call_command(monkeypatch, folder, "pairs", "output=Made", "count=null", "workers=1", *words)


def test_the_command_selects_by_overlap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neighbours share four of five points, the first and the last image, which is number 1 by name, three of five."""
    write_colmap(tmp_path / "Set/a")
    words = ["dataset=colmap", "dataset.root=Set", "dataset.sequences=[a]"]
    run(tmp_path, monkeypatch, *words, "overlap=[0.7,0.9]")
    selected = load("fmbench", root=tmp_path / "Made")
    assert [pair.identity for pair in selected] == ["Made/a/0-2", "Made/a/1-2"]
    rule = json.loads((tmp_path / "Made/pairs.json").read_text())["rule"]
    assert rule == {"overlap": [0.7, 0.9], "by": "points"}
    with pytest.raises(SystemExit, match=r"holds pairs of other settings; .*: rule\.overlap: .*Name another folder"):
        run(tmp_path, monkeypatch, *words, "overlap=[0.6,0.9]")
    run(tmp_path, monkeypatch, *words, "overlap=[0.6,0.6]", "output=Other")
    assert [pair.identity for pair in load("fmbench", root=tmp_path / "Other")] == ["Other/a/0-1"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["overlap=[0.4,0.1]"], "overlap=[0.4, 0.1]; it must be a list, each a number from 0 to 1: least and greatest"),
        (["overlap=[0.1,1.5]"], "as [0.1,0.4], or null"),
        (["overlap=[0.1]"], "overlap=[0.1]; it must be"),
        (["overlap=0.3"], "overlap=0.3; it must be"),
        (["overlap=0.1..0.4"], "overlap=0.1..0.4; it must be"),
        (["overlap=[0.1,0.4]"], "overlap needs depth or the points of a reconstruction and dataset=kitti has neither"),
    ],
)
def test_what_is_no_overlap_is_refused_and_nothing_written(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_kitti(tmp_path / "kitti")
    with pytest.raises(SystemExit, match=r"^error: ") as end:
        run(tmp_path, monkeypatch, "dataset=kitti", "dataset.root=kitti", "dataset.sequences=['06']", *words)
    assert message in str(end.value.code)
    assert [path.name for path in tmp_path.iterdir()] == ["kitti"]


def test_a_damaged_image_loses_its_own_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(tmp_path / "Set/a")
    (tmp_path / "Set/a/images/00.png").write_text("no image")
    run(tmp_path, monkeypatch, "dataset=colmap", "dataset.root=Set", "dataset.sequences=[a]", "overlap=[0.1,1]")
    assert [pair.identity for pair in load("fmbench", root=tmp_path / "Made")] == ["Made/a/1-2"]
