import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.core import Correspondences
from fmtorch.pruning import GMS, gms
from tests.conftest import oracle
from tests.reference.gms import gms as reference

MODES = [(False, False), (True, False), (False, True), (True, True)]  # (rotation, scale), the oracle's order
SIZE0, SIZE1 = (480, 640), (300, 500)


def moving(seed: int, n: int, angle: float = 0.0, scale: float = 1.0, outliers: float = 0.3) -> tuple[Tensor, Tensor]:
    """Matches that turn and grow about the image centres, some of them wrong, some on and beyond the borders."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform((-8, -8), (SIZE0[1] + 8, SIZE0[0] + 8), (n, 2))
    R = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    unit = (x0 / (SIZE0[1], SIZE0[0]) - 0.5) @ R.T + 0.5
    wrong = rng.random(n) < outliers
    unit[wrong] = rng.random((int(wrong.sum()), 2))
    x0[: n // 20] = np.round(x0[: n // 20] / 16) * 16  # on edges of cells
    return torch.from_numpy(x0).float(), torch.from_numpy(unit * (SIZE1[1], SIZE1[0])).float()


def run(x0: Tensor, x1: Tensor, mask: Tensor | None = None, **options: object) -> Tensor:
    b = len(x0)
    return gms(x0, x1, size0=torch.tensor([SIZE0] * b), size1=torch.tensor([SIZE1] * b), mask=mask, **options)  # type: ignore[arg-type]


def stored_cases() -> list[tuple[str, Tensor, Tensor, Tensor, Tensor, dict[str, np.ndarray]]]:
    file = oracle("gms.npz")
    cases = []
    for i, name in enumerate(file["names"]):
        case = {k[4:]: v for k, v in file.items() if k.startswith(f"{i:03d}.")}
        index0, index1 = case["matches"].T
        x0, x1 = (torch.from_numpy(case[k][index])[None] for k, index in (("xy1", index0), ("xy2", index1)))
        size0, size1 = (torch.from_numpy(case[k])[None] for k in ("imsize1", "imsize2"))
        cases.append((str(name), x0, x1, size0, size1, case))
    return cases


def test_masks_equal_the_originals() -> None:
    for name, x0, x1, size0, size1, case in stored_cases():
        for border in ("opencv", "authors"):
            for factor in (4, 6):
                for row, (rotation, scale) in enumerate(MODES):
                    mask = gms(
                        x0, x1, size0=size0, size1=size1, with_rotation=rotation, with_scale=scale,
                        threshold_factor=float(factor), border=border,
                    )  # fmt: skip
                    expected = case[f"mask_{border}_tf{factor}"][row]
                    np.testing.assert_array_equal(mask[0], expected, f"{name}, {border}, {factor}, row {row}")


@pytest.mark.parametrize(("rotation", "scale"), MODES)
@pytest.mark.parametrize("border", ["opencv", "authors"])
def test_equals_the_definition(rotation: bool, scale: bool, border: str) -> None:
    cases = [(0, 0, 1, 4.0), (1, 0, 1, 1.0), (150, 0, 1, 2.0), (200, 0.8, 1, 2.0), (200, 3.1, 0.5, 3.0)]
    for seed, (n, angle, growth, factor) in enumerate(cases):
        x0, x1 = moving(seed, n, angle, growth)
        mask = run(x0[None], x1[None], with_rotation=rotation, with_scale=scale, threshold_factor=factor, border=border)
        expected = reference(x0.numpy(), x1.numpy(), SIZE0, SIZE1, rotation, scale, factor, authors=border == "authors")
        np.testing.assert_array_equal(mask[0], expected)


def test_many_matches_in_one_cell() -> None:
    # More matches in a cell than 16 bits can count; a lone cell scores as much as it is filled.
    x0 = 5 + torch.rand(1, 50_000, 2, generator=torch.Generator().manual_seed(0))
    assert run(x0, x0.clone(), with_scale=True, with_rotation=True).all()


def test_points_that_are_not_finite_or_outside_are_dropped() -> None:
    x0 = torch.full((1, 200, 2), 100.0)
    x1 = x0.clone()
    x0[0, 0], x1[0, 1], x0[0, 2, 0], x1[0, 3, 1] = torch.nan, torch.inf, -1.0, float(SIZE1[0])
    assert run(x0, x1)[0].tolist() == [False] * 4 + [True] * 196


def test_stage_needs_sizes() -> None:
    x0, x1 = (x[None] for x in moving(0, 300))
    mask = torch.arange(300)[None] % 5 != 0
    size0, size1 = torch.tensor([SIZE0]), torch.tensor([SIZE1])
    c = Correspondences(x0, x1, mask, size0=size0, size1=size1)
    expected = gms(x0, x1, size0=size0, size1=size1, mask=mask, threshold_factor=4.0, with_scale=True)
    assert torch.equal(GMS(threshold_factor=4.0, with_scale=True)(c).mask, expected)
    with pytest.raises(ValueError, match="size0"):
        GMS()(Correspondences(x0, x1, mask))


def test_sizes_that_are_width_and_height_are_refused() -> None:
    x0, x1 = (x[None].clamp(0, 299) for x in moving(3, 200))
    x0[0, :40, 0] += 300
    with pytest.raises(ValueError, match=r"size0 is \(640, 480\), but .* it looks like \(w, h\)"):
        gms(x0, x1, size0=torch.tensor([SIZE0[::-1]]), size1=torch.tensor([SIZE1]))
