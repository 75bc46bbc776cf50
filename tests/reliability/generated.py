"""Generated calls of every public function: a sound result or a clear error, whatever is handed over.

``python -m tests.reliability.generated [--calls 10] [name ...]`` makes so many calls of each subject whose name begins
with one of the names. It is a program of its own since the test suite checks the shapes of all functions, which users
do not have. The calls are the same every time."""

import argparse
import faulthandler
import functools
import importlib.util
import inspect
import json
import linecache
import math
import re
import sys
import time
import typing
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import HealthCheck, Phase, given, note, seed, settings
from hypothesis import strategies as st
from torch import Tensor

import fmtorch
from fmtorch import geometry, matching, metrics, pruning
from fmtorch.core import Correspondences, Estimate, Features, arguments_of, arrays_of, collate
from fmtorch.pipeline import load_pipeline
from fmtorch.presets import merged
from tests.laws import PEERS, calibrated, few, quick_pruner
from tests.reliability.arguments import KINDS, MISTAKES, NUMBERS, SEQUENCES, Scene, batches, scenes
from tests.reliability.arguments import given as as_given
from tests.variants import keywords, loaded, variants

HOME = str(Path(fmtorch.__file__).parent)
MINIMAL_SAMPLE = 7
Call = Callable[[], Any]
Check = Callable[[Any], None]
Draw = Callable[[st.DataObject], tuple[Call, set[str], Check]]
"""Makes a call, the names that an error may name, and a check of the result."""
UNDEFINED = {"inlier_rate", "recall", "mean_recall", "pose_auc"}  # NaN of an empty set
UNIT_INTERVAL = {"nsgd", "nsgd_released", "recall", "mean_recall", "pose_auc", "inlier_rate"}
NOT_NEGATIVE = {"sampson", "sampson_squared", "epipolar_distances", "symmetric_max", "symmetric_mean", "point_to_line"}
PAIRS_OF_FOCALS = ((0, 0.1), (800.0, 0.1), ((800, 0), None))
FOCALS = (*[None] * 3, "shared", "unknown", 0.05, *PAIRS_OF_FOCALS, -1.0, "same", np.nan, [])
"""What may be said of focal lengths, and what may not."""
pruner = functools.cache(quick_pruner)
FIELDS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "x0": ("Float", ("b", "n", "2")), "x1": ("Float", ("b", "n", "2")), "mask": ("Bool", ("b", "n")),
    "ratio": ("Float", ("b", "n")), "prior": ("Float", ("b", "n")), "noise": ("Float", ("b", "n")),
    "lafs0": ("Float", ("b", "n", "2", "3")), "lafs1": ("Float", ("b", "n", "2", "3")),
    "size0": ("Real", ("b", "2")), "size1": ("Real", ("b", "2")), "key": ("Int", ("b",)),
}  # fmt: skip
REQUIRED = ("x0", "x1", "mask")


def mistaken(data: st.DataObject, arguments: dict[str, Any], numbers: dict[str, Any], *, movable: bool = True) -> bool:
    """Spoil some arguments in place, often none; whether any is. movable: devices differ, too."""
    spoiled = []
    for _ in range(data.draw(st.sampled_from([0, 0, 1, 1, 1, 2]), label="mistakes")):
        name = data.draw(st.sampled_from(sorted({**arguments, **numbers})), label="argument")
        if name in numbers:
            arguments[name] = data.draw(st.sampled_from(NUMBERS), label="value")
            spoiled.append(name)
            continue
        mistake = data.draw(st.sampled_from(sorted(MISTAKES)), label="mistake")
        if mistake == "on another device" and not movable:
            continue
        others = [value for key, value in arguments.items() if key != name]
        if mistake == "on another device" and not any(isinstance(value, Tensor) and value.dim() for value in others):
            continue  # it would be the only one
        try:
            arguments[name] = MISTAKES[mistake](arguments[name])
        except (TypeError, ValueError, AttributeError, IndexError, RuntimeError):
            continue  # a second mistake that cannot be made of the first one
        spoiled.append(name)
    return bool(spoiled)


def function_call(function: Callable[..., Any], data: st.DataObject) -> tuple[Call, set[str], Check]:
    parameters = inspect.signature(function).parameters
    wanted = arguments_of(function)
    single = any("b" in want.shape for want in wanted.values())
    scene = data.draw(batches() if single else scenes(), label="scene")
    kind = data.draw(st.sampled_from(KINDS), label="kind")
    arguments: dict[str, Any] = {}
    numbers: dict[str, Any] = {}
    for name, want in wanted.items():
        if name == "weigh":
            arguments[name] = functools.partial(_alike, np.shape(arguments["x0"])[:2])
        elif want.kind == "array":
            if not want.optional or data.draw(st.booleans(), label=f"{name} is given"):
                arguments[name] = as_given(scene.array(name, want.dtype, want.shape), kind)
            elif parameters[name].default is parameters[name].empty:
                arguments[name] = None
        elif want.kind.endswith("numbers"):
            if data.draw(st.booleans(), label=f"{name} is given"):
                arguments[name] = data.draw(st.sampled_from(SEQUENCES), label=name)
        elif want.kind in ("int", "float", "str", "bool", "choice", "number or array"):
            numbers[name] = None
            if parameters[name].default is parameters[name].empty:
                arguments[name] = 2 if want.kind == "int" else 0.7
    spoiled = mistaken(data, arguments, numbers)
    clean = not spoiled and 1e-9 <= scene.scale <= 1e9
    check = functools.partial(sound_result, function.__name__, clean)
    return functools.partial(function, **arguments), set(parameters), check


def _alike(shape: tuple[int, ...], F: Tensor | None, residual: Tensor | None) -> Tensor:
    return torch.ones(shape)


def tensors(result: Any) -> Iterator[Tensor]:
    if isinstance(result, Tensor):
        yield result
    elif isinstance(result, tuple | list):
        for entry in result:
            yield from tensors(entry)


def sound_result(name: str, clean: bool, result: Any) -> None:
    """What holds of every result; of finite input of a moderate scale also that no NaN comes out."""
    for value in tensors(result):
        if not value.is_floating_point() or value.device.type == "meta":
            continue
        known = value[~value.isnan()]
        if name in UNIT_INTERVAL:
            assert bool(((known >= 0) & (known <= 1 + 1e-6)).all()), f"{name} is outside [0, 1]: {known}"
        if name in NOT_NEGATIVE:
            assert bool((known >= 0).all()), f"{name} is negative"
        if clean and name not in UNDEFINED:
            assert not bool(value.isnan().any()), f"{name} is NaN for finite arguments"


def fields(data: st.DataObject, scene: Scene, kind: str) -> dict[str, Any]:
    values = {}
    sizes = data.draw(st.booleans(), label="sizes are given")
    for name, (numbers, shape) in FIELDS.items():
        wanted = sizes if name.startswith("size") else name in REQUIRED or data.draw(st.booleans(), label=name)
        if wanted:
            values[name] = as_given(scene.array(name, numbers, shape), kind)
    return values


def estimation(name: str, data: st.DataObject) -> tuple[Call, set[str], Check]:
    options = merged(keywords(name), few(loaded("estimator", name), 200, 100))
    find = fmtorch.find_homography if name == "homography" else fmtorch.find_fundamental
    scene = data.draw(batches(), label="scene")
    kind = data.draw(st.sampled_from(KINDS), label="kind")
    arguments = fields(data, scene, kind)
    if find is fmtorch.find_fundamental:
        for camera in ("K0", "K1"):
            if data.draw(st.booleans(), label=camera):
                arguments[camera] = as_given(scene.array(camera, "Float", ("b", "3", "3")), kind)
    if scene.batch == (1,) and data.draw(st.booleans(), label="without the batch dimension"):
        arguments = {key: value[0] for key, value in arguments.items()}
    elif data.draw(st.sampled_from([False, False, True]), label="as lists"):
        per_match = [key for key in arguments if not key.startswith(("size", "key", "K"))]
        arguments.update({key: list(arguments[key]) for key in per_match})
    known = inspect.signature(find).parameters
    arguments = {key: value for key, value in arguments.items() if key in known}
    mistaken(data, arguments, {"seed": None}, movable=False)
    if find is fmtorch.find_fundamental and (focal := data.draw(st.sampled_from(FOCALS), label="focal")) is not None:
        options["focal"] = focal
    return functools.partial(find, **arguments, **options), {*known}, sound_estimate


def sound_estimate(estimate: Any) -> None:
    """The promises of `Estimate`: of a pair that is ok a finite F of unit norm with support, of another a reason."""
    F, ok, reason = estimate.matrix.detach().double(), estimate.ok, estimate.reason
    assert (F.shape, estimate.inliers.dtype) == ((len(ok), 3, 3), torch.bool)
    for i in range(len(ok)):
        support = int(estimate.inliers[i].sum())
        if bool(ok[i]):
            assert reason[i] == "", f"ok with a reason: {reason[i]}"
            assert bool(F[i].isfinite().all()), "ok with an F that is not finite"
            assert math.isclose(float(F[i].norm()), 1, rel_tol=1e-4), f"ok with an F of norm {float(F[i].norm())}"
            minimal = MINIMAL_SAMPLE if estimate.model == "fundamental" else 4
            assert support >= minimal, f"ok with {support} inliers"
            if estimate.R is not None:
                sound_pose(estimate.R[i].detach(), estimate.t[i].detach(), estimate.E[i].detach())
        else:
            assert reason[i], "not ok without a reason"
            assert not bool(F[i].any()), "not ok with an F"
            assert support == 0, f"not ok with {support} inliers"


def sound_pose(R: Tensor, t: Tensor, E: Tensor) -> None:
    """A rotation, a unit vector, and what they make; or NaN throughout."""
    finite = {bool(value.isfinite().all()) for value in (R, t, E)}
    assert len(finite) == 1, "a pose of which a part is not finite"
    if finite == {True}:
        identity = torch.eye(3, dtype=R.dtype)
        torch.testing.assert_close(R @ R.mT, identity, rtol=0, atol=1e-9)
        assert float(torch.linalg.det(R)) > 0, "a reflection for a rotation"
        assert math.isclose(float(t.norm()), 1, rel_tol=1e-9)
        torch.testing.assert_close(E, torch.linalg.cross(t.expand(3, 3), R.mT).mT, rtol=0, atol=1e-9)


def pruned(name: str, data: st.DataObject) -> tuple[Call, set[str], Check]:
    scene = data.draw(batches(), label="scene")
    kind = data.draw(st.sampled_from(KINDS[:2]), label="kind")
    arguments = fields(data, scene, kind)
    if data.draw(st.booleans(), label="mutual"):
        arguments["mutual"] = arguments["mask"]
    mistaken(data, arguments, {})

    def call() -> tuple[Correspondences, Correspondences]:
        c = Correspondences(**arguments)
        c = calibrated(c) if name.startswith(("lc", "dfe")) else c
        return c, pruner(name)(c)

    return call, {*FIELDS, "mutual"}, sound_pruning


def sound_pruning(result: Any) -> None:
    """Of the matches some survive, no others; a prior is a probability."""
    before, after = result
    assert after.mask.shape == before.mask.shape
    assert not bool((after.mask & ~before.mask).any()), "a masked match survives"
    if after.prior is not None and after.prior is not before.prior:
        live = after.prior[after.mask]
        assert bool(((live >= 0) & (live <= 1)).all()), "a prior outside [0, 1]"


def record(kind: type, data: st.DataObject) -> tuple[Call, set[str], Check]:
    """What travels between the stages: made, indexed, joined."""
    scene = data.draw(batches(), label="scene")
    library = data.draw(st.sampled_from(["torch.float32", "torch.float64"]), label="kind")
    if kind is Correspondences:
        arguments = fields(data, scene, library)
    else:
        all_of_them = arrays_of(kind).items()
        wanted = {n: want for n, want in all_of_them if not want.optional or data.draw(st.booleans(), label=n)}
        arguments = {n: as_given(scene.array(n, want.dtype, want.shape), library) for n, want in wanted.items()}
        if kind is Estimate:
            arguments["reason"] = ("",) * len(arguments["matrix"])
    mistaken(data, arguments, {})

    def call() -> Any:
        created: Any = kind(**arguments)
        if kind is Features and created.lafs.dim() == 3:
            return collate([created, created])
        half = created[: max(1, len(created) // 2)] if kind is not Features else created
        joined = collate([created, half])
        return joined.compact() if kind is Correspondences else joined

    return call, set(typing.get_type_hints(kind)), lambda result: None


def images(seed: int) -> dict[str, Any]:
    """Pictures, and what a user takes for one."""
    rng = np.random.default_rng(seed)
    soft = np.kron(rng.integers(0, 255, (12, 16)), np.ones((8, 8))).astype(np.uint8)
    return {
        "noise": rng.integers(0, 255, (60, 80)).astype(np.uint8), "flat": np.full((60, 80), 9, np.uint8),
        "empty": np.zeros((0, 9), np.uint8), "one pixel": soft[:1, :1], "one row": soft[:1], "grey": soft,
        "huge row": np.tile(soft[:2], (1, 100)), "rgb": np.dstack([soft] * 3), "rgba": np.dstack([soft] * 4),
        "floats": soft / 255, "16 bit": soft.astype(np.uint16), "a list": soft.tolist(), "None": None,
        "a tensor": torch.from_numpy(soft),
    }  # fmt: skip


@functools.cache
def pipeline(name: str) -> Any:
    return load_pipeline(name, overrides=["cache=off", "features.max_features=200"])


def photographs(data: st.DataObject) -> tuple[Call, set[str], Check]:
    kinds, seeds = st.sampled_from(list(images(0))), st.integers(0, 3)
    two = [images(data.draw(seeds))[data.draw(kinds, label="image")] for _ in range(2)]
    word = data.draw(st.sampled_from(["sift_gms", "sift_fmtorch"]), label="pipeline")
    side = data.draw(st.sampled_from([1600, 1600, 50, 1, 0, -1]), label="longest_side")
    call = functools.partial(fmtorch.match, *two, pipeline=pipeline(word), longest_side=side)
    return call, {*inspect.signature(fmtorch.match).parameters}, sound_match


def sound_match(result: Any) -> None:
    """A matrix or a reason."""
    assert result.ok == (result.reason == "")
    assert bool(result.F.isfinite().all())
    assert bool(result.F.any()) == result.ok


def installed_estimators() -> list[str]:
    """The presets whose library is there: those of peers need an extra."""
    return [n for n in variants("estimator") if n not in PEERS or importlib.util.find_spec(PEERS[n])]


def subjects() -> dict[str, Draw]:
    draws: dict[str, Draw] = {}
    for module in (geometry, metrics, pruning, matching):
        public = {name: getattr(module, name) for name in module.__all__}
        room = module.__name__.removeprefix("fmtorch.")
        functions = {name: value for name, value in public.items() if inspect.isfunction(value)}
        draws |= {f"{room}.{name}": functools.partial(function_call, value) for name, value in functions.items()}
    draws |= {f"types.{c.__name__}": functools.partial(record, c) for c in (Correspondences, Features, Estimate)}
    draws |= {f"find_fundamental.{name}": functools.partial(estimation, name) for name in installed_estimators()}
    draws |= {f"pruner.{name}": functools.partial(pruned, name) for name in variants("pruner")}
    return {**draws, "fmtorch.match": photographs}


class Unclear(AssertionError):
    """An exception that a user cannot make sense of."""


def outcome(call: Call, names: set[str], check: Check) -> str:
    """Make the call: "sound" or "refused". Raises Unclear for any other error, AssertionError for an unsound result."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", category=RuntimeWarning, module="fmtorch")
            result = call()
    except Exception as error:
        _expect_clear(error, names)
        return "refused"
    check(result)
    return "sound"


def _expect_clear(error: Exception, names: set[str]) -> None:
    """A ValueError or TypeError that this package raises itself, and that names an argument."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    file, line = trace.tb_frame.f_code.co_filename, trace.tb_lineno
    ours = file.startswith(HOME) and linecache.getline(file, line).strip().startswith("raise ")
    named = any(re.search(rf"\b{name}\b", str(error)) for name in names)
    if not (isinstance(error, ValueError | TypeError) and ours and named):
        raise Unclear(f"{type(error).__name__} at {file}:{line}: {error}") from error


def trial(name: str, draw: Draw, calls: int) -> Counter[str]:
    """Make so many calls of a subject and count what came of them. Raises what the first fault raises."""
    counted: Counter[str] = Counter()

    @seed(zlib.crc32(name.encode()))
    @settings(
        max_examples=calls, deadline=None, database=None, report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck), phases=[Phase.generate, Phase.shrink],
    )  # fmt: skip
    @given(st.data())
    def example(data: st.DataObject) -> None:
        call, names, check = draw(data)
        note(f"{name}: {call}"[:2000])
        counted[outcome(call, names, check)] += 1

    example()
    return counted


def main() -> None:
    """The program: a line of JSON a subject; status 1 where one of them has a fault."""
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", default=[""])
    parser.add_argument("--calls", type=int, default=10)
    options = parser.parse_args()
    faulthandler.enable()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    faults = 0
    for name, draw in subjects().items():
        if not name.startswith(tuple(options.names)):
            continue
        start = time.process_time()
        try:
            counted: Mapping[str, Any] = trial(name, draw, options.calls)
        except Exception as error:
            faults += 1
            notes = "\n".join(getattr(error, "__notes__", []))
            counted = {"fault": f"{type(error).__name__}: {error}", "call": notes[-1500:]}
        line = {"subject": name, **counted, "seconds": round(time.process_time() - start, 2)}
        print(json.dumps(line), flush=True)
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
