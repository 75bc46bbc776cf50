"""The benchmark of cameras: what each level tells, peers, judgement, the table and the command."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fmtorch.core import Correspondences, Estimate
from scripts.benchmark import cameras
from scripts.benchmark.cameras import LEVELS, TAKES, CameraMethod, applies, bougnoux, calibrations, told
from scripts.benchmark.methods import read_specs
from scripts.benchmark.runner import Item, Row
from tests.helpers import cross_matrix
from tests.scripts.samples import item as plain_item
from tests.scripts.samples import pair

SIZES = np.array([[760, 1000], [760, 1000]])
K = np.array([[950.0, 0, 499.5], [0, 950, 379.5], [0, 0, 1]])
R = cv2.Rodrigues(np.array([0.05, 0.3, 0.02]))[0]
T = np.array([-1.0, 0.1, 0.3])
ROTATION = {"known": 1, "rough": 3, "wrong": 180, "one_sided": 3, "shared": 3, "unknown": 3}  # degrees, at most


def item(K0: np.ndarray = K, name: str = "orbit/s/0") -> Item:
    """A pair of cameras with 200 right matches, of 0.1 px of noise, and 50 wrong ones of larger ratio."""
    rng = np.random.default_rng(0)
    X = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (250, 3))
    x0, x1 = (Y[:, :2] / Y[:, 2:] + rng.normal(0, 0.1, (250, 2)) for Y in (X @ K0.T, (X @ R.T + T) @ K.T))
    x1[200:] = rng.uniform(0, 760, (50, 2))
    of = pair(name, true_f(K0, K, R, T), K0=K0, K1=K, R=R, t=T)
    ratio = torch.linspace(0.3, 0.8, 250)[None]
    sizes, frame = torch.from_numpy(SIZES), torch.diag(torch.tensor([4.0, 4])).expand(1, 250, 2, 2)
    points = [torch.from_numpy(x)[None].float() for x in (x0, x1)]
    lafs0, lafs1 = (torch.cat([frame, x[..., None]], -1) for x in points)
    matches = Correspondences(
        *points, torch.ones(1, 250, dtype=torch.bool), ratio=ratio, lafs0=lafs0, lafs1=lafs1, size0=sizes[:1],
        size1=sizes[1:], key=torch.tensor([of.key]),
    )  # fmt: skip
    return plain_item(of, matches)


def true_f(K0: np.ndarray, K1: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.linalg.inv(K1).T @ cross_matrix(t) @ R @ np.linalg.inv(K0)


def zoomed(factor: float) -> np.ndarray:
    return K @ np.diag([factor, factor, 1])


def test_levels_tell_what_they_say() -> None:
    own = item()
    known, wrong, one_sided, shared, unknown = (
        told(level, own.pair, own.matches, 0) for level in ("known", "wrong", "one_sided", "shared", "unknown")
    )
    assert known.focal is not None
    assert known.K0 is not None
    assert wrong.K1 is not None
    assert known.focal[0, :, 1].tolist() == [0, 0]
    assert np.array_equal(known.K0[0], K)
    assert np.allclose(wrong.K1[0], zoomed(1.5))
    given = [k is not None for c in (one_sided, shared, unknown) for k in (c.K0, c.K1)]
    assert given == [True, False, False, False, False, False]
    assert [bool(c.shared_focal) for c in (shared, unknown)] == [True, False]
    assert np.array_equal(calibrations(unknown, np.array([3.0, 4]))[1], [[4, 0, 499.5], [0, 4, 379.5], [0, 0, 1]])
    assert applies("shared", own.pair)
    assert not applies("shared", item(zoomed(1.01)).pair)
    assert applies("unknown", item(zoomed(1.01)).pair)


def test_bougnoux_gives_the_focal_lengths_of_a_true_matrix() -> None:
    own = item(zoomed(1.3))
    unknown = told("unknown", own.pair, own.matches, 0)
    assert bougnoux(own.pair.F, unknown) == pytest.approx([1.3 * 950, 950], rel=1e-8)
    forward = true_f(K, K, np.eye(3), np.array([0, 0, 1.0]))  # axes that are one line determine none
    assert bougnoux(forward, unknown) == pytest.approx([1200, 1200])


@pytest.mark.parametrize(("name", "level"), [(name, level) for name, levels in TAKES.items() for level in levels])
def test_every_method_solves_an_easy_pair_at_each_level_that_it_takes(name: str, level: str) -> None:
    kind = name.partition("_")[0]
    pytest.importorskip({"poselib": "poselib", "colmap": "pycolmap"}.get(kind, "cv2"))
    ours = kind == "fmtorch"
    found = CameraMethod.of(f"{name}:{level}" + ("" if ours else ":threshold=1")).figures(item(), 0)
    assert found["ok"]
    assert found["flipped"] is False
    assert ("focal_10" in found) == (level != "known")
    if ours or level not in ("rough", "wrong"):  # which peers take for exact
        assert found["rotation_error"] < ROTATION[level]
        assert found["nsgd"] < 0.01
        assert found.get("focal_10", 1.0) == 1.0 or level == "wrong"  # the usual focal length is off by a quarter


@pytest.mark.parametrize(("text", "message"), [
    ("poselib", "write NAME:LEVEL"), ("poselib:some", "with a level of known, rough"),
    ("opencv:shared", "opencv has no estimator for 'shared'"), ("peer:known", "no method 'peer'; there are fmtorch"),
])  # fmt: skip
def test_a_method_that_there_is_not_is_refused(text: str, message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        CameraMethod.of(text)


def test_the_methods_of_the_page_are_methods() -> None:
    texts = read_specs(Path(cameras.__file__).with_name("cameras.txt"))
    assert len(set(texts)) == len(texts)
    assert {CameraMethod.of(text).level for text in texts} == set(LEVELS)


def judged(level: str, R: np.ndarray | None, t: np.ndarray = T, focals: tuple[float, float] | None = None) -> Row:
    """What is said of an answer."""
    given = item()
    posed = {} if R is None else {"R": torch.from_numpy(R)[None], "t": torch.from_numpy(t)[None]}
    posed |= {} if focals is None else {"focals": torch.tensor([focals], dtype=torch.float64)}
    ok, mask = torch.tensor([R is not None]), given.matches.mask
    F = torch.from_numpy(given.pair.F / np.linalg.norm(given.pair.F))[None] * ok
    answer = Estimate(
        F, mask & ok, ok, ("" if R is not None else "nothing",), torch.zeros(1, dtype=torch.int64), **posed
    )
    return CameraMethod("x", level, lambda c, seed: answer, "").figures(given, 0)


def test_judgement_of_a_true_a_flipped_and_no_pose() -> None:
    true = judged("unknown", R, T / np.linalg.norm(T), (950.0, 1000.0))
    assert [true[key] for key in ("rotation_error", "translation_error", "nsgd")] == pytest.approx([0, 0, 0], abs=1e-5)
    assert (true["focal_5"], true["focal_10"], true["flipped"]) == (0.5, 1.0, False)
    flipped = judged("known", R, -T / np.linalg.norm(T))
    assert flipped["flipped"] is True
    assert flipped["translation_error"] == pytest.approx(0, abs=1e-5)
    nothing = judged("shared", None)
    assert (nothing["rotation_error"], nothing["translation_error"], nothing["nsgd"]) == (180, 90, 1)
    assert nothing["focal_10"] == 0
    assert "flipped" not in nothing
