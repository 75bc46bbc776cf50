"""Do two checkouts compute the same estimates, to the bit? Run on one machine, before and after a change.

    python scripts/compare_estimates.py BEFORE [AFTER] [--presets ransac fmtorch]

Estimator presets run on the same pairs in a process of each checkout (AFTER: this one). Compared are models,
inliers, ok, reasons, samples, models before the final fit, and gradients, besides public functions of
`fmtorch.geometry`. Exit status 1 where anything differs.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

HERE = Path(__file__).resolve().parents[1]
OWN = ("Ransac", "IterativelyReweighted", "CoarseToFine")
FIELDS = ("x0", "x1", "mask", "ratio", "prior", "noise", "size0", "size1", "key", "lafs0", "lafs1")


def inputs() -> dict[str, dict[str, torch.Tensor]]:
    """Batches of pairs as plain tensors, by name, so that both checkouts read the same."""
    sys.path.insert(0, str(HERE))
    from fmtorch.core.types import collate
    from tests.laws import degenerate, scene, small

    scenes = collate([scene(i, n) for i, n in enumerate((150, 40, 333))])
    hard = collate([scene(20 + i, 260, outliers=0.7, noise=0.6) for i in range(2)])
    noise = np.random.default_rng(0).lognormal(0, 0.5, tuple(scenes.mask.shape)).astype(np.float32)
    batches = {
        "scenes": scenes.replace(noise=torch.from_numpy(noise)),
        "no prior, no sizes": scenes.replace(prior=None, size0=None, size1=None),
        "two sizes": hard.replace(size1=torch.tensor([[700, 900]]).expand(len(hard), 2)),
        "degenerate": collate([*degenerate().values(), *small().values()][::4]),
    }
    return {name: {f: v.clone() for f in FIELDS if (v := getattr(c, f)) is not None} for name, c in batches.items()}


def dump(pairs: Path, out: Path, names: list[str]) -> None:
    from fmtorch import Correspondences, presets

    torch.set_num_threads(1)
    batches = {name: Correspondences(**fields) for name, fields in torch.load(pairs).items()}
    own = [n for n in presets.available("estimator") if str(presets.load("estimator", n)["_target_"]).endswith(OWN)]
    arrays: dict[str, torch.Tensor] = geometry()
    for name in names or own:
        estimator, config = presets.build("estimator", name), presets.load("estimator", name)
        for label, c in batches.items():
            estimate = estimator(c, 0)
            values = {f: getattr(estimate, f) for f in ("matrix", "inliers", "ok", "samples")}
            values["reasons"] = torch.tensor(list("\n".join(estimate.reason).encode()), dtype=torch.uint8)
            arrays |= {f"{name} | {label} | {f}": value for f, value in values.items()}
        c = batches["scenes"]
        asked = {f: getattr(c, f).double().requires_grad_() for f in ("x0", "x1", "prior", "noise")}
        arrays |= with_gradients(f"{name} | model", estimator(c.replace(**asked), 1).matrix, asked)
        unfitted = {"fine": {"final": "none"}} if "fine" in config else {"final": "none"} if "final" in config else {}
        arrays[f"{name} | before the final fit"] = presets.build("estimator", name, **unfitted)(c, 0).matrix
    torch.save(arrays, out)


def with_gradients(name: str, value: torch.Tensor, asked: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """A value, and the gradients of it, weighted, to what it is a function of."""
    if not value.requires_grad:
        return {name: value}
    weights = torch.linspace(-1, 1, value.numel(), dtype=value.dtype).reshape(value.shape)
    grads = torch.autograd.grad((value * weights).sum(), list(asked.values()), allow_unused=True)
    named = {f"{name} | gradient to {f}": g for f, g in zip(asked, grads, strict=True) if g is not None}
    return {name: value.detach(), **named}


def geometry() -> dict[str, torch.Tensor]:
    from fmtorch import geometry as g

    rng = torch.Generator().manual_seed(0)
    x0, x1 = (torch.rand(5, 40, 2, generator=rng, dtype=torch.float64) * 600 for _ in range(2))
    w = torch.rand(5, 40, generator=rng, dtype=torch.float64)
    F0 = torch.randn(5, 2, 3, 3, generator=rng, dtype=torch.float64) * torch.tensor([1e-3, 1e-3, 1.0])
    K = torch.tensor([[700.0, 0, 300], [0, 720, 310], [0, 0, 1]], dtype=torch.float64).expand(5, 3, 3)
    mask = w > 0.1
    calls = {
        "seven_point": lambda a, b, v: g.seven_point(a[:, :7], b[:, :7])[0],
        "eight_point": lambda a, b, v: g.eight_point(a, b, v, mask)[0],
        "pose": lambda a, b, v: g.pose_from_fundamental(g.eight_point(a, b, v)[0], K, K, a, b).R,
        "sampson": lambda a, b, v: g.sampson(F0[:, 0], a, b),
        "calibration": lambda a, b, v: g.fundamental_from_calibration(K, K, K / 700, a[:, 0, :1].expand(5, 3) + 1),
        "attached step": lambda a, b, v: g.attached_step(F0, a, b, v, mask, loss="huber", scale=3.0),
    }
    for loss in ("cauchy", "truncated", "magsac"):
        how: dict[str, Any] = {"loss": loss, "scale": 3.0}
        calls[f"refine {loss}"] = lambda a, b, v, how=how: g.refine(F0, a, b, v, mask, **how)
        calls[f"irls {loss}"] = lambda a, b, v, how=how: g.irls(a, b, F0, v, mask, **how)
    arrays = {}
    for name, call in calls.items():
        asked = {f: x.clone().requires_grad_() for f, x in (("x0", x0), ("x1", x1), ("weight", w))}
        arrays |= with_gradients(f"geometry | {name}", call(*asked.values()), asked)
    return arrays


def computed(source: Path, pairs: Path, out: Path, names: list[str]) -> dict[str, torch.Tensor]:
    command = [sys.executable, str(Path(__file__).resolve()), "--dump", str(pairs), str(out), "--presets", *names]
    environment = {**os.environ, "PYTHONPATH": str(source.resolve()), "OMP_NUM_THREADS": "1"}
    subprocess.run(command, check=True, env=environment, cwd=source)
    return torch.load(out)


def same(a: torch.Tensor, b: torch.Tensor) -> bool:
    """Bit for bit, any NaN equal to any other."""
    a, b = (torch.where(x.isnan(), torch.nan, x) if x.is_floating_point() else x for x in (a, b))
    return (a.dtype, a.shape, a.numpy().tobytes()) == (b.dtype, b.shape, b.numpy().tobytes())


def differences(before: dict[str, torch.Tensor], after: dict[str, torch.Tensor]) -> list[str]:
    lines = [f"{name}: only {'before' if name in before else 'after'}" for name in before.keys() ^ after.keys()]
    for name in before.keys() & after.keys():
        if not same(before[name], after[name]):
            a, b = before[name].double(), after[name].double()
            size = f"by {float((a - b).abs().nan_to_num().max()):.3g}" if a.shape == b.shape else "in shape"
            lines.append(f"{name}: differs {size}")
    return sorted(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, nargs="?", help="a checkout")
    parser.add_argument("after", type=Path, nargs="?", default=HERE)
    parser.add_argument("--presets", nargs="*", default=[], help="of conf/estimator; all by default")
    parser.add_argument("--dump", type=Path, nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.dump:
        dump(*arguments.dump, arguments.presets)
        return
    if arguments.before is None:
        parser.error("BEFORE is missing: a checkout")
    with tempfile.TemporaryDirectory() as name:
        pairs = Path(name) / "pairs.pt"
        torch.save(inputs(), pairs)
        sources = {"before": arguments.before, "after": arguments.after}
        before, after = (computed(at, pairs, Path(name) / side, arguments.presets) for side, at in sources.items())
    lines = differences(before, after)
    print("\n".join(lines[:60]) + f"\n{len(lines)} of {len(before.keys() | after.keys())} arrays differ")
    sys.exit(bool(lines))


if __name__ == "__main__":
    main()
