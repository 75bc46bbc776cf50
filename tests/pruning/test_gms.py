"""GMS, LPM and CODE equal their definitions."""

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.core import Correspondences
from fmtorch.pruning import CODE, GMS, LPM, LikelihoodField, gms, lpm
from fmtorch.pruning.code import huber_regression, match_domain, predictive_gaussians, spread_centres
from tests.conftest import oracle
from tests.reference import code as code_reference
from tests.reference.lpm import lpm as reference

MODES = [(False, False), (True, False), (False, True), (True, True)]  # (rotation, scale), the oracle's order
SIZE0, SIZE1 = (480, 640), (300, 500)
WIDTHS = {"position": 0.5, "displacement": 0.2, "rotation": 0.8, "scale": 0.5}


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


def moving_along(seed: int, n: int, outliers: float = 0.4) -> tuple[Tensor, Tensor]:
    """Matches that follow a smooth motion; some wrong, some repeated, some that do not move."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform(0, 500, (n, 2))
    x1 = x0 @ np.array([[0.95, 0.2], [-0.2, 0.95]]) + (30, 10) + rng.normal(0, 0.5, (n, 2))
    wrong = rng.random(n) < outliers
    x1[wrong] = rng.uniform(0, 500, (int(wrong.sum()), 2))
    if n > 20:
        x0[5:10], x1[8:12] = x0[0], x1[1]
        x1[15:18] = x0[15:18]
    return torch.from_numpy(x0), torch.from_numpy(x1)


def test_masks_equal_the_original() -> None:
    file = oracle("lpm.npz")
    for i, name in enumerate(file["names"]):
        case = {k[4:]: v for k, v in file.items() if k.startswith(f"{i:03d}.")}
        lambda1, lambda2, K1, K2, tau1, tau2 = case["params"].tolist()
        x0, x1 = torch.from_numpy(case["X"]), torch.from_numpy(case["Y"])
        mask = lpm(x0[None], x1[None], thresholds=(lambda1, lambda2), neighbors=(int(K1), int(K2)), taus=(tau1, tau2))
        np.testing.assert_array_equal(mask[0], case["mask"], str(name))


def test_neighbourhoods_may_be_large() -> None:
    x0, x1 = moving_along(3, 300)
    expected = reference(x0.numpy(), x1.numpy(), (0.8, 0.8), (260, 6), (0.2, 0.2))
    mask = lpm(x0[None], x1[None], neighbors=(260, 6), thresholds=(0.8, 0.8))
    assert 0 < expected.sum() < 300
    np.testing.assert_array_equal(mask[0], expected)


def test_stage_and_bad_input() -> None:
    x0, x1 = (x[None].float() for x in moving_along(3, 200))
    x0[0, 7, 0] = torch.nan
    mask = torch.arange(200)[None] % 3 != 0
    kept = LPM(neighbors=[5, 6])(Correspondences(x0, x1, mask)).mask
    assert torch.equal(kept, lpm(x0, x1, mask=mask, neighbors=(5, 6)))
    assert not kept[0, 7]
    with pytest.raises(ValueError, match="at least 4"):
        lpm(x0, x1, neighbors=(3, 6))


def frames(x: np.ndarray, S: np.ndarray) -> np.ndarray:
    return np.concatenate([S, x[:, :, None]], 2)


def turn(angle: np.ndarray, scale: np.ndarray) -> np.ndarray:
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def warped(seed: int, n: int, outliers: float, noise: float = 0.5) -> tuple[Correspondences, Tensor]:
    """Matches that follow a turn by 0.6, a zoom by 1.3 and a bend; outliers anywhere. And which are right."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform(0, 800, (n, 2))
    A = turn(np.array(0.6), np.array(1.3))
    bend = 4e-4 * np.stack([np.square(x0[:, 1] - 400), (x0[:, 0] - 400) * (x0[:, 1] - 400)], 1)
    x1 = x0 @ A.T + bend + (100, -50) + rng.normal(0, noise, (n, 2))
    J = np.zeros((n, 2, 2))
    J[:, 0, 1], J[:, 1, 0], J[:, 1, 1] = 8e-4 * (x0[:, 1] - 400), 4e-4 * (x0[:, 1] - 400), 4e-4 * (x0[:, 0] - 400)
    S0 = turn(rng.uniform(-np.pi, np.pi, n), rng.uniform(10, 40, n))
    S1 = turn(rng.normal(0, 0.1, n), np.exp(rng.normal(0, 0.1, n))) @ (A + J) @ S0
    wrong = rng.random(n) < outliers
    x1[wrong] = rng.uniform(x1.min(0), x1.max(0), (int(wrong.sum()), 2))
    S1[wrong] = turn(rng.uniform(-np.pi, np.pi, n), rng.uniform(10, 40, n))[wrong]
    ratio = np.where(wrong, rng.uniform(0.7, 1, n), rng.uniform(0.4, 1, n))

    def tensor(value: np.ndarray) -> Tensor:
        return torch.from_numpy(value.astype(np.float32))[None]

    c = Correspondences(
        tensor(x0), tensor(x1), torch.ones(1, n, dtype=torch.bool), ratio=tensor(ratio),
        lafs0=tensor(frames(x0, S0)), lafs1=tensor(frames(x1, S1)),
    )  # fmt: skip
    return c, torch.from_numpy(~wrong)


def run_code(c: Correspondences) -> Tensor:
    return CODE(odds=1.0, floor=1.0, reach=1.0)(c).mask[0]


def domain_of(c: Correspondences) -> tuple:
    x0, x1, lafs0, lafs1 = (v[0].double().numpy() for v in (c.x0, c.x1, c.lafs0, c.lafs1))
    (p0, s0), (p1, s1) = code_reference.normalised(x0), code_reference.normalised(x1)
    S = [b[:, :2] @ np.linalg.inv(a[:, :2]) * s0 / s1 for a, b in zip(lafs0, lafs1, strict=True)]
    return match_domain(c.x0[0], c.x1[0], c.lafs0[0], c.lafs1[0]), list(zip(p0, p1, S, strict=True))


def test_likelihood_equals_the_definition() -> None:
    ours, theirs = domain_of(warped(3, 70, 0.4)[0])
    field = LikelihoodField(centres=15, ridge=0.005, huber=0.1, iterations=300, **WIDTHS)
    expected = code_reference.likelihood(theirs, WIDTHS, 15, 0.005, 0.1)
    # float32 normal equations: 1e-5 (the kernel) times their condition, at most 1 / ridge = 200.
    np.testing.assert_allclose(field(ours, None), expected, atol=2e-3)


@pytest.mark.parametrize("frames", [True, False])
@pytest.mark.parametrize("outliers", [0.0, 0.5, 0.8])
def test_keeps_a_smooth_motion_and_drops_scattered_matches(outliers: float, frames: bool) -> None:
    c, right = warped(5, 2000, outliers)
    if not frames:  # displacements then vary with the place only as far as the motion differs from a translation
        c = c.replace(x1=c.x1 @ torch.linalg.inv(torch.from_numpy(turn(np.array(0.6), np.array(1.3))).float()).T)
        c = c.replace(lafs0=None, lafs1=None)
    kept = run_code(c)
    # Outliers spread over a square of side sqrt(12): a disc of radius 0.06 (the largest residual) holds 0.1% of them;
    # twice the radius for where the motion is uncertain, and three standard deviations.
    count = int((~right).sum())
    assert int((kept & ~right).sum()) <= 0.004 * count + 3 * (0.004 * count) ** 0.5
    if frames or outliers < 0.8:
        assert int((kept & right).sum()) > 0.9 * int(right.sum())


def test_matches_that_are_none_are_dropped() -> None:
    c, _ = warped(11, 400, 0.2)
    x0, lafs1 = c.x0.clone(), c.lafs1.clone()
    x0[0, 3, 1], lafs1[0, 5, 0, 0], lafs1[0, 7, :, :2] = torch.nan, torch.inf, 0.0
    kept = run_code(c.replace(x0=x0, lafs1=lafs1))
    assert not kept[[3, 5, 7]].any()
    sound = torch.ones(400, dtype=torch.bool)
    sound[[3, 5, 7]] = False
    assert torch.equal(kept, run_code(c.replace(mask=sound[None])))


def test_gaussians_equal_the_definition() -> None:
    ours, theirs = domain_of(warped(0, 40, 0.3)[0])
    computed = predictive_gaussians(ours, ours.take(torch.arange(0, 40, 3)), **WIDTHS)
    expected = [[code_reference.predictive_gaussian(a, b, WIDTHS) for b in theirs[::3]] for a in theirs]
    # Exponents are differences of float32 terms up to about 100: 100 * 2^-23 = 1e-5.
    np.testing.assert_allclose(computed, expected, atol=1e-4)


def test_centres_equal_the_definition_and_go_where_matches_crowd() -> None:
    c, right = warped(1, 60, 0.5)
    ours, _ = domain_of(c)
    gaussians = predictive_gaussians(ours, ours, **WIDTHS).double()
    chosen = spread_centres(gaussians, 12).tolist()
    assert chosen == code_reference.spread_centres(gaussians.numpy(), 12)
    assert right[chosen[:6]].all()


@pytest.mark.parametrize("columns", [1, 2])
def test_regression_finds_the_minimum(columns: int) -> None:
    rng = np.random.default_rng(2)
    basis = rng.normal(size=(60, 5))
    target = basis @ rng.normal(size=(5, columns)) + 0.05 * rng.normal(size=(60, columns))
    target[::4] += rng.normal(size=(15, columns)) * 5
    ridge = np.diag(rng.uniform(0.1, 2, 5))
    expected = code_reference.huber_regression(basis, target, ridge, 0.1)
    fitted = huber_regression(*(torch.from_numpy(v) for v in (basis, target, ridge)), scale=0.1, iterations=200)
    np.testing.assert_allclose(fitted, expected, atol=1e-4)  # where the optimiser stops: its gradient is below 1e-5
