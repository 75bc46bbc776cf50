"""Each layout of others, written from its description, read back; what is damaged is named and harms nothing else."""

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import data, presets
from fmtorch.data import DataError
from fmtorch.evaluation import evaluate
from fmtorch.evaluation.report import Options, find_dataset
from fmtorch.evaluation.statistics import summarize
from fmtorch.evaluation.tables import summary_markdown
from fmtorch.io import H5Pairs, oanet
from fmtorch.pipeline import Outcome, Pipeline, load_pipeline
from fmtorch.runs import to_table
from tests.geometry.scenes import scene
from tests.helpers import unused
from tests.io import writers

NEEDS_TRUTH = ("hloc", "glue_factory", "vismatch")


def load(layout: str, tmp_path: Path) -> H5Pairs:
    return reload(layout, writers.WRITERS[layout](tmp_path / layout))


def reload(layout: str, root: Path, **options: Any) -> H5Pairs:
    if layout in NEEDS_TRUTH:
        options["truth"] = root.parent / "Truth"
        if not options["truth"].exists():
            writers.truth(options["truth"])
    return data.load("h5", root=root, layout=layout, **options)  # type: ignore[return-value]


def pipeline(**pruners: Any) -> Pipeline:
    return Pipeline(unused, unused, pruners, presets.build("estimator", "lmeds", hypotheses=200))


@pytest.mark.parametrize(("layout", "swapped"), [*((layout, False) for layout in writers.WRITERS), ("hloc", True)])
def test_what_was_written_is_read(layout: str, swapped: bool, tmp_path: Path) -> None:
    """swapped: hloc's pairs in the other order."""
    root = writers.WRITERS[layout](tmp_path / layout, **({"swapped": True} if swapped else {}))
    dataset = reload(layout, root)
    assert len(dataset) == writers.PAIRS
    for pair, s in zip(dataset, writers.scenes(), strict=True):
        assert pair.problem is None
        sign = np.sign((pair.F * s.F.numpy()).sum())
        np.testing.assert_allclose(sign * pair.F, s.F.numpy(), atol=1e-9)
        for got, expected in ((pair.K0, s.K0), (pair.K1, s.K1), (pair.R, s.R), (pair.t, s.t)):
            np.testing.assert_allclose(got, expected.numpy(), atol=1e-12)
        c, counts = pickle.loads(pickle.dumps(pair.matches))()
        order, expected = (torch.argsort(x[:, 0]) if swapped else torch.arange(len(x)) for x in (c.x0[0], s.x0))
        tolerance = 1e-4 if layout != "oanet" else 1e-3  # float32 at 1000 px; from calibrated coordinates and back
        torch.testing.assert_close(c.x0[0][order], s.x0[expected].float(), rtol=0, atol=tolerance)
        torch.testing.assert_close(c.x1[0][order], s.x1[expected].float(), rtol=0, atol=tolerance)
        assert c.mask.all()
        assert counts[0] == len(s.x0) + (2 if layout in NEEDS_TRUTH else 0)
        if layout in ("ransac_tutorial", "oanet"):
            np.testing.assert_allclose(c.ratio[0], writers.ratios(len(s.x0)), rtol=1e-6)
        elif layout in NEEDS_TRUTH:
            assert torch.allclose(c.score, torch.tensor(0.75))
        else:
            assert c.ambiguity is None
        if layout == "ransac_tutorial" or layout == "oanet":  # no sizes: twice the principal point
            assert c.size0.tolist() == [[801, 1001]]
        else:
            assert c.size0.tolist() == [list(writers.SIZE)]
    assert (c.mutual is not None) == (layout == "oanet")


def test_the_origin_can_be_given(tmp_path: Path) -> None:
    root = writers.write_glue_factory(tmp_path / "glue_factory")
    usual, other = reload("glue_factory", root), reload("glue_factory", root, origin=0.0)
    torch.testing.assert_close(other[0].matches()[0].x0, usual[0].matches()[0].x0 + 0.5)
    assert usual.digest != other.digest


def test_the_test_split_of_the_tutorial_has_no_cameras(tmp_path: Path) -> None:
    root = writers.write_tutorial(tmp_path / "ransac_tutorial")
    for name in ("R", "T"):
        (root / "church" / f"{name}.h5").unlink()
    for name in ("matches", "Fgt", "K1_K2"):
        with h5py.File(root / "church" / f"{name}.h5", "a") as file:
            file.move("img_0a-img_0b-1", "img_0a-img_0b")  # now that nothing tells the names apart
    first, second, _ = reload("ransac_tutorial", root)
    np.testing.assert_allclose(first.F, writers.scenes()[0].F.numpy(), atol=1e-12)
    assert first.R is None
    assert "does not name two images" in str(second.problem)
    (root / "church" / "Fgt.h5").unlink()
    assert "no ground truth" in str(reload("ransac_tutorial", root)[0].problem)


def black(size: tuple[int, int]) -> bytes:
    return cv2.imencode(".png", np.zeros(size, np.uint8))[1].tobytes()


def edit(root: Path, name: str, key: str, change: Callable[[np.ndarray], Any] | None) -> None:
    with h5py.File(root / name, "a") as file:
        value = file[key][()]
        del file[key]
        if change is not None:
            file[key] = change(value)


HLOC, GLUE, POSE, OANET = "feats-sift_matches-NN.h5", "predictions.h5", "imc_church.h5", "yfcc-sift-2000-test.hdf5"
PAIR = "s1-Images-00000000.png/s1-Images-00000001.png"
FIRST = "s1/Images/00000000.png/keypoints"
VISMATCH = "s1-Images-00000000_s1-Images-00000001"
TUTORIAL = "img_1a-img_1b-1"
DAMAGE: list[tuple[str, str, str, Callable[[np.ndarray], Any] | None, str]] = [
    ("hloc", "feats-sift.h5", "s1/Images/00000001.png/keypoints", None, "no keypoints of image Truth/s1/00000001"),
    ("hloc", "feats-sift.h5", "s1/Images/00000001.png/keypoints", lambda v: v[:, 0], r"keypoints' has shape \(65,\)"),
    ("hloc", "feats-sift.h5", FIRST, lambda v: v[:, :1], r"keypoints' has shape \(67, 1\); it must be"),
    ("ransac_tutorial", "church/K1_K2.h5", TUTORIAL, lambda v: 0 * v, "K1_K2.h5: .*: a calibration matrix is singular"),
    ("hloc", "feats-sift.h5", f"{FIRST[:-9]}image_size", lambda v: 0 * v, "image_size' is 0 x 0; it must be the width"),
    ("hloc", HLOC, f"{PAIR}/matches0", None, "no matches0 of the pair s1/Images"),
    ("hloc", HLOC, f"{PAIR}/matches0", lambda v: v[:-3], r"matching_scores0' has shape \(67,\); it must be \(64\)"),
    ("hloc", "feats-sift.h5", FIRST, lambda v: v[:9], "67 entries, but the first image has 9"),
    ("hloc", HLOC, f"{PAIR}/matches0", lambda v: v + 40000 * (v > 5), "names keypoint 40064"),
    ("hloc", HLOC, f"{PAIR}/matches0", lambda v: (v + 40000 * (v > 5)).astype(np.int16), "overflow as 16-bit"),
    ("hloc", HLOC, f"{PAIR}/matches0", lambda v: v.astype(float), "it must hold whole numbers"),
    ("hloc", HLOC, f"{PAIR}/matching_scores0", lambda v: v[1:], r"matching_scores0' has shape \(66,\)"),
    ("glue_factory", GLUE, f"{PAIR}/keypoints1", None, f"{PAIR}/keypoints1' is missing"),
    ("glue_factory", GLUE, f"{PAIR}/matches0", None, "no prediction for the pair Truth/s1/0-1"),
    ("vismatch", "vismatch.h5", f"{VISMATCH}/matched_kpts1", lambda v: v[2:], "63 in matched"),
    ("ransac_tutorial", "church/matches.h5", TUTORIAL, lambda v: v[:, :3], r"\(65, 3\); it must be \(any, 4\)"),
    ("ransac_tutorial", "church/match_conf.h5", TUTORIAL, lambda v: v[:7], "has 7 entries, but matches.h5 has 65"),
    ("ransac_tutorial", "church/match_conf.h5", TUTORIAL, None, "match_conf.h5: 'img_1a-img_1b-1' is missing"),
    ("ransac_tutorial", "church/K1_K2.h5", TUTORIAL, lambda v: v[:, :1], "it must hold 18 numbers"),
    ("ransac_tutorial", "church/K1_K2.h5", TUTORIAL, lambda v: v * np.nan, "K1_K2.h5: .* not finite"),
    ("ransac_tutorial", "church/R.h5", "img_1a", None, "names no two images of R.h5 and T.h5"),
    ("ransac_tutorial", "church/T.h5", "img_1a", lambda v: v[:2], "T.h5: 'img_1a' has shape"),
    ("posebench", POSE, "pair1/x2", lambda v: v[:4], "has 65 points in x1 and 4 in x2"),
    ("posebench", POSE, "pair1/x2", None, "'pair1/x2' is missing"),
    ("posebench", POSE, "pair1/R", lambda v: 2 * v, "R is no rotation"),
    ("posebench", POSE, "pair1/t", lambda v: 0 * v, "did not move apart"),
    ("posebench", POSE, "pair1/camera2/model", lambda v: ["OPENCV_FISHEYE"], "is OPENCV_FISHEYE; it must be one of"),
    ("posebench", POSE, "pair1/camera1/params", lambda v: v[:3], "are no parameters of PINHOLE"),
    ("posebench", POSE, "pair1/camera1/params", lambda v: [*v, 0.1], "has distortion"),
    ("oanet", OANET, "xs/1", lambda v: v[0], r"'xs/1' has shape \(65, 4\)"),
    ("oanet", OANET, "ratios/1", lambda v: v[:9], "'ratios/1' has 9 entries, but 'xs/1' has 65"),
    ("oanet", OANET, "f2s/1", lambda v: v[0, :1], "'f2s/1' has shape"),
    ("oanet", OANET, "Rs/1", None, "'Rs/1' is missing"),
]  # fmt: skip


@pytest.mark.parametrize(("layout", "name", "key", "change", "said"), DAMAGE)
def test_a_damaged_entry_is_named_and_harms_no_other(layout, name, key, change, said, tmp_path):
    root = writers.WRITERS[layout](tmp_path / layout)
    edit(root, name, key, change)
    first, second, third = pipeline().correspondences(list(reload(layout, root)))
    assert second.correspondences is None
    assert second.reason
    with pytest.raises(AssertionError, match=said):
        raise AssertionError(second.reason)
    assert ".h5" in second.reason or ".hdf5" in second.reason or "no rotation" in said or "move apart" in said
    assert first.correspondences is not None
    assert third.correspondences is not None


@pytest.mark.parametrize("layout", writers.WRITERS)
def test_a_truncated_file_is_named(layout: str, tmp_path: Path) -> None:
    root = writers.WRITERS[layout](tmp_path / layout)
    for path in sorted(root.rglob("*.h*5")):
        path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match=r"\.h(df)?5: is not a valid HDF5 file"):
        reload(layout, root)


@pytest.mark.parametrize("missing", ["zero", "negative", "absent"])
def test_a_camera_without_a_size_has_that_of_its_image_or_of_principal_point_and_points(missing, tmp_path):
    root = writers.write_posebench(tmp_path / "posebench")
    change = {"zero": lambda v: 0 * v, "negative": lambda v: 0 * v - 1, "absent": None}[missing]
    for camera in ("camera1", "camera2"):
        edit(root, POSE, f"pair1/{camera}/width", change)
    edit(root, POSE, "pair1/x2", lambda v: np.where(np.arange(len(v))[:, None] == 0, [1200.25, 3], v))
    s = writers.scenes()[1]
    centre = [tuple(round(2 * float(v) + 1) for v in K[[1, 0], 2]) for K in (s.K0, s.K1)]
    known, unknown = reload("posebench", root)[0].matches()[0], reload("posebench", root)[1].matches()[0]
    assert tuple(known.size0[0].tolist()) == writers.SIZE
    farthest = [int(np.ceil(bound)) + 1 for bound in s.x0.max(0).values.tolist()[::-1]]
    assert unknown.size0[0].tolist() == [max(sides) for sides in zip(centre[0], farthest, strict=True)]
    assert unknown.size1[0, 1].item() == 1202  # the point farthest out lies in the image
    images = tmp_path / "images" / "imc_church" / "pair1"
    images.mkdir(parents=True)
    (images / "1").write_bytes(black((810, 1010)))
    beside = reload("posebench", root, images=tmp_path / "images")[1].matches()[0]
    assert tuple(beside.size0[0].tolist()) == (810, 1010)
    assert torch.equal(beside.size1, unknown.size1)
    (images / "1").write_bytes(black((81, 101)))
    reduced = reload("posebench", root, images=tmp_path / "images")[1]
    assert "101 x 81 px, but its camera's principal point" in reduced.problem


def test_names_must_tell_images_apart(tmp_path: Path) -> None:
    root = tmp_path / "hloc"
    root.mkdir()
    with h5py.File(root / "feats.h5", "w") as f, h5py.File(root / "matches.h5", "w") as m:
        for name in ("00000000.png", "00000001.png"):
            f[f"{name}/keypoints"] = np.zeros((3, 2))
        m["00000000.png/00000001.png/matches0"] = np.array([-1, 0, 1])
    with pytest.raises(DataError, match=r"'00000000\.png' could be image Truth/s0/00000000 or Truth/s1"):
        reload("hloc", root)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"layout": "colmap"}, "no layout 'colmap'; it must be one of hloc, "),
        ({"layout": "hloc"}, "holds no geometry: give dataset.truth"),
        ({"layout": "posebench", "truth": "x"}, "layout posebench takes no truth"),
        ({"layout": "hloc", "truth": "Truth", "features": "no.h5"}, "no such file; dataset.features must be"),
        ({"layout": "oanet"}, "'xs' is missing; it is no file of OANet's layout"),
        ({"layout": "ransac_tutorial"}, "neither matches.h5 nor a sub-folder"),
        ({"layout": "posebench", "root": "nowhere"}, "nowhere: no such file or folder"),
        ({"layout": "posebench", "root": None}, "h5 needs root"),
    ],
)  # fmt: skip
def test_mistakes_raise(options: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    writers.truth(tmp_path / "Truth")
    writers.write_hloc(tmp_path / "mine")
    with pytest.raises(DataError, match=said):
        data.load("h5", **{"root": "mine", **options})


@pytest.mark.parametrize("layout", ["ransac_tutorial", "oanet", "posebench"])
def test_the_name_of_the_folder_decides_nothing(layout: str, tmp_path: Path) -> None:
    roots = [writers.WRITERS[layout](tmp_path / name) for name in ("first", "second")]
    if layout == "ransac_tutorial":  # its scene alone, under another name
        roots = [root / "church" for root in roots]
        roots[1] = roots[1].rename(tmp_path / "chapel")
    keys = [[pair.key for pair in reload(layout, root)] for root in roots]
    assert (len(set(keys[0])), keys[0]) == (writers.PAIRS, keys[1])


def test_a_report_finds_it(tmp_path: Path) -> None:
    dataset = load("hloc", tmp_path)
    stored = {**presets.load("dataset", "h5"), "layout": "hloc"}
    options = Options(1, [tmp_path / root for root in ("Truth", "hloc")])
    assert find_dataset({**stored, "digest": dataset.digest}, options).digest == dataset.digest
    with pytest.raises(DataError, match="has changed since the run"):
        find_dataset({**stored, "digest": "another"}, options)


def test_the_pipeline_of_given_matches_estimates_as_the_function_does(tmp_path: Path) -> None:
    """With the prior that `find_fundamental` derives from the same points."""
    pair = load("oanet", tmp_path)[0]
    c, _ = pair.matches()
    (outcome,) = load_pipeline("given_fmtorch").run([pair], seed=3)
    alone = fmtorch.find_fundamental(
        c.x0, c.x1, mask=c.mask, ratio=c.ratio, score=c.score, size0=c.size0, size1=c.size1, key=pair.key, seed=3
    )
    assert torch.equal(outcome.estimate.F, alone.F)


def test_one_file_is_no_image_of_two_scenes(tmp_path: Path) -> None:
    root, images = writers.write_tutorial(tmp_path / "ransac_tutorial"), tmp_path / "images"
    shutil.copytree(root / "church", root / "temple")  # with the same names of images
    images.mkdir()
    for name in {image.path.name for pair in reload("ransac_tutorial", root) for image in (pair.image0, pair.image1)}:
        (images / name).write_bytes(black(writers.SIZE))
    with pytest.raises(DataError, match="would stand for images of the scenes church and temple: give each a folder"):
        reload("ransac_tutorial", root, images=images)
    with pytest.raises(DataError, match=r"images=.*nowhere: no such folder"):
        reload("ransac_tutorial", root, images=images / "nowhere")


def test_pruning_is_judged_as_oanets_test_does(tmp_path: Path) -> None:
    """Precision and recall by the labels of the file, of all matches in front of pruning; one table with both means."""
    root = writers.write_oanet(tmp_path / "oanet", outliers=20)
    dataset = reload("oanet", root)
    half = {"ratio": lambda c: c.keep((torch.arange(c.mask.shape[1]) % 2 == 0).expand(c.mask.shape))}
    outcomes = pipeline(**half).run(list(dataset))
    rows = evaluate(outcomes)
    with h5py.File(next(root.glob("*"))) as file:
        labels = [file[f"ys/{i}"][:, 0] < 1e-4 for i in range(writers.PAIRS)]
    for row, outcome, label in zip(rows, outcomes, labels, strict=True):
        kept = outcome.estimate.inliers[0, : len(label[::2])].numpy()
        assert row.match_precision == pytest.approx(label[::2][kept].mean())
        assert row.match_recall == pytest.approx(label[::2][kept].sum() / label.sum())
    group = summarize(to_table(rows))["all"]
    p, r = (np.array([getattr(row, f"match_{name}") for row in rows]) for name in ("precision", "recall"))
    means = {"precision": p.mean(), "recall": r.mean(), "f_score": (2 * p * r / (p + r)).mean()}
    assert group["labels"] == pytest.approx(means)
    page = summary_markdown({"all": group}, "title")
    heading = "| Pruning | mAP@5° | mAP@20° | AUC@5° | AUC@10° | AUC@20° | P | R | F |"
    assert heading in page
    assert "beside mAP5° and mAP20° of OANet" in page
    failed = evaluate([Outcome(pair, reason="no") for pair in dataset])
    assert [(row.match_precision, row.match_recall) for row in failed] == [(0.0, 0.0)] * writers.PAIRS


def test_geodesic_distances_are_of_calibrated_points_also_of_pixels_that_are_not_square() -> None:
    x0, x1, _, K0, K1, R, t = (value.numpy() for value in scene(30, noise=5.0))
    K0[0, 1] = 9
    E = np.cross(np.eye(3), t).T @ R
    for i, distance in enumerate(oanet.geodesic(R, 3 * t, K0, K1, x0, x1)):
        a, b = np.linalg.inv(K0) @ [*x0[i], 1], np.linalg.inv(K1) @ [*x1[i], 1]
        line1, line0 = E @ a, E.T @ b
        squared = (b @ E @ a) ** 2 * (1 / (line1[:2] @ line1[:2]) + 1 / (line0[:2] @ line0[:2]))
        assert distance == pytest.approx(squared, rel=1e-9)
