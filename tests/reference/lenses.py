"""Lens models as COLMAP's documentation writes them, one point at a time."""

from math import atan, hypot, sqrt, tan


def distort(model: str, u: float, v: float, c: list[float]) -> tuple[float, float]:
    """Where a lens with coefficients c puts the normalised point (u, v)."""
    r = hypot(u, v)
    theta = atan(r)
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return u, v
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        k1, k2 = (*c, 0.0)[:2]
        s = 1 + k1 * r**2 + k2 * r**4
        return u * s, v * s
    if model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2, k3, k4, k5, k6 = (*c, 0.0, 0.0, 0.0, 0.0)[:8]
        s = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
        return (u * s + 2 * p1 * u * v + p2 * (r**2 + 2 * u**2), v * s + 2 * p2 * u * v + p1 * (r**2 + 2 * v**2))
    if model == "FOV":
        s = atan(2 * r * tan(c[0] / 2)) / (r * c[0])
        return u * s, v * s
    if model in ("SIMPLE_DIVISION", "DIVISION"):
        s = 2 / (1 + sqrt(1 - 4 * c[0] * r**2))
        return u * s, v * s
    if model == "EUCM":
        alpha, beta = c
        s = 1 / (alpha * sqrt(beta * r**2 + 1) + 1 - alpha)
        return u * s, v * s
    u, v = u * theta / r, v * theta / r  # the fish-eyes
    if model in ("SIMPLE_FISHEYE", "FISHEYE"):
        return u, v
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, sx1, sy1 = c
        s = k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8
        return (
            u + u * s + 2 * p1 * u * v + p2 * (theta**2 + 2 * u**2) + sx1 * theta**2,
            v + v * s + 2 * p2 * u * v + p1 * (theta**2 + 2 * v**2) + sy1 * theta**2,
        )
    radial = c[:6] if model == "RAD_TAN_THIN_PRISM_FISHEYE" else c
    s = 1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(radial))
    u, v = u * s, v * s
    if model != "RAD_TAN_THIN_PRISM_FISHEYE":
        return u, v
    p0, p1, s0, s1, s2, s3 = c[6:]
    q = u**2 + v**2
    return (
        u + (2 * u**2 + q) * p0 + 2 * u * v * p1 + s0 * q + s1 * q**2,
        v + (2 * v**2 + q) * p1 + 2 * u * v * p0 + s2 * q + s3 * q**2,
    )
