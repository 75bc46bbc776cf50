"""What is found of two photographs."""

from __future__ import annotations

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import RELATED, Correspondences
from fmtorch.storage.exchange.two_view import PairGeometry

FLAT = ("planar", "rotation", "identical")  # configurations of which a homography explains all matches


@dataclasses.dataclass(frozen=True, eq=False)
class MatchResult:
    """The matches of two photographs and their fundamental matrix, ``x1^T F x0 = 0``, in pixels of the photographs.

    keypoints0, keypoints1: all that were detected, (N0, 2) and (N1, 2).
    putative: the matcher's matches, a batch of one. kept: which of them the pruners kept, (M,).
    correspondences: the kept ones, a batch of one. inliers: which of those agree with F, (K,).
    F: (3, 3) float64 of unit Frobenius norm; zero where there is none, and `reason` then says why.
    significance: how far the support of F is beyond chance (`fmtorch.geometry.significance`); -inf where there is no F.
    warning: why F, though found, means little; mostly empty. counts: matches after each step, in order. seconds: of
    each step, cached features with those they took when they were computed.
    R (3, 3), t (3,), focals (2,): X1 = R X0 + t with a t of unit length, and focal lengths in pixels of the
    photographs, where cameras were asked for; NaN where not determined.
    configuration: one of `CONFIGURATIONS`; empty where nothing could be matched. geometry: the two-view geometry for
    COLMAP, whose inliers are indices of the kept matches, twice. undistorted: where a lens distorts, the kept matches
    as pinholes would have them, which F and homography relate; points are otherwise those of the photographs.
    """

    keypoints0: Float[Tensor, "n0 2"]
    keypoints1: Float[Tensor, "n1 2"]
    putative: Correspondences
    kept: Bool[Tensor, " m"]
    correspondences: Correspondences
    inliers: Bool[Tensor, " k"]
    F: Float[Tensor, "3 3"]
    reason: str = ""
    warning: str = ""
    counts: dict[str, int] = dataclasses.field(default_factory=dict)
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    significance: float = -math.inf
    R: Float[Tensor, "3 3"] | None = None
    t: Float[Tensor, " 3"] | None = None
    focals: Float[Tensor, " 2"] | None = None
    configuration: str = ""
    geometry: PairGeometry | None = None
    undistorted: Correspondences | None = None

    @property
    def homography(self) -> Float[Tensor, "3 3"] | None:
        """Of planes, rotations and copies: ``x1 ~ H x0`` in pixels of the photographs; else None."""
        H = None if self.geometry is None or self.configuration not in FLAT else self.geometry.H
        return None if H is None else torch.from_numpy(H)

    @property
    def related(self) -> bool:
        """Whether the photographs are taken to show one scene: F was found, and its support is beyond chance."""
        return self.ok and self.significance >= RELATED

    @property
    def ok(self) -> bool:
        """Whether a fundamental matrix was found."""
        return not self.reason
