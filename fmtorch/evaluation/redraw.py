"""A pair of a run seen again: its pictures, and where its pipeline now gives another result than the run stored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from fmtorch.data import ImagePair
from fmtorch.evaluation.canvas import Image
from fmtorch.evaluation.page import Picture
from fmtorch.evaluation.pictures import draw_epipolar_lines, draw_epipolar_lines_of_corners, draw_matches
from fmtorch.metrics import corner_error, nsgd
from fmtorch.pipeline.pipeline import Outcome

SAME_F = 1e-12  # difference of any element, of unit Frobenius norm, within which two F are the same
SAME_CORNERS = 0.01  # px, corner error up to which two homographies are the same: what captions show
SAME_NSGD = 1e-4  # between the F of a run and the one drawn again, up to which they are the same: what captions show


def difference(pair: ImagePair, images: Sequence[Image], stored: Mapping[str, Any], outcome: Outcome) -> str:
    """What differs between the row of a pair and what its pipeline makes of it now; empty where nothing does."""
    again, reason = outcome.estimate, outcome.reason
    if pair.H is not None:
        return _difference_of_homographies(pair, images, stored, outcome)
    if again is None or not bool(again.ok[0]):
        return f"gives no F when it is drawn again ({reason}), unlike in its run" if stored["ok"] else ""
    run = torch.tensor(stored["F"], dtype=torch.float64) if stored["ok"] else None
    if run is not None and torch.allclose(run, again.F[0].cpu().flatten(), rtol=0, atol=SAME_F):
        return ""
    sizes = [torch.tensor([image.shape[:2]]) for image in images]

    def distance(F: torch.Tensor) -> float:
        return float(nsgd(F.reshape(1, 3, 3), again.F.cpu(), *sizes, key=torch.tensor([pair.key]))[0])

    error = distance(torch.from_numpy(pair.F))
    if run is None:
        return f"gives an F when it is drawn again, of NSGD {error:.4f}, unlike in its run"
    apart = distance(run)
    if apart <= SAME_NSGD:
        return ""
    return (
        f"gives another F when it is drawn again: NSGD {error:.4f}, in its run {stored['nsgd']:.4f}; the two are "
        f"{apart:.4f} apart. Its matches below are those of now, its epipolar lines those of the run"
    )


def _difference_of_homographies(
    pair: ImagePair, images: Sequence[Image], stored: Mapping[str, Any], outcome: Outcome
) -> str:
    """The same of a homography, by its corner error."""
    again = outcome.estimate
    if again is None or not bool(again.ok[0]) or not stored["ok"]:
        has_homography = again is not None and bool(again.ok[0])
        return (
            ""
            if has_homography == bool(stored["ok"])
            else f"{'gives a' if has_homography else 'gives no'} homography now, unlike in its run"
        )
    size, H = torch.tensor([images[0].shape[:2]]), torch.tensor(stored["H"], dtype=torch.float64).reshape(1, 3, 3)
    apart = float(corner_error(again.F.cpu(), H, size)[0])
    return "" if apart <= SAME_CORNERS else f"gives another homography when it is drawn again, {apart:.2f} px apart"


def drawn(
    pair: ImagePair, images: Sequence[Image], stored: Mapping[str, Any], outcome: Outcome, name: str
) -> list[Picture]:
    """A run's matches of a pair, drawn again, and the epipolar lines of the F that it stored.

    Of a pair that has no F, its matches; nothing where there are none, or none of an F that was stored.
    """
    c, estimate = outcome.correspondences, outcome.estimate
    if c is None or estimate is None or (stored["ok"] and not bool(estimate.ok[0])):
        return []
    x0, x1 = (x[0].cpu().numpy().astype(np.float64) for x in (c.x0, c.x1))
    inliers = estimate.inliers[0].cpu().numpy() & bool(stored["ok"])
    matches = draw_matches(images[0], images[1], x0, x1, inliers)
    matrix = "F" if pair.H is None else "H"
    said = f"{int(inliers.sum())} inliers of {matrix} (green) of {len(inliers)} matches; a sample of either is drawn"
    pictures = [Picture(matches, f"matches of {name}", said)]
    if stored["ok"] and pair.H is None:
        F = np.array(stored["F"]).reshape(3, 3)
        lines = draw_epipolar_lines(images[0], images[1], x0[inliers], x1[inliers], F, truth=pair.F)
        said = "Epipolar lines of some inliers; the true ones dashed in white"
        pictures.append(Picture(lines, f"epipolar lines of {name}", said))
    return pictures


def from_stored(pair: ImagePair, images: Sequence[Image], stored: Mapping[str, Any], name: str) -> list[Picture]:
    """The epipolar lines of the F that a run stored, of corners of the images; nothing of a pair without F."""
    if not stored["ok"] or pair.H is not None:
        return []
    F = np.array(stored["F"]).reshape(3, 3)
    lines = draw_epipolar_lines_of_corners(images[0], images[1], F, truth=pair.F)
    said = "Epipolar lines of some corners, each in the other image, by the stored F; the true ones dashed in white"
    return [Picture(lines, f"epipolar lines of {name}", said)]
