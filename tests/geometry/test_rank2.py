import numpy as np
import pytest
import torch

from fmtorch.geometry import nearest_rank2
from tests.reference import solvers as reference

EPS = torch.finfo(torch.float64).eps


def random_matrices(batch, singular_values=None, seed=0):
    F = torch.randn(*batch, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    if singular_values is None:
        return F
    U, _, Vt = torch.linalg.svd(F)
    return U @ torch.diag(torch.tensor(singular_values, dtype=torch.float64)) @ Vt


@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (500,)])
def test_equals_the_svd(batch):
    F = random_matrices(batch)
    P = nearest_rank2(F)
    for i in np.ndindex(batch):
        S = np.linalg.svd(F[i].numpy())[1]
        # The last singular vector of a matrix known to eps |F| is known to eps |F| / gap.
        np.testing.assert_allclose(P[i], reference.rank2(F[i].numpy()), atol=32 * EPS * S[0] ** 2 / (S[1] - S[2]))


@pytest.mark.parametrize(
    "s",
    [(1, 1, 1), (1, 0.5, 0.5), (1, 1, 0.5), (1, 0.5, 0.5 - 1e-9), (1, 1e-3, 1e-6), (1, 1e-6, 1e-9), (1, 1e-10, 1e-12),
     (1, 1e-14, 0), (1, 1e-15, 1e-15), (1, 0, 0), (0, 0, 0), (1e-200, 1e-201, 1e-202), (1e100, 1e99, 1e98)],
)  # fmt: skip
def test_nearest_even_where_the_singular_vector_is_not_unique(s):
    F = random_matrices((200,), s)
    P = nearest_rank2(F)
    distance = torch.linalg.matrix_norm((P - F) / max(s[0], 1e-300)) * max(s[0], 1e-300)
    # Between singular values closer than sqrt(eps) the vector may lie anywhere: no farther than the second one.
    second = s[1] if abs(s[1] - s[2]) < EPS**0.5 * s[1] else s[2]
    assert (distance <= second + 16 * EPS * s[0]).all()
    assert (torch.linalg.svdvals(P)[:, 2] <= 16 * EPS * s[0]).all()


def test_float32_is_the_rounded_float64():
    F = random_matrices((50,)).float()
    assert torch.equal(nearest_rank2(F), nearest_rank2(F.double()).float())


def test_gradient():
    assert torch.autograd.gradcheck(nearest_rank2, (random_matrices((2, 3)).requires_grad_(),))


@pytest.mark.parametrize("s", [(1, 1, 1), (1, 0.5, 0.5), (1, 0.5, 0.5 - 1e-9), (1, 0, 0), (0, 0, 0)])
def test_gradient_stays_bounded(s):
    F = random_matrices((50,), s).requires_grad_()
    target = random_matrices((50,), seed=1)
    (nearest_rank2(F) * target).sum().backward()
    # |d(F v v^T)| <= |dF| + 2 s3 |dv|;
    # |dv| <= 2 s1 |dF| max gap / (gap^2 + eps^2) = s1 |dF| / eps; eps = 1e-6 s1^2.
    assert F.grad.isfinite().all()
    assert F.grad.norm(dim=(1, 2)).max() <= (1 + 2e6) * target.norm(dim=(1, 2)).max()
