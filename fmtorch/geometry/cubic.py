"""Real roots of batched cubics in closed form, without transcendental functions, polished by Newton's method."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import sqrt

_NEGLIGIBLE = 1e-60  # relative to the largest coefficient: counts as zero, so that no power over- or underflows
_SEPARATION = 1e-4  # relative to the outermost root: the others are found as those of the quadratic that remains
_POLISHING_STEPS = 2  # the closed form is good to 1e-8, the quadratic to 1e-4, and Newton's method squares that
_GRADIENT_FLOOR = 1e-7  # relative slope below which the gradient of a (double) root is held finite


def cubic_roots(
    coefficients: Float[Tensor, " 4 *s"],
) -> tuple[Float[Tensor, " 3 *s"], Bool[Tensor, " 3 *s"]]:
    """The real roots of c[0] z^3 + c[1] z^2 + c[2] z + c[3], and which of the three slots hold one.

    Three real roots by Viete's substitution (its extreme root by Newton's method instead of a cosine), one by
    Cardano's formula; both are arranged against cancellation. Leading coefficients may vanish (a quadratic, a line);
    multiple roots fill as many slots. Slots without a root are zero; a polynomial that is zero or not finite has none.
    Differentiable by the implicit function theorem, with a finite gradient at multiple roots. Best in float64.
    """
    scale = coefficients.detach().abs().amax(0)
    scalable = scale.isfinite() & (scale > 0)
    c = torch.where(scalable, coefficients, 1.0) / torch.where(scalable, scale, 1.0)
    c = torch.where(c.abs() < _NEGLIGIBLE, 0.0, c)
    with torch.no_grad():
        roots, valid = _closed_form(*c.detach())
        valid = valid & scalable
        roots = torch.where(valid, roots, 0.0)
        for _ in range(_POLISHING_STEPS):
            f, slope = _evaluate(c, roots)
            better = roots - f / torch.where(slope == 0, 1.0, slope)
            improved = _evaluate(c, better)[0].abs() < f.abs()
            roots = torch.where(improved, better, roots)
        roots = torch.where(valid, roots, 0.0)
    if c.requires_grad:
        f, slope = _evaluate(c, roots)
        slope = slope.detach()
        floor = _GRADIENT_FLOOR * (1 + roots * roots)
        step = (f - f.detach()) * (slope / (slope * slope + floor * floor))
        roots = torch.where(valid, roots - step, 0.0)
    return roots, valid


def _evaluate(c: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """The polynomial and its derivative at z."""
    f = ((c[0] * z + c[1]) * z + c[2]) * z + c[3]
    slope = (3 * c[0] * z + 2 * c[1]) * z + c[2]
    return f, slope


def _closed_form(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Roots to about ten digits, of coefficients whose largest is one."""
    # One root far outside the other two would swamp them in the shift by b / 3a.
    apart = ((a * c).abs() <= _SEPARATION * b * b) & (a * a * d.abs() <= _SEPARATION**2 * b.abs() ** 3)
    apart = (a == 0) | (apart & (b != 0))
    roots, valid = _depressed(torch.where(apart, 1.0, a), b, c, d)
    quadratic, quadratic_valid = _quadratic(b, c, d)
    outer = torch.where(a == 0, 0.0, -b / torch.where(a == 0, 1.0, a))
    roots = torch.where(apart, torch.cat([quadratic, outer[None]]), roots)
    valid = torch.where(apart, torch.cat([quadratic_valid, (a != 0)[None]]), valid)
    return roots, valid


def _depressed(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Roots through t^3 + 3 P t + 2 Q = 0 with z = t - b / 3a."""
    shift = b / (3 * a)
    P = c / (3 * a) - shift * shift
    Q = shift * shift * shift - shift * c / (2 * a) + d / (2 * a)
    discriminant = Q * Q + P * P * P
    three = discriminant <= 0
    sign = torch.where(Q < 0, 1.0, -1.0).to(a.dtype)
    # Three real roots: t = m y, y^3 - 3 y = 2 r with r in [0, 1] and the extreme root y in [sqrt 3, 2].
    m = sqrt(torch.where(three, -P, 1.0).clamp_min(0))
    m3 = m * m * m
    r = torch.where(m3 > 0, Q.abs() / torch.where(m3 > 0, m3, 1.0), 0.0).clamp_max(1.0)
    y = torch.full_like(r, 2.0)
    for _ in range(5):  # quadratic from an error of at most 0.27
        y = (2 * y * y * y + 2 * r) / (3 * (y * y - 1))
    y1 = -(y + sqrt(3 * (2 - y).clamp_min(0) * (2 + y))) / 2
    t3 = torch.stack([y, y1, 2 * r / (y * y1)]) * (sign * m)
    # One real root: u^3 = -Q -+ sqrt(D), without cancellation.
    root = sqrt(torch.where(three, 0.0, discriminant))
    u = cube_root(torch.where(three, 1.0, Q.abs() + root))
    v = P / u
    t1 = torch.where(P < 0, u - v, 2 * Q.abs() / (u * u + P + v * v)) * sign
    t = torch.where(three, t3, t1)
    valid = torch.stack([torch.ones_like(three), three, three])
    return t - shift, valid


def _quadratic(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Roots of a z^2 + b z + c, of which a, or a and b, may be zero."""
    discriminant = b * b - 4 * a * c
    real = discriminant >= 0
    w = -(b + torch.copysign(sqrt(torch.where(real, discriminant, 0.0)), b)) / 2
    near = torch.where(w == 0, 0.0, c / torch.where(w == 0, 1.0, w))
    far = torch.where(a == 0, 0.0, w / torch.where(a == 0, 1.0, a))
    return torch.stack([near, far]), torch.stack([real & ((w != 0) | (a != 0)), real & (a != 0)])


def cube_root(x: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """The real cube root of positive numbers, to the last digits: Halley's method from a third of the exponent.

    `x ** (1 / 3)` would be right too, but its last bit depends on where in memory x stands.
    """
    # A third of the bits of x is a cube root to 6 %; the constant makes up for two thirds of the exponent's bias.
    y = (torch.div(x.to(torch.float64).view(torch.int64), 3, rounding_mode="floor") + 0x2A9F7893782DA1CE).view(
        torch.float64
    )
    for _ in range(3):  # cubic convergence: 6e-2, 1e-4, 1e-12, 1e-36
        y3 = y * y * y
        y = y * ((y3 + 2 * x) / (2 * y3 + x))
    return y.to(x.dtype)
