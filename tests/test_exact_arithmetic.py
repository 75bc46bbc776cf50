"""Values are made of operations that every processor rounds alike; the others are refused by their names.

A function of the C library or a vector library (exp, log, pow) is right to some ulps, which differ between versions and
processors; a sum differs where BLAS or LAPACK chooses its order. `fmtorch.geometry.arithmetic` and `arithmetic_kernels`
stand for them."""

import ast
from collections.abc import Iterable

import pytest

from tests.test_imports import FILES, PACKAGE, last_name, libraries, nodes

DECORATORS = {"kernel", "inner", "njit", "jit"}
INEXACT = {
    "acos", "acosh", "arccos", "arccosh", "arcsin", "arcsinh", "arctan", "arctan2", "arctanh", "asin", "asinh", "atan",
    "atan2", "atanh", "cbrt", "cos", "cosh", "erf", "erfc", "exp", "exp2", "expm1", "float_power", "gamma", "hypot",
    "lgamma", "log", "log10", "log1p", "log2", "logaddexp", "pow", "power", "sin", "sinh", "tan", "tanh",
}  # fmt: skip
"""Functions of math and NumPy that are right to some ulps."""
SUMS = {"convolve", "correlate", "dot", "einsum", "inner", "matmul", "norm", "tensordot", "vdot"}
"""Of NumPy, and methods of arrays: in the order that a library chooses."""
PEERS = "estimators/external/"  # others' estimators
ROOMS = ("estimators", "geometry", "matching", "metrics", "pruning")
NETWORKS = ("pruning/networks/", "pruning/code.py")  # values that agree to rounding only, docs/concepts/conventions.md


NAMES = {module: path.relative_to(PACKAGE).as_posix() for module, path in FILES.items()}
REFUSED = (
    "from math import log;math.exp(x);np.log1p(x);np.einsum('ij,j', x, y);np.linalg.norm(x);"
    "x @ y;x.dot(y);x**y;x**3;2.5**x;pow(x, y)"
)
TAKEN = "math.sqrt(x);x * y + np.abs(z);x**2;2**0.5;2.0**x;np.square(x);math.frexp(x)"


def kernels(file: Iterable[ast.AST]) -> list[ast.FunctionDef]:
    """The functions that are decorated as kernels, or as ones for kernels to call."""
    functions = [node for node in file if isinstance(node, ast.FunctionDef)]
    return [f for f in functions if any(last_name(decorator) in DECORATORS for decorator in f.decorator_list)]


def inexact(part: Iterable[ast.AST]) -> list[tuple[int, str]]:
    """The lines and names of what processors round differently."""
    modules = {"math", "np", "numpy", "linalg", "fft"}
    operations = []
    for node in part:
        if isinstance(node, ast.Attribute):
            of_library = isinstance(node.value, ast.Name | ast.Attribute) and last_name(node.value) in modules
            if (of_library and node.attr in INEXACT | SUMS | {"linalg", "fft"}) or node.attr in ("dot", "matmul"):
                operations.append((node.lineno, node.attr))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in modules:
            names = (alias.name for alias in node.names)
            operations += [(node.lineno, name) for name in names if name in INEXACT | SUMS | {"linalg"}]
        elif isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
            operations.append((node.lineno, "@"))
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow) and not exact_power(node):
            operations.append((node.lineno, "**"))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "pow":
            operations.append((node.lineno, "pow"))
    return operations


def exact_power(node: ast.BinOp) -> bool:
    """A square, a power of two, or one of two constants, which Python computes when it reads the file."""
    base, exponent = node.left, node.right
    of_base, of_exponent = (part.value if isinstance(part, ast.Constant) else None for part in (base, exponent))
    return of_base == 2 or of_exponent == 2 or None not in (of_base, of_exponent)


def roots(file: Iterable[ast.AST]) -> list[int]:
    """The lines of `torch.sqrt`, ``x.sqrt()`` and ``x.norm()`` of tensors."""
    return [
        node.lineno
        for node in file
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        and node.func.attr in ("sqrt", "sqrt_", "norm", "hypot", "cdist")
        and not (isinstance(node.func.value, ast.Name) and node.func.value.id in ("math", "np"))
    ]  # fmt: skip


def test_kernels_and_what_calls_them_take_exact_operations() -> None:
    violations = []
    for module, name in NAMES.items():
        file = nodes(FILES[module])
        whole = name.startswith("estimators/") and not ("torch" in libraries(module) or PEERS in name)
        for part in [file] if whole else map(ast.walk, kernels(file)):
            violations += [f"{name}:{line}: {what}" for line, what in inexact(part)]
    assert not violations, "see fmtorch/geometry/arithmetic.py"


def test_tensors_of_values_take_the_exact_root() -> None:
    others = (*NETWORKS, PEERS, "geometry/arithmetic.py")
    held = ((m, name) for m, name in NAMES.items() if name.startswith(ROOMS) and not name.startswith(others))
    violations = [f"{name}:{line}" for module, name in held for line in roots(nodes(FILES[module]))]
    assert not violations, "take fmtorch.geometry.arithmetic.sqrt"


def test_what_is_refused() -> None:
    for lines, refused in ((REFUSED, True), (TAKEN, False)):
        for line in lines.split(";"):
            assert bool(inexact(ast.walk(ast.parse(line)))) == refused, line


@pytest.mark.parametrize("line", ["@kernel('f8')", "@inner", "@inner(inline=True)", "@numba.njit"])
def test_kernels_are_found_by_their_decorators(line: str) -> None:
    assert kernels(ast.parse(f"{line}\ndef f(x): ...").body)
    assert not kernels(ast.parse("@functools.cache\ndef f(x): ...").body)
