"""Matches of photographs whose lenses are calibrated, as pinholes would have them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from fmtorch.core.lenses import Lens, undistorted_points, undistortion
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.geometry.cameras import calibration_problems

Lenses = tuple[Lens | None, Lens | None]
"""Of both images of a pair; None of a pinhole."""
FORMS = "a lens for both images, (lens0, lens1) with None for a pinhole, or a list of (lens0, lens1), one for each pair"


class CalibratedLenses:
    """The lenses of a batch. lens: as of `find_fundamental`. K: of the cameras, None without; of images without a lens
    these may be given. Raises ValueError for other forms, and for the parameters of a lens for all pairs."""

    def __init__(self, lens: Any, K0: Any = None, K1: Any = None) -> None:
        pairs = lens if isinstance(lens, list) and isinstance(lens[0], list | tuple) else [lens]
        self.pairs: list[Lenses] = [tuple(pair) if isinstance(pair, list | tuple) else (pair, pair) for pair in pairs]
        entries = [entry for pair in self.pairs for entry in pair]
        if {len(pair) for pair in self.pairs} != {2} or not all(isinstance(each, Lens | None) for each in entries):
            raise ValueError(f"lens holds a calibrated lens, so it must be {FORMS}")
        self.K = self._calibration(0, K0), self._calibration(1, K1)
        self.problems = [self._problem(pair) for pair in self.pairs]
        if len(self.pairs) == 1 and self.problems[0]:
            raise ValueError(self.problems[0])

    def _calibration(self, k: int, K: Any) -> Any:
        """K of an image, for all pairs or each of them."""
        lenses = [pair[k] for pair in self.pairs]
        known = [lens.K for lens in lenses if lens is not None]
        if not known:
            return K
        if K is not None:
            raise ValueError(f"K{k} and a lens of image {k} are given, and the lens has its own K: leave K{k} out")
        if len(known) < len(lenses):
            raise ValueError(
                f"lens has no lens of image {k} for some pairs; a pinhole there is fmtorch.Lens(fx, fy, cx, cy)"
            )
        return np.stack(known) if len(known) > 1 else known[0]

    @staticmethod
    def _problem(pair: Lenses) -> str:
        for k, lens in enumerate(pair):
            if lens is not None:
                if not np.isfinite(lens.coefficients).all():
                    return f"the lens of image {k} has the coefficients {lens.coefficients}; they must be finite"
                if problem := calibration_problems(torch.from_numpy(lens.K)[None], None, f"K of the lens of image {k}")[
                    0
                ]:
                    return problem
        return ""

    def undistorted(self, c: Correspondences) -> Correspondences:
        """The matches as pinholes would have them; none of a pair whose lens is none."""
        if len(self.pairs) not in (1, len(c)):
            raise ValueError(f"lens has lenses for {len(self.pairs)} pairs of {len(c)}; it must be {FORMS}")
        of = range(len(self.pairs)) if len(self.pairs) == len(c) else [0] * len(c)
        valid = torch.tensor([not self.problems[i] for i in of], dtype=torch.bool, device=c.mask.device)
        return undistorted_matches(c.keep(valid[:, None] & c.mask), [self.pairs[i] for i in of])

    def with_reasons(self, estimate: Estimate, c: Correspondences, seen: Correspondences) -> Estimate:
        """The estimate of undistorted matches `seen`, with the reasons why it has none of c."""
        reasons = list(estimate.reason)
        for i, (ok, before, after) in enumerate(
            zip(estimate.ok.tolist(), c.count().tolist(), seen.count().tolist(), strict=True)
        ):
            if not ok and 2 * after < before:
                unseen = (
                    f"pinholes see {after} of {before} matches: the lens folds, or looks more than 90 degrees aside"
                )
                reasons[i] = self.problems[i if len(self.pairs) > 1 else 0] or unseen
        return estimate.derived(reason=tuple(reasons))


def undistorted_matches(c: Correspondences, lenses: Sequence[Lenses]) -> Correspondences:
    """The matches of a batch as pinholes of the same K would have them; one that a pinhole does not see is masked.

    lenses: of each pair. A match's noise grows as its points are stretched, so that its distances count in pixels of
    the photographs: by the root of the mean over both images of the determinant of the derivatives of its points.
    Gradients reach the points of the photographs.
    """
    fields, seen, stretch = dict[str, torch.Tensor](), np.ones(c.mask.shape, np.bool_), np.zeros(c.mask.shape)
    for k, (points, lafs) in enumerate(((c.x0, c.lafs0), (c.x1, c.lafs1))):
        x = points.detach().cpu().numpy().astype(np.float64)  # a copy
        J, bends = np.broadcast_to(np.eye(2), (*x.shape, 2)).copy(), False
        for i, pair in enumerate(lenses):
            if (lens := pair[k]) is not None and lens.bends:
                with np.errstate(all="ignore"):
                    x[i] = undistorted_points(lens, x[i])
                    J[i], bends = undistortion(lens, x[i]), True
                valid = np.isfinite(x[i]).all(-1) & np.isfinite(J[i]).all((-2, -1))
                x[i, ~valid], J[i, ~valid], seen[i] = 0, 0, seen[i] & valid
        stretch += np.abs(np.linalg.det(J)) / 2
        if not bends:
            continue
        there, slope = torch.from_numpy(x).to(points), torch.from_numpy(J).to(points)
        if points.requires_grad:
            step = torch.where((slope != 0).any(-1).any(-1)[..., None], points - points.detach(), 0)
            there = there + (slope @ step[..., None])[..., 0]
        fields[f"x{k}"] = there
        if lafs is not None:
            fields[f"lafs{k}"] = torch.cat([slope.to(lafs) @ lafs[..., :2], there.detach().to(lafs)[..., None]], -1)
    if not fields:
        return c
    fields["mask"] = c.mask & torch.from_numpy(seen).to(c.mask.device)
    noise = torch.from_numpy(np.where(seen & (stretch > 0), np.sqrt(stretch), 1)).to(c.x0)
    return c.derived(**fields, noise=noise if c.noise is None else c.noise * noise)
