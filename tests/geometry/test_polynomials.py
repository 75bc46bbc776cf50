import numpy as np

from fmtorch.geometry.seven_point import cube_root
from fmtorch.jit.kernel import F8x1, kernel


@kernel
def cube_roots(x: F8x1, out: F8x1) -> None:
    for i in range(len(x)):
        out[i] = cube_root(x[i])


def test_cube_roots():
    x = 10.0 ** np.linspace(-300, 300, 10007)
    out = np.empty(len(x))
    cube_roots(x, out)
    np.testing.assert_allclose(out * out * out, x, rtol=8 * np.finfo(float).eps)
    assert [cube_root(number) for number in x[::100].tolist()] == out[::100].tolist()
