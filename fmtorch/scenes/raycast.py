"""Exact pinhole cameras, and which surface each pixel's ray meets first: ray-plane intersection with a depth buffer.

A piece ``X = O + s U + t V`` is seen by a camera P through the homography ``G = P [U V O; 0 0 1]``. Hence the ray of
pixel x meets its plane at ``(s, t, 1) = z G^-1 (x, y, 1)``: three linear forms and one division for each pixel, and the
depth z is the reciprocal of the third form. Each piece is intersected with the rays of its bounding box only."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmtorch.data import pairs
from fmtorch.data.pairs import fundamental, relative_pose
from fmtorch.jit.kernel import B1x1, F4x1, F4x2, F4x3, I4x2, I8x1, I8x2, U1x1, inner, kernel
from fmtorch.jit.lanes import fused
from fmtorch.scenes.surfaces import Floats, Pixels, Real, Surfaces

__all__ = ["Camera", "Matrix", "calibration", "fundamental", "look_at", "relative_pose"]

Matrix = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Camera(pairs.Camera):
    """A pinhole: ``x ~ K (R X + t)``, pixels (x, y) with (0, 0) at the centre of the first pixel; size (h, w).
    World units are metres with z upwards; camera axes are OpenCV's (x right, y down, z forward)."""

    size: tuple[int, int]

    @property
    def centre(self) -> Matrix:
        return -self.R.T @ self.t

    @property
    def P(self) -> Matrix:
        """The projection matrix K [R | t], (3, 4)."""
        return self.K @ np.column_stack([self.R, self.t])

    def project(self, X: Matrix) -> tuple[Matrix, Matrix]:
        """World points (n, 3) to pixels (n, 2) and depths (n,)."""
        x = (X @ self.R.T + self.t) @ self.K.T
        return x[:, :2] / x[:, 2:], x[:, 2]


def calibration(focal: Real, size: tuple[float, float], centre: tuple[float, float] | None = None) -> Matrix:
    """K of square pixels: focal length in pixels, principal point (x, y), by default the middle of the image."""
    h, w = size
    cx, cy = centre if centre is not None else ((w - 1) / 2, (h - 1) / 2)
    return np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def scaled_camera(
    focal: Real, size: tuple[int, int], scale: Real, centre: tuple[float, float] | None = None
) -> tuple[Matrix, tuple[int, int]]:
    """K and the size (h, w) of an image of a camera, in pixels, that is scaled."""
    scaled = round(size[0] * scale), round(size[1] * scale)
    middle = None if centre is None else (centre[0] * scale, centre[1] * scale)
    return calibration(focal * scale, scaled, middle), scaled


def look_at(K: Matrix, size: tuple[int, int], centre: Sequence[Real], target: Sequence[Real], roll: Real = 0) -> Camera:
    """A camera at `centre` that looks at `target`, upright but for a roll about its axis in radians."""
    c = np.asarray(centre, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - c
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cos, sin = np.cos(roll), np.sin(roll)
    R = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    return Camera(K, R, -R @ c, size)


Booleans = NDArray[np.bool_]
Number = Any  # a number of Python's or NumPy's; in a compiled function each has one type
Index = Any

_OPAQUE_FROM = 128  # of 255
SEAM = 1e-4  # pieces reach this much (of their own extent) beyond their edges, so that neighbours leave no gap
_LOW, _HIGH = np.float32(-SEAM), np.float32(1 + SEAM)  # of s and t, exclusive


class Pieces(NamedTuple):
    """n pieces as one camera sees them, and the order (k,) in which rays are cast against some of them, nearest first.
    boxes (n, 4): pixels x0, y0, x1, y1, end excluded. forms (n, 3, 3): of a pixel of the box, s z^-1, t z^-1, z^-1.
    depth (n, 3): along U, along V, at O. closest (n,): no point is nearer. triangle (n,)."""

    order: I8x1
    boxes: I8x2
    forms: F4x3
    depth: F4x2
    closest: F4x1
    triangle: B1x1


class Cutouts(NamedTuple):
    """Where pieces have holes.
    place (n, 2): where the picture with holes begins in `opacity`, and its row length; -1: without holes. window
    (n, 10): u at O, along U, along V; v likewise; the picture's origin x, y and size x, y. opacity: of all pictures."""

    place: I8x2
    window: F4x2
    opacity: U1x1


class Met(NamedTuple):
    """What the ray of each pixel (h, w) meets first so far: its depth, the piece's number (-1: none), s and t."""

    depth: F4x2
    piece: I4x2
    s: F4x2
    t: F4x2


@kernel(always_compiled=True)
def cast_pieces(pieces: Pieces, cutouts: Cutouts, near: np.float32, met: Met) -> None:
    """Casts rays against pieces, of depths beyond `near`; what they meet -> met."""
    order, boxes, forms, depth, closest, triangle = pieces
    cutout, window, opacity = cutouts
    buffer, piece, s, t = met
    width = buffer.shape[1]
    axis = np.arange(width).astype(np.float32)
    row_s, row_t, row_z = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    row_hit = np.empty(width, np.bool_)
    for k in range(len(order)):
        i = order[k]
        x0, y0, x1, y1 = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
        form, z_s, z_t, z_0 = forms[i], depth[i, 0], depth[i, 1], depth[i, 2]
        s_x, t_x, q_x = form[0, 0], form[1, 0], form[2, 0]
        is_triangle = triangle[i]
        if not _any_beyond(buffer[y0:y1, x0:x1], closest[i]):
            continue
        for y in range(y0, y1):
            before = buffer[y, x0:x1]
            from_top = np.float32(y - y0)
            s_y = form[0, 1] * from_top + form[0, 2]
            t_y = form[1, 1] * from_top + form[1, 2]
            q_y = form[2, 1] * from_top + form[2, 2]
            hits = 0
            for x in range(len(before)):
                q = q_x * axis[x] + q_y
                s_here = (s_x * axis[x] + s_y) / q
                t_here = (t_x * axis[x] + t_y) / q
                z = z_s * s_here + (z_t * t_here + z_0)
                edge = s_here + t_here if is_triangle else (s_here if s_here > t_here else t_here)
                hit = (s_here > _LOW) & (t_here > _LOW) & (edge < _HIGH) & (z < before[x]) & (z > near)
                row_s[x], row_t[x], row_z[x], row_hit[x] = s_here, t_here, z, hit
                hits += hit
            if hits == 0:
                continue
            if cutout[i, 0] >= 0:
                _open_holes(row_hit, row_s, row_t, len(before), opacity, cutout[i, 0], cutout[i, 1], window[i])
            here, here_s, here_t = piece[y, x0:x1], s[y, x0:x1], t[y, x0:x1]
            for x in range(len(before)):
                hit = row_hit[x]
                before[x] = row_z[x] if hit else before[x]
                here[x] = np.int32(i) if hit else here[x]
                here_s[x] = row_s[x] if hit else here_s[x]
                here_t[x] = row_t[x] if hit else here_t[x]


@inner
def _any_beyond(buffer: Floats, depth: Number) -> bool:
    for y in range(buffer.shape[0]):
        beyond = 0
        for x in range(buffer.shape[1]):
            beyond += buffer[y, x] >= depth
        if beyond > 0:
            return True
    return False


@inner
def _open_holes(
    hit: Booleans, s: Floats, t: Floats, n: int, opacity: NDArray[np.uint8], start: Index, stride: Index, window: Floats
) -> None:
    """Takes back the hits where the picture is transparent: its opacity, bilinearly, in 8 bits."""
    for x in range(n):
        if hit[x]:
            u = fused(fused(window[0], window[1], s[x]), window[2], t[x])
            v = fused(fused(window[3], window[4], s[x]), window[5], t[x])
            at_x = window[6] + (u - np.floor(u)) * window[8]
            at_y = window[7] + (v - np.floor(v)) * window[9]
            left, top = np.floor(at_x), np.floor(at_y)
            corner = start + np.int64(top) * stride + np.int64(left)
            a, b = np.float32(opacity[corner]), np.float32(opacity[corner + 1])
            c, d = np.float32(opacity[corner + stride]), np.float32(opacity[corner + stride + 1])
            above, below = fused(a, at_x - left, b - a), fused(c, at_x - left, d - c)
            hit[x] = np.rint(fused(above, at_y - top, below - above)) >= _OPAQUE_FROM


NEAR = 0.05  # metres


class Geometry:
    """The pieces of a scene as arrays, ready to be cast against any number of cameras."""

    def __init__(self, surfaces: Surfaces) -> None:
        self.O, self.U, self.V, self.uv, self.normals = surfaces.arrays()
        self.texture, self.triangle, self.both_sides = surfaces.labels()
        self.textures = surfaces.textures
        self.texture_size = np.array([texture.size for texture in self.textures]).reshape(-1, 2)[self.texture]
        normal = np.cross(self.V, self.U)
        self.normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        self.corners = np.stack([self.O, self.O + self.U, self.O + self.U + self.V, self.O + self.V], axis=1)

    def cast(
        self, P: Matrix, depth: Matrix, size: tuple[int, int], centre: Matrix | None,
        skip: NDArray[np.bool_] | None = None,
    ) -> tuple[Met, Matrix]:  # fmt: skip
        """What the rays of all pixels of a projection P (3, 4) meet, and G^-1 of every piece, (n, 3, 3).
        P: perspective or (last row 0 0 0 1) orthographic.
        depth: (4,), the affine function of the world by which the nearer of two pieces is known.
        centre: of a perspective camera, to leave out backs; None keeps them. skip: pieces (n,) to look through."""
        h, w = size
        G = np.stack([self.U @ P[:, :3].T, self.V @ P[:, :3].T, self.O @ P[:, :3].T + P[:, 3]], axis=2)
        usable = np.abs(np.linalg.det(G)) > 1e-14
        if centre is not None:
            usable &= self.both_sides | (((centre - self.O) * self.normal).sum(1) > 0)
        if skip is not None:
            usable &= ~skip
        inverse = np.zeros_like(G)
        inverse[usable] = np.linalg.inv(G[usable])
        boxes = self._boxes(P, size, usable)
        nearest = self.corners @ depth[:3] + depth[3]
        order = np.argsort(nearest.min(1), kind="stable")
        order = order[((boxes[:, 0] < boxes[:, 2]) & (boxes[:, 1] < boxes[:, 3]))[order]]
        # The linear forms, re-centred on each box in float64 so that float32 is accurate inside it.
        exact = inverse.copy()
        exact[:, :, 2] += (inverse[:, :, :2] * boxes[:, None, :2]).sum(-1)
        forms = exact.astype(np.float32)
        z_of = np.stack([self.U @ depth[:3], self.V @ depth[:3], self.O @ depth[:3] + depth[3]], 1).astype(np.float32)
        closest = np.where(nearest.min(1) > NEAR, 0.999 * nearest.min(1), -np.inf).astype(np.float32)
        pieces = Pieces(order, boxes, forms, z_of, closest, self.triangle)
        near = np.float32(-np.inf if centre is None else NEAR)
        far = np.full((h, w), np.inf, dtype=np.float32)
        met = Met(far, np.full((h, w), -1, dtype=np.int32), *np.zeros((2, h, w), dtype=np.float32))
        cast_pieces(pieces, self._cutouts(boxes), near, met)
        return met, inverse

    @functools.cached_property
    def _opacity(self) -> tuple[Pixels, NDArray[np.int64]]:
        """The opacities of all pictures with holes in a row, and where each picture begins (-1: it has none)."""
        planes = [np.zeros(0, np.uint8) if t.opaque else t.atlas[..., 3].ravel() for t in self.textures]
        end = np.cumsum([0, *map(len, planes)])
        return np.concatenate(planes), np.array([e if len(p) else -1 for p, e in zip(planes, end, strict=False)])

    def _cutouts(self, boxes: NDArray[np.int64]) -> Cutouts:
        """Of pieces (n,) with holes, where their picture is, and where they show it."""
        place, window = np.full((len(boxes), 2), -1), np.zeros((len(boxes), 10), dtype=np.float32)
        start = self._opacity[1]
        for i in np.flatnonzero((start[self.texture] >= 0) & (boxes[:, :2] < boxes[:, 2:]).all(1)).tolist():
            x0, y0, x1, y1 = boxes[i].tolist()
            texture = self.textures[self.texture[i]]
            level = texture.level(self.detail(i, (x1 - x0, y1 - y0)))
            place[i] = start[self.texture[i]], texture.atlas.shape[1]
            window[i] = *self.uv[i].T.ravel(), *texture.origin[level], *texture.scale[level]
        return Cutouts(place, window, self._opacity[0])

    def look(self, camera: Camera, offset: tuple[float, float] = (0.0, 0.0)) -> tuple[Met, Matrix]:
        shift = np.array([[1.0, 0.0, -offset[0]], [0.0, 1.0, -offset[1]], [0.0, 0.0, 1.0]])
        return self.cast(shift @ camera.P, np.append(camera.R[2], camera.t[2]), camera.size, camera.centre)

    def detail(self, i: int, box: tuple[int, int]) -> float:
        """The pyramid level at which the opacity of a piece is looked up, whose bounding box has these sides."""
        texels = np.abs(self.uv[i, 1:]).max(0) * self.textures[self.texture[i]].size
        return float(np.log2(max(1.0, (texels / np.array(box)).max())))

    def _boxes(self, P: Matrix, size: tuple[int, int], usable: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Pixel bounding boxes (n, 4) as x0, y0, x1, y1 (end excluded) of what lies before the near plane."""
        h, w = size
        X = self.corners @ P[:, :3].T + P[:, 3]
        ahead = X[..., 2] >= NEAR
        with np.errstate(divide="ignore", invalid="ignore"):
            x = X[..., :2] / X[..., 2:]
        boxes = np.zeros((len(X), 4))
        boxes[:, :2], boxes[:, 2:] = x.min(1), x.max(1)
        for i in np.flatnonzero(usable & ahead.any(1) & ~ahead.all(1)):
            points = _clip(X[i])
            boxes[i, :2], boxes[i, 2:] = points.min(0), points.max(0)
        boxes[~ahead.any(1) | ~usable] = 0
        boxes[:, :2] = np.floor(boxes[:, :2])
        boxes[:, 2:] = np.ceil(boxes[:, 2:]) + 1
        return np.clip(np.nan_to_num(boxes), 0, [w, h, w, h]).astype(np.int64)


def _clip(X: Matrix) -> Matrix:
    """The image points (m, 2) of a polygon of homogeneous points (k, 3), cut off at the near plane."""
    kept = []
    for a, b in zip(X, np.roll(X, -1, axis=0), strict=True):
        if a[2] >= NEAR:
            kept.append(a)
        if (a[2] >= NEAR) != (b[2] >= NEAR):
            kept.append(a + (NEAR - a[2]) / (b[2] - a[2]) * (b - a))
    points: Matrix = np.array(kept)
    return points[:, :2] / points[:, 2:]
