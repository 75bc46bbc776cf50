"""What a scene is made of: textured parallelograms and triangles, and the shapes built from them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fmtorch.scenes.textures import Pixels, Real, Texture

Vector = NDArray[np.float64]


def vec(*v: Real) -> Vector:
    """A float64 vector."""
    return np.array(v, dtype=np.float64)


_FLAT = np.full(9, np.nan)  # stands for the normals of a flat piece until they are computed for all at once


class Surfaces:
    """A growing list of flat pieces: a corner O and edges U, V; their points are ``O + s U + t V``.

    s and t are in [0, 1]; in a triangle also s + t <= 1.
    Texture coordinates and normals are affine in (s, t), so that curved shapes can be shaded smoothly. The outside of a
    piece is where ``V x U`` points: seen from there, U goes right and V down, as in the picture on it.
    """

    def __init__(self) -> None:
        self.textures: list[Texture] = []
        self._rows: list[NDArray[np.float64]] = []
        self._texture: list[int] = []
        self._flags: list[tuple[bool, bool]] = []

    def texture(self, picture: Pixels) -> int:
        """Adds a picture and returns its number."""
        self.textures.append(Texture(picture))
        return len(self.textures) - 1

    def __len__(self) -> int:
        return len(self._rows)

    def piece(
        self, corner: Vector, U: Vector, V: Vector, texture: int, uv: NDArray[np.float64],
        *, triangle: bool = False, normals: NDArray[np.float64] | None = None, both_sides: bool = False,
    ) -> None:  # fmt: skip
        """One piece; `uv` (3, 2) and `normals` (3, 3): values at the corner and their change along U and along V."""
        flat = _FLAT if normals is None else normals.ravel()
        self._rows.append(np.concatenate([corner, U, V, uv.ravel(), flat]))
        self._texture.append(texture)
        self._flags.append((triangle, both_sides))

    def quad(
        self, corner: Vector, U: Vector, V: Vector, texture: int, window: Sequence[Real] = (0.0, 0.0, 1.0, 1.0),
        *, both_sides: bool = False,
    ) -> None:  # fmt: skip
        """A parallelogram that shows the part (u0, v0, u1, v1) of a texture."""
        u0, v0, u1, v1 = window
        self.piece(corner, U, V, texture, np.array([[u0, v0], [u1 - u0, 0.0], [0.0, v1 - v0]]), both_sides=both_sides)

    def box(
        self, base: Vector, right: Vector, back: Vector, height: Real, textures: Sequence[int],
        windows: Sequence[Sequence[Real]] = ((0.0, 0.0, 1.0, 1.0),) * 5,
    ) -> None:  # fmt: skip
        """An upright box on its lower front left corner; textures of front, right, back, left side and top."""
        up = vec(0.0, 0.0, height)
        corners = [base, base + right, base + right + back, base + back]
        for i in range(4):
            a, b = corners[i], corners[(i + 1) % 4]
            self.quad(a + up, b - a, -up, textures[i], windows[i])
        self.quad(base + back + up, right, -back, textures[4], windows[4])

    def grid(self, points: NDArray[np.float64], texture: int, repeat: tuple[Real, Real] = (1.0, 1.0)) -> None:
        """A smooth surface through a grid of points (m, n, 3), rows from top to bottom seen from outside."""
        m, n = points.shape[:2]
        du = np.gradient(points, axis=1)
        if np.allclose(points[:, 0], points[:, -1]):
            du[:, 0] = du[:, -1] = (points[:, 1] - points[:, -2]) / 2
        normal = np.cross(np.gradient(points, axis=0), du)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        v, u = np.meshgrid(np.linspace(0, repeat[1], m), np.linspace(0, repeat[0], n), indexing="ij")
        uv = np.stack([u, v], -1)
        for i in range(m - 1):
            for j in range(n - 1):
                for (a, b), step in (((i, j), 1), ((i + 1, j + 1), -1)):
                    corner, along, down = (a, b), (a, b + step), (a + step, b)
                    U, V = points[along] - points[corner], points[down] - points[corner]
                    if np.linalg.norm(np.cross(U, V)) < 1e-9:
                        continue
                    tex = np.stack([uv[corner], uv[along] - uv[corner], uv[down] - uv[corner]])
                    nor = np.stack([normal[corner], normal[along] - normal[corner], normal[down] - normal[corner]])
                    self.piece(points[corner], U, V, texture, tex, triangle=True, normals=nor)

    def lathe(
        self, base: Vector, profile: Sequence[tuple[Real, Real]], texture: int, sides: int = 12,
        repeat: tuple[Real, Real] = (1.0, 1.0), bumps: NDArray[np.float64] | None = None,
    ) -> None:  # fmt: skip
        """A turned shape: (height, radius) from bottom to top round the upright axis; `bumps` scale the radius."""
        steps = np.array(profile[::-1], dtype=np.float64)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.stack([np.cos(angle), np.sin(angle)], -1)
        ring[-1] = ring[0]
        radius = np.repeat(steps[:, 1:2], sides + 1, axis=1)
        if bumps is not None:
            radius = radius * (1 + np.concatenate([bumps, bumps[:, :1]], axis=1))
        points = np.zeros((len(steps), sides + 1, 3))
        points[..., :2] = ring[None] * radius[..., None]
        points[..., 2] = steps[:, :1]
        self.grid(points + base, texture, repeat)

    def copy(self) -> Surfaces:
        """A list of its own with the same pieces and textures, to which more can be added."""
        other = Surfaces()
        other.textures, other._rows = list(self.textures), list(self._rows)
        other._texture, other._flags = list(self._texture), list(self._flags)
        return other

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All pieces as arrays: O, U, V (n, 3), uv (n, 3, 2), normals (n, 3, 3)."""
        rows = np.array(self._rows).reshape(-1, 24)
        flat = np.isnan(rows[:, 15])
        normal = np.cross(rows[flat, 6:9], rows[flat, 3:6])
        rows[flat, 15:] = 0
        rows[flat, 15:18] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return {
            "O": rows[:, 0:3], "U": rows[:, 3:6], "V": rows[:, 6:9],
            "uv": rows[:, 9:15].reshape(-1, 3, 2), "normals": rows[:, 15:24].reshape(-1, 3, 3),
        }  # fmt: skip

    def labels(self) -> tuple[NDArray[np.int32], NDArray[np.bool_], NDArray[np.bool_]]:
        """Per piece: number of its texture, whether it is a triangle, whether it is seen from both sides."""
        triangle, both_sides = np.array(self._flags, dtype=bool).reshape(-1, 2).T.copy()
        return np.array(self._texture, dtype=np.int32), triangle, both_sides
