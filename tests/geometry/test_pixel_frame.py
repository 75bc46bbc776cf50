"""The frame of the solvers: centred, of about unit scale, and back to pixels."""

from __future__ import annotations

import torch

from fmtorch.geometry.cameras import PixelFrame

GENERATOR = torch.Generator().manual_seed(0)
PIXELS = torch.rand(3, 50, 4, generator=GENERATOR, dtype=torch.float64) * torch.tensor([[[900.0]], [[30.0]], [[4e5]]])


def test_points_reach_from_about_minus_one_to_one_in_units_of_a_power_of_two() -> None:
    frame = PixelFrame.around(PIXELS, torch.ones(3, 50, dtype=torch.bool))
    x = frame.normalized(PIXELS)
    largest = x.abs().amax((1, 2))
    assert bool((largest <= 1).all() & (largest > 0.5).all())
    assert bool((x.amax(1) + x.amin(1)).abs().max() < 1e-12)  # centred in each image
    mantissa, _ = torch.frexp(frame.pixels_per_unit)
    assert bool((mantissa == 0.5).all())
    back = frame.centre[:, None] + frame.pixels_per_unit[:, None, None] * x
    torch.testing.assert_close(back, PIXELS, rtol=0, atol=4e5 * 2**-52)


def test_what_is_masked_does_not_count() -> None:
    mask = torch.arange(60)[None] < 50
    wide = torch.cat([PIXELS, torch.full((3, 10, 4), torch.nan, dtype=torch.float64)], 1)
    padded, plain = PixelFrame.around(wide, mask.expand(3, -1)), PixelFrame.around(PIXELS, mask[:, :50].expand(3, -1))
    assert all(torch.equal(a, b) for a, b in zip(padded, plain, strict=True))


def test_coincident_points_and_none_have_a_unit_of_one_pixel() -> None:
    same = PIXELS[:, :1].expand(-1, 50, -1)
    none = torch.zeros(3, 50, dtype=torch.bool)
    for frame in (
        PixelFrame.around(same, ~none),
        PixelFrame.around(PIXELS, none),
        PixelFrame.around(PIXELS[:, :0], none[:, :0]),
    ):
        assert not bool(frame.spread.any())
        assert frame.pixels_per_unit.tolist() == [1, 1, 1]
        assert bool(frame.centre.isfinite().all())


def test_matrices_follow_the_points() -> None:
    frame = PixelFrame.around(PIXELS, torch.ones(3, 50, dtype=torch.bool))
    F = torch.randn(3, 2, 3, 3, generator=GENERATOR, dtype=torch.float64)
    x = frame.normalized(PIXELS)

    def errors(matrices: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        x0, x1 = (torch.nn.functional.pad(p, (0, 1), value=1.0) for p in points.split(2, -1))
        return torch.einsum("pni,pkij,pnj->pkn", x1, matrices, x0)

    # Cancellation of terms up to (coordinate / unit)^2, which is below 10: a few hundred eps.
    torch.testing.assert_close(errors(frame.to_pixels(F), PIXELS), errors(F, x), rtol=0, atol=1e-12)
    torch.testing.assert_close(frame.from_pixels(frame.to_pixels(F)), F, rtol=0, atol=1e-12)
