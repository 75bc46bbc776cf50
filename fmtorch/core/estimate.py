"""What estimators say of a batch of pairs."""

from __future__ import annotations

import dataclasses
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core.records import Index, Record, as_index, expect_fields

RELATED = 1.0
"""The significance from which on two images are called related; chosen on tuning pairs (docs/concepts/related.md)."""

CONFIGURATIONS = ("general", "planar", "rotation", "identical", "unrelated")
WARNINGS = {
    "general": "",
    "planar": "one plane: matches do not determine F or focal lengths, and leave two poses of known cameras",
    "rotation": "the camera only turns: matches determine neither F nor a translation",
    "identical": "one photograph twice: matches determine neither F nor a pose",
    "unrelated": "the images show nothing in common",
}
"""What each configuration leaves open."""


@dataclasses.dataclass(frozen=True, eq=False)
class Estimate(Record):
    """Fundamental matrices of B pairs.

    F: (B, 3, 3) with unit Frobenius norm, zero where `ok` is False. inliers: (B, N), within the mask; none where `ok`
    is False. ok: (B,). reason: why a pair failed, empty where it did not. draws: minimal samples drawn, (B,).
    significance: (B,), how far the support of F is beyond chance, see `fmtorch.geometry.significance`: -log10 of the
    number of models with as much support that are expected among images that show nothing in common; -inf where `ok`
    is False, NaN where nobody has computed it; never None. model: what `F` is, "fundamental", or "homography" for
    `x1 ~ F x0`, which is positive where the plane is seen; then `H` is another name for it.

    Where cameras are known or asked for, NaN if not determined: focals (B, 2), px; X1 = R X0 + t, t of unit length;
    E = [t]_x R. fit_scale: (B,), the Sampson distance of a usual match from which on it did not count in the final fit,
    px. focal_precision: (B, 2, 2), the second derivatives of the prior's cost by the logarithms of the focal lengths,
    infinite on the diagonal where these are exact.

    Where the covariance is asked for: covariance (B, 7, 7) of (rotation vector omega of ``exp([omega]x) R``, tau,
    log f0, log f1), radians and logarithms, where t moves to ``t + tangents tau``; tangents (B, 3, 2);
    covariance_F (B, 9, 9), of F row by row. See `fmtorch.geometry.covariance`.

    Where the configuration is asked for: configuration_index (B,), into `CONFIGURATIONS`; homography (B, 3, 3), of the
    plane, the rotation or the copy, zero where there is none; other_R, other_t, the second pose that explains a plane,
    NaN where there is none.
    """

    F: Float[Tensor, "b 3 3"]
    inliers: Bool[Tensor, "b n"]
    ok: Bool[Tensor, " b"]
    reason: tuple[str, ...]
    draws: Int[Tensor, " b"]
    significance: Float[Tensor, " b"] | None = None
    model: str = "fundamental"
    E: Float[Tensor, "b 3 3"] | None = None
    R: Float[Tensor, "b 3 3"] | None = None
    t: Float[Tensor, "b 3"] | None = None
    focals: Float[Tensor, "b 2"] | None = None
    fit_scale: Float[Tensor, " b"] | None = None
    focal_precision: Float[Tensor, "b 2 2"] | None = None
    covariance: Float[Tensor, "b 7 7"] | None = None
    tangents: Float[Tensor, "b 3 2"] | None = None
    covariance_F: Float[Tensor, "b 9 9"] | None = None
    configuration_index: Int[Tensor, " b"] | None = None
    homography: Float[Tensor, "b 3 3"] | None = None
    other_R: Float[Tensor, "b 3 3"] | None = None
    other_t: Float[Tensor, "b 3"] | None = None

    def __post_init__(self) -> None:
        expect_fields(self)
        b = len(self)
        if self.significance is None:
            unknown = torch.full((b,), torch.nan, dtype=torch.float64, device=self.F.device)
            object.__setattr__(self, "significance", unknown)
        if not isinstance(self.reason, tuple | list) or not all(isinstance(entry, str) for entry in self.reason):
            raise TypeError(f"reason is a {type(self.reason).__name__}; it must be a tuple of strings")
        object.__setattr__(self, "reason", tuple(self.reason))
        if len(self.reason) != b:
            raise ValueError(f"reason has {len(self.reason)} entries; it must have one for each of the {b} pairs")

    @property
    def H(self) -> Float[Tensor, "b 3 3"]:
        """The homographies. Raises AttributeError where the estimate is of another model."""
        if self.model != "homography":
            raise AttributeError(f"these are {self.model} matrices; find_homography gives homographies")
        return self.F

    @property
    def related(self) -> Bool[Tensor, " b"]:
        """Whether the two images are taken to show one scene: ok, with a significance of at least `RELATED`.

        Recall and all other figures are of `ok` alone; this tells whom to believe.
        """
        return self.ok & (cast(Tensor, self.significance) >= RELATED)

    @property
    def configuration(self) -> tuple[str, ...]:
        """The name in `CONFIGURATIONS` of each pair. Raises AttributeError where it was not asked for."""
        if self.configuration_index is None:
            raise AttributeError("the configuration is not known; find_fundamental(..., configuration=True) tells it")
        return tuple(CONFIGURATIONS[i] for i in self.configuration_index.tolist())

    @property
    def warning(self) -> tuple[str, ...]:
        """What the configuration of each pair leaves open, empty where nothing. Raises as `configuration`."""
        return tuple(WARNINGS[name] for name in self.configuration)

    @property
    def deviation_degrees(self) -> Float[Tensor, "b 2"]:
        """Root mean squared angles by which the rotation and the direction of translation may be off, under independent
        noise; 132 and 98 degrees where nothing is known. Raises AttributeError where no covariance was asked for."""
        if self.covariance is None:
            raise AttributeError("the covariance is not known; find_fundamental(..., covariance=True) gives it")
        variances = self.covariance.diagonal(dim1=-2, dim2=-1)
        return torch.rad2deg(torch.stack([variances[:, :3].sum(-1), variances[:, 3:5].sum(-1)], -1).sqrt())

    def __len__(self) -> int:
        """Number of pairs."""
        return int(self.F.shape[0])

    def __getitem__(self, index: Index) -> Estimate:
        """The selected pairs, always as a batch."""
        i = as_index(index, len(self))
        picked = torch.arange(len(self), device=self.ok.device)[i].tolist()
        return self._map(lambda value: value[i], reason=tuple(self.reason[j] for j in picked))
