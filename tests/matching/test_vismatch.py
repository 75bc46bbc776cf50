"""Matchers of the package vismatch behind the project's conventions, with a stand-in of its interface."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fmtorch.data import read_image
from fmtorch.matching import VisMatch
from fmtorch.matching.vismatch import MAX_RATIO, relative_noise
from fmtorch.pipeline import Pipeline, load_pipeline
from tests.data import lists
from tests.helpers import draw, pair
from tests.matching import stand_in


@pytest.fixture(autouse=True)
def _vismatch(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in.install(tmp_path_factory.mktemp("site"), monkeypatch)


def pictures(folder: Path) -> list[np.ndarray]:
    return [read_image(draw(folder / f"{i}.png", 0, shift=12 * i)) for i in (0, 1)]


def test_points_and_confidences_are_the_matchers(tmp_path: Path) -> None:
    a, b = pictures(tmp_path)
    c = VisMatch("sift-nn", max_features=500).match_images(a, b)
    (k0, _), (k1, _) = (cv2.SIFT_create(500).detectAndCompute(i, None) for i in (a, b))
    keypoints = {k.pt for k in k0}, {k.pt for k in k1}
    assert int(c.count()) > 50
    for x, known in zip((c.x0, c.x1), keypoints, strict=True):
        assert {tuple(point) for point in x[0].tolist()} <= {tuple(np.float32(p).tolist()) for p in known}
    assert ((c.x0 - c.x1)[0, :, 0] - 12).abs().median() < 0.5
    assert ((c.score > 0.25) & (c.score <= 1)).all()  # the ratio that the stand-in calls 1 - confidence
    assert c.size0.tolist() == [[240, 320]]
    assert c.noise is None


def test_points_outside_of_an_image_do_not_count(tmp_path: Path) -> None:
    """The first pixel's centre is at 0: all within half a pixel of the first and the last centre are inside."""
    a, b = pictures(tmp_path)
    matcher = VisMatch("sift-nn")
    points = np.array([[-0.5, 0], [-0.6, 0], [319.5, 239.5], [319.6, 0], [np.nan, 1], [5, 5]])
    matcher._matcher = lambda *_: {"matched_kpts0": points, "matched_kpts1": np.ones_like(points)}
    c = matcher.match_images(a, b)
    assert c.mask[0].tolist() == [True, False, True, False, False, True]
    assert torch.isfinite(c.x0).all()


def test_noise_of_roma_is_the_mean_variance_of_its_precisions(tmp_path: Path) -> None:
    """Every second match has four times the precision, hence half the deviation; the first has none."""
    a, b = pictures(tmp_path)
    plain, roma = VisMatch("sift-nn").match_images(a, b), VisMatch("romav2").match_images(a, b)
    torch.testing.assert_close(roma.x0, plain.x0, atol=1e-3, rtol=0)  # RoMa's first centre is at 0.5
    noise = roma.noise[0].double().numpy()
    np.testing.assert_allclose(noise[3::2] / noise[2], 2, rtol=1e-6)
    np.testing.assert_allclose(np.median(noise), 1, rtol=1e-6)
    assert noise[0] == pytest.approx(1)


def test_relative_noise_is_that_of_drawn_errors() -> None:
    """The deviation across lines of random directions, of errors drawn with the covariances (Monte Carlo, 40,000)."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(6, 2, 2)) + 2 * np.eye(2)
    covariances = roots @ roots.transpose(0, 2, 1)
    n = rng.normal(size=(40_000, 2))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    drawn = np.array([(((rng.normal(size=(40_000, 2)) @ root.T) * n).sum(1)).std() for root in roots])
    noise = relative_noise(np.linalg.inv(covariances), np.linalg.inv(covariances))
    np.testing.assert_allclose(noise, drawn / np.median(drawn), rtol=0.03)  # four standard errors, 1 / sqrt(2 n) each


def test_a_pair_does_not_depend_on_those_before_it(tmp_path: Path) -> None:
    a, b = pictures(tmp_path)
    matcher = VisMatch("random")
    first, state = matcher.match_images(a, b), torch.get_rng_state()
    assert torch.equal(matcher.match_images(a, b).x0, first.x0)
    assert torch.equal(torch.get_rng_state(), state)


def pipeline(name: str) -> Pipeline:
    return load_pipeline("vismatch", overrides=[f"matcher.name={name}"])


def test_in_a_pipeline_failures_are_reasons(tmp_path: Path) -> None:
    a, b = draw(tmp_path / "a.png", 0), draw(tmp_path / "b.png", 0, shift=12)
    good, absent = pair("good", a, b), pair("absent", a, draw(tmp_path / "c.png", 1))
    absent.image1.path.unlink()
    outcomes = pipeline("sift-nn").run([good, absent])
    assert outcomes[0].solved
    assert outcomes[0].features[0] == outcomes[0].features[1] > 50
    assert set(outcomes[0].seconds) == {"matching", "pruning", "estimation"}
    assert outcomes[1].reason.startswith("images: ImageError: ")
    for name, reason in (("broken", "RuntimeError: out of memory"), ("uneven", "ValueError: ")):
        (outcome,) = pipeline(name).run([good])
        assert outcome.reason.startswith(f"matching: ValueError: vismatch {name}: {reason}")
    (silent,) = pipeline("silent").run([good])
    assert not silent.solved
    assert "0 matches" in silent.reason


def test_what_cannot_be_loaded_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"matcher\.name=sift_nn: vismatch has no such matcher; there are: .*sift-nn"):
        VisMatch("sift_nn")
    with pytest.raises(ValueError, match=r"no-download: vismatch cannot load it \(OSError: no connection\)$"):
        VisMatch("no-download")
    monkeypatch.setitem(sys.modules, "vismatch", None)
    with pytest.raises(ImportError, match=r"needs vismatch: pip install 'fmtorch\[vismatch\]'"):
        VisMatch("sift-nn")


def test_the_command_evaluates_it(command: Callable[..., str], tmp_path: Path) -> None:
    file = lists.write(tmp_path / "list.txt", [lists.superglue(1, 5), lists.superglue(0, 2)])
    words = (
        "eval", "pipeline=vismatch", "matcher.name=romav2", "dataset=pair_list", f"dataset.root={lists.images()}",
        f"dataset.file={file}", "dataset.resize=640", f"output={tmp_path / 'run'}", "cache=off",
    )  # fmt: skip
    command(*words, cwd=tmp_path)
    folder = tmp_path / "run"
    config = json.loads((folder / "run.json").read_text())["config"]
    assert config["libraries"]["vismatch"] == "9.9"
    summary = json.loads((folder / "summary.json").read_text())["all"]
    assert (summary["pairs"], summary["failures"], summary["pose"]["pairs"]) == (2, 0, 2)
    assert summary["seconds"]["features"] is None


def test_noise_is_bounded_and_one_where_nothing_is_known() -> None:
    precision = np.stack([np.eye(2) * s for s in (1.0, 1.0, 1.0, 1e-9, 1e9)])
    assert relative_noise(precision, precision).tolist() == [1, 1, 1, MAX_RATIO, 1 / MAX_RATIO]
    bad = np.stack([np.full((2, 2), np.nan), -np.eye(2), np.zeros((2, 2))])
    assert relative_noise(bad, bad).tolist() == [1, 1, 1]
    assert relative_noise(np.zeros((0, 2, 2)), np.zeros((0, 2, 2))).shape == (0,)
