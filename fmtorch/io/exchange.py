"""What other libraries hold in memory: matches as arguments of `find_*`, geometries as estimates, and back.

``fmtorch.find_fundamental(**fmtorch.from_lightglue(features0, features1, matches))``."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fmtorch.core import lazy
from fmtorch.core.checks import as_tensor
from fmtorch.core.types import Estimate, PoseEstimate
from fmtorch.geometry import cross_matrix, unit_frobenius
from fmtorch.io.colmap import among, imported
from fmtorch.io.match_store import ORIGIN, Kind, PairGeometry, two_view_geometry

KINDS: Mapping[str, Kind] = {  # COLMAP's configurations by the pair types that are not general
    "planar": "planar", "rotation": "panoramic", "identical": "planar_or_panoramic", "unrelated": "degenerate",
}  # fmt: skip


@contextlib.contextmanager
def _taking(what: str) -> Iterator[None]:
    try:
        yield
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        kind = TypeError if isinstance(error, AttributeError | TypeError) else ValueError
        raise kind(f"what is given does not fit ({type(error).__name__}: {error}); it must be {what}") from error


@_taking("keypoints0 and keypoints1 of cv2.KeyPoint, then matches of cv2.DMatch, whose indices are of these")
def from_opencv(keypoints0: Sequence[Any], keypoints1: Sequence[Any], matches: Sequence[Any]) -> dict[str, Tensor]:
    """Arguments of `find_*` for matches of OpenCV: points, frames, and where two neighbours are given the ratio.

    Args:
        keypoints0, keypoints1: sequences of `cv2.KeyPoint`.
        matches: of `cv2.DMatch`, as `match` returns them, or of sequences of these, as `knnMatch` does.

    Returns:
        x0, x1 (N, 2); lafs0, lafs1 (N, 2, 3) where all keypoints have an orientation; ratio (N,) of nearest to second.
    """
    rows = [[entry] if hasattr(entry, "queryIdx") else list(entry) for entry in matches]
    rows = [row for row in rows if row]
    fields = {}
    for i, (keypoints, index) in enumerate(((keypoints0, "queryIdx"), (keypoints1, "trainIdx"))):
        numbered = dict(enumerate(keypoints))  # in which -1 is not the last one
        matched = [numbered[getattr(row[0], index)] for row in rows]
        table = torch.tensor([(*k.pt, k.size, k.angle) for k in matched], dtype=torch.float32).reshape(-1, 4)
        fields[f"x{i}"] = table[:, :2]
        if bool((table[:, 3] >= 0).all() & (table[:, 2] > 0).all()):
            angle, half = table[:, 3].deg2rad(), table[:, 2] / 2
            axes = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).reshape(-1, 2, 2)
            fields[f"lafs{i}"] = torch.cat([half[:, None, None] * axes, table[:, :2, None]], -1)
    if not {"lafs0", "lafs1"} <= fields.keys():
        fields = {name: fields[name] for name in ("x0", "x1")}
    if rows and all(len(row) > 1 for row in rows):
        fields["ratio"] = torch.tensor([min(row[0].distance / max(row[1].distance, 1e-12), 1.0) for row in rows])
    return fields


@_taking("features0 and features1 with keypoints, and matches with matches0 and matching_scores0 or matches and scores")
def from_lightglue(
    features0: Mapping[str, Any], features1: Mapping[str, Any], matches: Mapping[str, Any]
) -> dict[str, Any]:
    """Arguments of `find_*` for the dictionaries of LightGlue, of glue-factory's and of kornia's, with a batch or not.

    Args:
        features0, features1: with `keypoints` (N, 2) or (B, N, 2), and `image_size` (w, h) if known.
        matches: with `matches0` and `matching_scores0`, or with `matches` and `scores`.

    Returns:
        x0, x1 and score of one pair, or lists of them; size0, size1 where known.
    """
    keypoints = [as_tensor(each["keypoints"], "keypoints") for each in (features0, features1)]
    batched = keypoints[0].dim() == 3
    count = len(keypoints[0]) if batched else 1
    pairs: dict[str, list[Tensor]] = {"x0": [], "x1": [], "score": []}
    for b in range(count):
        own = [each[b] if batched else each for each in keypoints]
        index, scores = _lightglue_matches(matches, b if batched else None)
        pairs["x0"].append(own[0][index[:, 0]])
        pairs["x1"].append(own[1][index[:, 1]])
        pairs["score"].append(scores.clamp(0, 1))
    fields: dict[str, Any] = {name: values if count > 1 else values[0] for name, values in pairs.items()}
    sizes = [each.get("image_size") for each in (features0, features1)]
    if all(size is not None for size in sizes):
        fields |= {f"size{i}": as_tensor(size, f"size{i}").flip(-1) for i, size in enumerate(sizes)}
    return fields


def _lightglue_matches(matches: Mapping[str, Any], b: int | None) -> tuple[Tensor, Tensor]:

    def of_pair(name: str) -> Tensor:
        return as_tensor(matches[name] if b is None else matches[name][b], name)

    if "matches0" in matches:
        partners, scores = of_pair("matches0"), of_pair("matching_scores0")
        matched = (partners > -1).nonzero()[:, 0]
        return torch.stack([matched, partners[matched].long()], -1), scores[matched]
    return of_pair("matches").long(), of_pair("scores")


@_taking("a dictionary with keypoints0, keypoints1 and, if known, confidence and batch_indexes")
def from_kornia(matches: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `find_*` for the dictionary of a detector-free matcher of kornia, such as `kornia.feature.LoFTR`.
    matches: with `keypoints0`, `keypoints1` (N, 2), `confidence` (N,), and `batch_indexes` (N,) of several pairs, for
    which x0, x1 and score are lists."""
    names = {"x0": "keypoints0", "x1": "keypoints1", "score": "confidence"}
    fields = {name: as_tensor(matches[key], key) for name, key in names.items() if key in matches or name != "score"}
    pair = as_tensor(matches.get("batch_indexes", torch.zeros(len(fields["x0"]))), "batch_indexes")
    count = int(pair.max()) + 1 if len(pair) else 1
    if count == 1:
        return fields
    return {name: [value[pair == b] for b in range(count)] for name, value in fields.items()}


def to_colmap(estimate: Estimate, matches: Any = None) -> Any:
    """The `pycolmap.TwoViewGeometry` of an estimate of one pair, F and H in COLMAP's pixels.

    Args:
        estimate: of one pair, ``estimates[i]``; calibrated where `find_essential` made it.
        matches: keypoints of both images (N, 2) that the matches are of; None: match i is of keypoint i in both.

    Raises:
        ValueError: for several pairs, and matches of another number.
        ImportError: without pycolmap.
    """
    _expect_one(estimate, "to_colmap")
    values = {name: _matrix(getattr(estimate, name)) for name in ("E", "R", "t")}
    count = estimate.inliers.shape[1]
    index = _same(count) if matches is None else as_tensor(matches, "matches").cpu().numpy()
    if index.shape != (count, 2):
        raise ValueError(f"matches has shape {index.shape}; it must be ({count}, 2), as the estimate has matches")
    kind: Kind = "calibrated" if isinstance(estimate, PoseEstimate) and values["R"] is not None else "uncalibrated"
    H = _matrix(estimate.homography)
    if estimate.model == "homography":
        kind, H = "planar_or_panoramic", _matrix(estimate.H)
    elif not estimate.related[0]:
        kind = "degenerate"
    elif estimate.pair_type_index is not None:
        kind = KINDS.get(estimate.pair_type[0], kind)
    if not estimate.ok[0] or kind == "degenerate":
        return two_view_geometry(imported(), PairGeometry("degenerate", index[:0]))
    F = None if estimate.model == "homography" else _matrix(estimate.F)
    inliers = index[estimate.inliers[0].cpu().numpy()]
    return two_view_geometry(imported(), PairGeometry(kind, inliers, F, H=H, **values))


@_taking("a pycolmap.TwoViewGeometry, then matches (N, 2) or their number")
def from_colmap(geometry: Any, matches: Any) -> Estimate:
    """The estimate that a `pycolmap.TwoViewGeometry` describes, in pixels with (0, 0) at the first pixel's centre.

    Args:
        geometry: with F, or with H alone, of which the estimate is then; R, t and E where it has a pose.
        matches: keypoints of both images (N, 2), inliers among them; or N where match i is of keypoint i in both.
    """
    if isinstance(matches, int):
        matches = _same(matches)
    index = as_tensor(matches, "matches").long().cpu().numpy().reshape(-1, 2)
    verified = np.asarray(geometry.inlier_matches).reshape(-1, 2).astype(np.int64)
    inliers = torch.from_numpy(among(index, verified))[None]
    to = np.array([[1.0, 0, ORIGIN], [0, 1, ORIGIN], [0, 0, 1]])
    model, value = "fundamental", None if geometry.F is None else to.T @ geometry.F @ to
    if geometry.F is None and geometry.H is not None:
        model, value = "homography", np.linalg.inv(to) @ geometry.H @ to
    pose = None if geometry.cam2_from_cam1 is None else np.asarray(geometry.cam2_from_cam1.matrix())
    kind = str(imported().TwoViewGeometryConfiguration(geometry.config).name)
    return _estimate(value, model, inliers, pose, f"COLMAP calls it {kind.lower()}")


def to_poselib(estimate: Estimate) -> Any:
    """The `poselib.CameraPose` of an estimate of one pair with a pose.
    Raises ValueError for several pairs and where there is no pose, ImportError without poselib."""
    _expect_one(estimate, "to_poselib")
    R, t = _matrix(estimate.R), _matrix(estimate.t)
    if R is None or t is None:
        raise ValueError(f"the estimate has no pose{': ' if estimate.reason[0] else ''}{estimate.reason[0]}")
    pose = lazy.imported("poselib", "poselib is not installed; pip install 'fmtorch[peers]' brings it").CameraPose()
    pose.R, pose.t = R, t
    return pose


@_taking("a poselib.CameraPose with R and t, then the inliers (N,)")
def from_poselib(pose: Any, inliers: Any, K0: Any = None, K1: Any = None) -> Estimate:
    """The estimate that a `poselib.CameraPose` describes.

    Args:
        pose: of `poselib.estimate_relative_pose`.
        inliers: of its ``info["inliers"]``, (N,).
        K0, K1: calibration matrices (3, 3), for F in pixels; identities when not given.
    """
    K0, K1 = (np.eye(3) if K is None else as_tensor(K, "K").double().numpy() for K in (K0, K1))
    R, t = np.asarray(pose.R), np.asarray(pose.t)
    F = np.linalg.inv(K1).T @ (cross_matrix(torch.tensor(t)).numpy() @ R) @ np.linalg.inv(K0)
    return _estimate(F, "fundamental", as_tensor(inliers, "inliers").bool()[None], np.c_[R, t], "")


def _estimate(value: Any, model: str, inliers: Tensor, pose: Any, reason: str) -> Estimate:
    """An estimate of one pair: of a matrix (3, 3), or failed for a reason."""
    ok = value is not None and bool(np.asarray(value).any())
    matrix = torch.as_tensor(value if ok else np.zeros((3, 3)), dtype=torch.float64)[None]
    fields = {}
    if ok and pose is not None and np.any(pose[:, 3]):
        R, t = (torch.from_numpy(part.copy())[None] for part in (pose[:, :3], pose[:, 3]))
        fields = {"R": R, "t": t / t.norm(), "E": cross_matrix(t / t.norm()) @ R}
    reasons, samples = ("" if ok else reason or "no model",), torch.zeros(1, dtype=torch.int64)
    return Estimate(unit_frobenius(matrix), inliers & ok, torch.tensor([ok]), reasons, samples, model=model, **fields)


def _same(count: int) -> np.ndarray:
    return np.arange(count).repeat(2).reshape(-1, 2)


def _expect_one(estimate: Estimate, name: str) -> None:
    if len(estimate) != 1:
        raise ValueError(f"{name} takes one pair, not {len(estimate)}: [{name}(each) for each in estimates]")


def _matrix(value: Tensor | None) -> Any:
    """The matrix or vector of the only pair; None where there is none."""
    if value is None or not bool(value[0].isfinite().all()) or not bool(value[0].any()):
        return None
    return value[0].detach().cpu().double().numpy()
