"""Two cameras of square pixels and central principal points: factors of a fundamental matrix, and the way there."""

from __future__ import annotations

import dataclasses
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.estimators.focal.prior import USUAL_FOCAL
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.geometry.arithmetic import as_rows, component_sum, exponential, logarithm, sqrt
from fmtorch.geometry.rank2 import complement
from fmtorch.geometry.rank2_manifold import start

MIN_IMAGE_SIDE_PX = 16.0  # longer side of both images below which sizes are taken for those of another unit than pixels
MIN_FOCAL, MAX_FOCAL = 0.25, 5.0  # focal lengths outside, in units of the longer side, are not believed at the start


@dataclasses.dataclass(frozen=True, eq=False)
class TwoCameras:
    """Cameras of square pixels and central principal points, ``E = U diag(1, 1, 0) V^T``; NaN where none are assumed.

    axes: U and V, (3, 3, 2, P), rows first. focal: the logarithms of the focal lengths in units of the longer sides,
    (2, P). Of several candidates a pair, (3, 3, 2, P, K) and (2, P, K).
    """

    axes: Tensor
    focal: Tensor

    @staticmethod
    def none(F: Float[Tensor, "9 p"]) -> TwoCameras:
        """No assumption about any of the pairs of these models."""
        p = F.shape[1]
        return TwoCameras(F.new_full((3, 3, 2, p), torch.nan), F.new_full((2, p), torch.nan))

    @property
    def known(self) -> Bool[Tensor, " p"]:
        """Where cameras are assumed."""
        return torch.isfinite(self.focal[0])

    def __getitem__(self, rows: Tensor) -> TwoCameras:
        """Those of the selected pairs."""
        return TwoCameras(self.axes[:, :, :, rows], self.focal[:, rows])

    def replaced(self, rows: Int[Tensor, " q"], other: TwoCameras) -> TwoCameras:
        """With other cameras for these pairs."""
        return TwoCameras(self.axes.index_copy(3, rows, other.axes), self.focal.index_copy(1, rows, other.focal))

    def joined(self, other: TwoCameras) -> TwoCameras:
        """The candidates of both."""
        return TwoCameras(torch.cat([self.axes, other.axes], -1), torch.cat([self.focal, other.focal], -1))


class CentredPairs:
    """Matches relative to the principal points, of pairs whose image sizes are known.

    offset: (4, P) from the centre of the points to the principal points. points: (4, P, N) from the principal points.
    longest: (2, P) the longer sides of the images. All in normalised units. same_size: (P,).
    """

    def __init__(self, pairs: NormalizedPairs) -> None:
        assert pairs.size0 is not None
        assert pairs.size1 is not None
        middle = torch.cat([pairs.size0.flip(-1), pairs.size1.flip(-1)], -1).to(torch.float64)
        # Half a pixel, of images in pixels; of sizes in another unit nobody knows what it is, and it is small.
        pixel = torch.where(middle.amax(-1, keepdim=True) < MIN_IMAGE_SIDE_PX, 0.0, 1.0)
        self.offset = ((pairs.centre - (middle - pixel) / 2) / pairs.pixels_per_unit[:, None]).T
        self.points = pairs.points + self.offset[..., None]
        longest = torch.stack([pairs.size0.amax(-1), pairs.size1.amax(-1)]).to(torch.float64)
        self.longest = longest / pairs.pixels_per_unit
        self.same_size = (pairs.size0 == pairs.size1).all(-1)


def focal_scaling(depth: Float[Tensor, " 2 *s"]) -> Float[Tensor, " 3 3 *s"]:
    """What ``diag(1, 1, depth1) E diag(1, 1, depth0)`` multiplies E by; depth: focal length in the unit of points."""
    scaling = depth.new_ones(3, 3, *depth.shape[1:])
    scaling[:, 2] = depth[0]
    scaling[2] *= depth[1]
    return scaling


def translated(F: Float[Tensor, "9 p k"], offset: Float[Tensor, "4 p"]) -> Float[Tensor, "9 p k"]:
    """F for points from which the offset is taken: ``T(offset1)^T F T(offset0)``."""
    x0, y0, x1, y1 = offset[..., None]
    a, b, c = as_rows(F).unbind(1)
    G = torch.stack([a, b, c + x0 * a + y0 * b], 1)
    return torch.stack([G[0], G[1], G[2] + x1 * G[0] + y1 * G[1]]).flatten(0, 1)


def nearest_cameras(F: Float[Tensor, "9 p k"], longest: Float[Tensor, "2 p"]) -> tuple[Tensor, Tensor]:
    """U and V, and log focal lengths, near F: those that F has, the usual ones where these are implausible."""
    G, e0, e1 = start(F)
    square = bougnoux(G, e0, e1) / longest[..., None].square()
    plausible = ((square > MIN_FOCAL**2) & (square < MAX_FOCAL**2)).all(0)
    focal = torch.where(plausible, logarithm(torch.where(plausible, square, 1)) / 2, math.log(USUAL_FOCAL))
    depth = 1 / (exponential(focal) * longest[..., None])
    M, e0, e1 = start(G * focal_scaling(depth).flatten(0, 1), 0)
    p, q = complement(e0)
    a, b = complement(e1)
    # In the planes across the epipoles M is 2 x 2; its nearest orthogonal matrix gives both singular values 1.
    Mp, Mq = (component_sum(as_rows(M) * v, 1) for v in (p, q))
    m00, m01, m10, m11 = (component_sum(s * t) for s in (a, b) for t in (Mp, Mq))
    sign = torch.where(m00 * m11 >= m01 * m10, 1.0, -1.0).to(M)
    c, s = m00 + sign * m11, m10 - sign * m01
    norm = sqrt(c * c + s * s)
    c, s = c / norm, s / norm
    U = torch.stack([a * c + b * s, sign * (b * c - a * s), e1], 1)
    return torch.stack([U, torch.stack([p, q, e0], 1)], 2), focal


def bougnoux(
    F: Float[Tensor, "9 p k"], e0: Float[Tensor, "3 p k"], e1: Float[Tensor, "3 p k"]
) -> Float[Tensor, "2 p k"]:
    """Squared focal lengths of both cameras from F with epipoles e0, e1, principal points at the origin.

    May be negative or infinite: where the optical axes meet, F does not determine them. Bougnoux (ICCV 1998).
    """

    def squared(f: Tensor, e: Tensor) -> Tensor:
        r = f[0] * -e[1] + f[1] * e[0]  # the last row of [e]x times F
        value: Tensor = -(r[2] * f[2, 2]) / (r[0] * f[2, 0] + r[1] * f[2, 1])
        return value

    f = as_rows(F)
    return torch.stack([squared(f, e1), squared(f.transpose(0, 1), e0)])


def rotated(axes: Float[Tensor, "3 3 *s"], angle: Float[Tensor, 3 * s]) -> Float[Tensor, "3 3 *s"]:
    """``U R`` with the rotation by twice the angle whose tangent is half of `angle`, about its direction (Cayley)."""
    x, y, z = c = angle / 2
    n = component_sum(c * c)
    crossed = torch.stack(
        [z * axes[:, 1] - y * axes[:, 2], x * axes[:, 2] - z * axes[:, 0], y * axes[:, 0] - x * axes[:, 1]], 1
    )
    along = component_sum(axes * c, 1)
    # U (I + 2 / (1 + n) ([c]x + [c]x^2)), and [c]x^2 = c c^T - n I.
    turned: Tensor = axes + 2 / (1 + n) * (crossed + along[:, None] * c - n * axes)
    return turned
