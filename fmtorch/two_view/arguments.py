"""The door: what users say of two views, checked once, as `Correspondences` that need no second look.

NumPy or torch, one pair or a batch, pairs of different lengths as lists."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol, cast, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.checks import MIN_MATCHES, Box, as_tensor, box_of, expect_inside, widened
from fmtorch.core.lenses import Lens as CalibratedLens
from fmtorch.core.options import nearest
from fmtorch.core.records import Rule
from fmtorch.core.types import MAX_DEVIATION, Correspondences, collate
from fmtorch.geometry.cameras import calibration_problems
from fmtorch.geometry.epipolar import mean_stretch


@runtime_checkable
class DLPackArray(Protocol):
    """An array of another library, which DLPack shares."""

    def __dlpack__(self, **options: Any) -> Any: ...


Array = Tensor | NDArray[Any]
Arrays = Array | Sequence[Any] | DLPackArray  # one array, or a list of them: of pairs of different lengths
Focal = Literal["shared", "unknown"] | float | Arrays | Mapping[str, Any] | None
Lens = Literal["shared", "unknown"] | float | Arrays | CalibratedLens | None

PER_MATCH = {name: len(Correspondences.declared[name].shape) - 1 for name in Correspondences.per_slot}
"""The dimensions of what has an entry for each match, of one pair."""
FORMS = "None, 'unknown', 'shared', (px, deviation) or ((px, deviation), (px, deviation))"
FORMS_WITH_K = "None, 'unknown', 'shared', or the relative deviations of the focal lengths of K: one, two, or (B, 2)"
ROUNDING = 1e-6  # by which what is within [0, 1] may exceed 1
RATIO = Rule(
    lambda ratio: ~((ratio < 0) | (ratio > 1 + ROUNDING)),
    "it is the distance of the nearest descriptor over that of the second nearest, within [0, 1]. Of raw distances, "
    "such as DMatch.distance, give none, or as `ratio` quotients; `score` is a confidence in [0, 1], larger is better",
)
UNKNOWN = (1.0, math.inf)  # px, relative deviation
LENS_FORMS = "None, 'unknown', 'shared', lambda, (lambda, deviation) or ((lambda, deviation), (lambda, deviation))"
UNKNOWN_LENS = (0.0, math.inf)  # lambda, deviation
NEAR, FAR = 2e-4, 10.0  # focal lengths from the principal point that half of the points can be
MIN_PIXELS = 10.0  # a photograph's points reach farther from its first pixel
FOCAL_NAMES = ("shared", "unknown")


def correspondences(
    x0: Arrays, x1: Arrays, *, K0: Arrays | None = None, K1: Arrays | None = None, focal: Focal = None,
    lens: Lens = None, plane: bool = False, **fields: Arrays | int | None,
) -> Correspondences:  # fmt: skip
    """The batch that points and what is known of them and of the cameras describe, as of `fmtorch.find_fundamental`.
    x0, x1: whole numbers become float64, half precision float32; x0 decides the device. plane: x0 may be in the unit of
    a plane. fields: of `Correspondences`, or None. Raises TypeError for what is no array of numbers, ValueError for
    wrong shapes, values that cannot be, a calibration that is none, and points of no pixels."""
    if (fields.get("lafs0") is None) != (fields.get("lafs1") is None):
        raise ValueError("of lafs0 and lafs1 one is given; give both, or neither")
    cameras = camera_fields(K0, K1, focal, fields.get("size0") is not None)
    c = _batch(x0, x1, {**fields, **cameras, **lens_fields(lens)})
    if lens is not None and c.stretch is not None:
        raise ValueError(f"noise of covariances (N, 2, 2) needs a lens that is calibrated, not {lens}; or give (N,)")
    if len(c) == 1 and (problem := camera_problems(c)[0]):
        raise ValueError(problem)
    expect_possible(c, plane)
    return c


def camera_problems(c: Correspondences) -> tuple[str, ...]:
    """What is wrong with K0 or K1 of each pair by its image, or where no size is known by its points; mostly empty."""
    problems = [("",) * len(c)]
    for i, (K, x, size) in enumerate(((c.K0, c.x0, c.size0), (c.K1, c.x1, c.size1))):
        if K is None:
            continue
        problems.append(calibration_problems(K, size, f"K{i}"))
        if size is None and c.stretch is None and x.shape[1] >= MIN_MATCHES:
            known = c.mask if c.focal is None else c.mask & c.focal[:, i, 1:].isfinite()
            off = ((x * K[:, 2:, 2:] - K[:, None, :2, 2]) / K[:, None, (0, 1), (0, 1)]).detach().norm(dim=-1)
            off = torch.where(known & (known.sum(1, keepdim=True) >= MIN_MATCHES), off, torch.nan).nanmedian(1).values
            wrong = ((off > FAR) | ((off < NEAR) & (off > 0))).tolist()
            said = f"K{i} has points {{:.2g}} focal lengths off its principal point; both must be in one unit"
            problems.append(tuple(said.format(each) * bad for each, bad in zip(off.tolist(), wrong, strict=True)))
    return tuple(next(filter(None, each), "") for each in zip(*problems, strict=True))


def expect_possible(c: Correspondences, plane: bool = False) -> None:
    """Raises ValueError for values that cannot be, and for points of no pixels or outside images of their sizes.
    Of a batch in which some pairs are sound none is refused: no pair can take its batch down. Points of an image with a
    calibration matrix may be in its unit, whatever that is, and those of a plane, too, if the others are in pixels."""
    expect_values(c, ratio=RATIO)
    boxes = box_of(c.x0, c.mask), box_of(c.x1, c.mask)
    strange = [_normalized(box, K) for box, K in zip(boxes, (c.K0, c.K1), strict=True)]
    if plane and strange == [True, False]:
        return
    for i, (x, size) in enumerate(((c.x0, c.size0), (c.x1, c.size1))):
        if strange[i]:
            _refuse(boxes[i], i, (c.K0, c.K1)[i] is not None)
        if size is not None:
            expect_inside(x, boxes[i], size, f"x{i}", f"size{i}")


def _batch(x0: Arrays, x1: Arrays, fields: Mapping[str, Any]) -> Correspondences:
    if fields.get("mask") is None:
        x0, x1 = _one_pair(x0), _one_pair(x1)
    ragged = [name for name, value in (("x0", x0), ("x1", x1)) if _is_list_of_pairs(value)]
    if len(ragged) == 1:
        raise ValueError(f"{ragged[0]} is a list of pairs and the other is not; both must be, or neither")
    if ragged:
        return _of_list(cast(Sequence[Any], x0), cast(Sequence[Any], x1), fields)
    points0, points1 = _points(x0, "x0"), _points(x1, "x1")
    if points0.shape != points1.shape:
        raise ValueError(f"x0 has shape {tuple(points0.shape)} but x1 {tuple(points1.shape)}; they must be equal")
    if points0.dim() == 3 and points0.shape[1] == 1 and len(points0) > 1 and fields.get("mask") is None:
        raise ValueError(
            f"x0 and x1 have shape {tuple(points0.shape)}, as OpenCV stores {len(points0)} points; give x0[:, 0] and "
            f"x1[:, 0] for one pair (with a mask they are {len(points0)} pairs of one match)"
        )
    single = points0.dim() == 2
    points0, points1 = (points[None] if single else points for points in (points0, points1.to(points0.device)))
    kind = torch.promote_types(points0.dtype, points1.dtype)
    known = {name: _field(name, value, single, points0) for name, value in fields.items() if value is not None}
    if (noise := known.get("noise")) is not None and noise.dim() == 4 - single and noise.shape[-2:] == (2, 2):
        known |= _of_covariances(noise[None] if single else noise)
    mask = known.pop("mask", None)
    mask = torch.ones_like(points0[..., 0], dtype=torch.bool) if mask is None else mask.to(torch.bool)
    return Correspondences(points0.to(kind), points1.to(kind), mask, **known)


def _of_covariances(C: Tensor) -> dict[str, Tensor]:
    """Noise and `stretch` of matches whose points in image 1 have covariances (b, n, 2, 2): those are its roots."""
    a, b, d = 2 * C[..., 0, 0], 2 * C[..., 1, 0], 2 * C[..., 1, 1]  # of both images together, as `noise` counts
    roots = [a.sqrt(), torch.zeros_like(a), b / a.sqrt(), (d - b * b / a).sqrt()]
    stretch = torch.stack([torch.zeros_like(C), torch.stack(roots, -1).reshape(C.shape)], -3)
    return {"noise": mean_stretch(stretch, torch.sqrt), "stretch": stretch.detach().nan_to_num()}


def _is_list_of_pairs(value: object) -> bool:
    """Whether the elements are pairs' points, and not single points; of an empty list there are none of either."""
    return isinstance(value, list | tuple) and (not value or getattr(value[0], "ndim", _depth(value[0])) >= 2)


def _one_pair(points: Any) -> Any:
    """A list of (1, 2), as a loop over OpenCV's points makes it, as (N, 2); anything else as it is."""
    if not isinstance(points, list | tuple) or len(points) < 2 or any(np.shape(each) != (1, 2) for each in points):
        return points
    return [each[0] for each in points]


def _depth(value: object) -> int:
    if not isinstance(value, list | tuple):
        return int(hasattr(value, "pt"))  # a keypoint of OpenCV
    return 1 + (_depth(value[0]) if value else 0)


def _points(value: object, name: str) -> Tensor:
    points = as_tensor(value, name)
    if points.dim() not in (2, 3) or points.shape[-1] != 2:
        raise ValueError(f"{name} has shape {tuple(points.shape)}; it must be (N, 2) or (B, N, 2)")
    if points.dtype == torch.bool:
        raise TypeError(f"{name} holds booleans; it must hold coordinates in pixels")
    return widened(points)


def _field(name: str, value: object, single: bool, points: Tensor) -> Tensor:
    """A field of a batch: with the leading dimension where one pair's came without, sizes and keys for each pair."""
    tensor = as_tensor(value, name).to(points.device)
    if name == "key" and tensor.is_floating_point():
        raise ValueError(f"key is of {tensor.dtype}; it must be whole numbers (`pair_key` makes them)")
    declared = Correspondences.declared[name]
    if name == "key":
        tensor = tensor.to(torch.int64)
    elif not declared.holds(tensor.dtype) or tensor.is_floating_point():
        tensor = tensor.to(torch.bool) if name in ("mask", "mutual") else widened(tensor)
    if name in ("score", "prior"):  # where nothing is known nothing speaks for the match
        tensor = torch.where(tensor > 1 + ROUNDING, tensor, torch.where(tensor.isnan(), 0, tensor.clamp(max=1)))
    if name in PER_MATCH:
        return tensor[None] if single and tensor.dim() == PER_MATCH[name] else tensor
    shape = tuple(map(int, declared.shape[1:]))
    if tuple(tensor.shape) in (shape, (1, *shape)):
        return tensor.expand(len(points), *shape)
    if tuple(tensor.shape) != (len(points), *shape):
        single_shape = f"{shape} for all pairs" if shape else "one number for all pairs"
        wanted = f"{single_shape}, or {(len(points), *shape)}"
        raise ValueError(f"{name} has shape {tuple(tensor.shape)}; it must be {wanted}")
    return tensor


def _of_list(x0: Sequence[Any], x1: Sequence[Any], fields: Mapping[str, Any]) -> Correspondences:
    count = len(x0)
    for name, value in {"x1": x1, **{name: fields[name] for name in PER_MATCH if fields.get(name) is not None}}.items():
        listed = isinstance(value, list | tuple | Tensor | np.ndarray) and getattr(value, "ndim", 1) > 0
        if not listed or len(cast(Any, value)) != count:
            raise ValueError(f"{name} must be a list of {count} arrays, one for each pair of x0")
        if name != "mask" and any(missing := [entry is None for entry in cast(Any, value)]):
            raise ValueError(f"{name} of pair {missing.index(True)} is None; give it for all pairs, or for none")
    if not count:
        return _batch(torch.zeros(0, 0, 2), torch.zeros(0, 0, 2), {})
    batch_fields = {
        name: _field(name, value, False, torch.zeros(count, 0, 2))
        for name, value in fields.items()
        if value is not None and name not in PER_MATCH
    }
    pairs = []
    for i in range(count):
        own = {name: fields[name][i] for name in PER_MATCH if fields.get(name) is not None}
        pairs.append(_one_of_list(i, x0[i], x1[i], {**own, **{name: value[i] for name, value in batch_fields.items()}}))
    device, kind = pairs[0].x0.device, functools.reduce(torch.promote_types, (pair.x0.dtype for pair in pairs))
    alike = [pair.to(device).replace(x0=pair.x0.to(device, kind), x1=pair.x1.to(device, kind)) for pair in pairs]
    return collate(alike)


def _one_of_list(i: int, x0: Any, x1: Any, fields: Mapping[str, Any]) -> Correspondences:
    try:
        points0, points1 = as_tensor(x0, "x0"), as_tensor(x1, "x1")
        if points0.dim() != 2 or points1.dim() != 2:
            shapes = f"{tuple(points0.shape)} and {tuple(points1.shape)}"
            raise ValueError(f"x0 and x1 have shapes {shapes}; both must be (N, 2)")
        return _batch(points0, points1, fields)
    except (TypeError, ValueError) as error:
        raise type(error)(f"pair {i}: {error}") from error


def expect_values(c: Correspondences, **more: Rule) -> None:
    """Raises ValueError naming the first wrong value of the real matches of a batch; a GPU is asked but once.
    more: rules beside those of the fields."""
    rules = {name: field.bounds for name, field in c.declared.items() if field.bounds} | more
    wrong = {
        name: ~rule.holds(value.detach()) & (c.mask if name in PER_MATCH else True)
        for name, rule in rules.items()
        if (value := getattr(c, name)) is not None
    }
    if not wrong or not bool(torch.stack([each.any() for each in wrong.values()]).any()):
        return
    name = next(name for name, each in wrong.items() if bool(each.any()))
    pair, place = wrong[name].nonzero()[0].tolist()
    value, text = getattr(c, name)[pair], rules[name].text
    if name in PER_MATCH:
        raise ValueError(f"{name} of match {place} of pair {pair} is {value[place].item()}; {text}")
    if name in ("focal", "lens"):
        raise ValueError(f"{name} of image {place} of pair {pair} is {value[place].tolist()}; {text}")
    raise ValueError(f"{name} is {tuple(value.tolist())}; {text}")


def camera_fields(K0: Arrays | None, K1: Arrays | None, focal: Focal, sizes_known: bool) -> dict[str, Any]:
    """The fields K0, K1, focal, shared_focal of the arguments of `find_fundamental`; none where nothing is said.
    Raises ValueError or TypeError, naming the argument."""
    if isinstance(focal, str) and focal not in FOCAL_NAMES:
        near = nearest(focal, FOCAL_NAMES).split(", ")[0]
        raise ValueError(f"focal is {focal!r}; it must be {FORMS}; did you mean {near!r}?")
    if K0 is None and K1 is None and (focal is None or isinstance(focal, Mapping)):
        return {}
    if not sizes_known and (K0 is None or K1 is None):
        missing = "focal" if K0 is None and K1 is None else "K1 alone" if K0 is None else "K0 alone"
        raise ValueError(f"{missing} needs the image sizes: give size0 and size1")
    fields: dict[str, Any] = {name: _floating(K, name) for name, K in (("K0", K0), ("K1", K1)) if K is not None}
    if isinstance(focal, str):
        return fields | _unknown("focal", focal, UNKNOWN)
    if fields:
        return fields | {"focal": _deviations(focal, K0 is not None, K1 is not None)}
    return {"focal": _of_both(focal, "focal", UNKNOWN, f"without K0 and K1 it must be {FORMS}")}


def lens_fields(lens: Lens) -> dict[str, Any]:
    """The fields lens, shared_lens of the argument of `find_fundamental`; none where there is no lens."""
    if lens is None:
        return {}
    if isinstance(lens, str):
        if lens not in FOCAL_NAMES:
            raise ValueError(f"lens is {lens!r}; it must be {LENS_FORMS}")
        return _unknown("lens", lens, UNKNOWN_LENS)
    if not isinstance(lens, list | tuple) and (value := _floating(lens, "lens")).numel() == 1:
        lens = torch.cat([value.reshape(1), value.new_zeros(1)])
    return {"lens": _of_both(lens, "lens", UNKNOWN_LENS, f"it must be {LENS_FORMS}")}


def is_calibrated(lens: Any) -> bool:
    """Whether it is a calibrated lens, or holds some."""
    return isinstance(lens, CalibratedLens) or (isinstance(lens, list | tuple) and any(map(is_calibrated, lens)))


def expect_lenses(estimator: object, name: str) -> None:
    """Raise ValueError where an estimator of this name estimates no lenses."""
    if not getattr(estimator, "assumes_cameras", False):
        raise ValueError(f"lens needs an estimator with the option focal, as fmtorch; {name} has none")


def expect_lens(lens: Lens) -> None:
    """Raise ValueError for a lens that is none, before there are pairs."""
    correspondences(torch.zeros(1, 0, 2), torch.zeros(1, 0, 2), lens=lens)


def _unknown(name: str, which: str, unknown: tuple[float, float]) -> dict[str, Any]:
    """Fields where nothing is known of either image, or that both are alike."""
    nothing = {name: torch.tensor([unknown, unknown], dtype=torch.float64)}
    return nothing | {f"shared_{name}": torch.tensor(True)} if which == "shared" else nothing


def _of_both(value: Any, name: str, unknown: tuple[float, float], forms: str) -> Tensor:
    """What is measured and its deviations, (2, 2) or (B, 2, 2)."""
    try:
        values = [unknown if entry is None else entry for entry in value] if isinstance(value, list | tuple) else value
        values = _floating(values, name)
    except TypeError as error:
        raise ValueError(f"{name} is {value}; {forms}") from error
    values = values.expand(2, 2) if values.shape == (2,) else values
    if values.dim() not in (2, 3) or values.shape[-2:] != (2, 2):
        raise ValueError(f"{name} has shape {tuple(values.shape)}; {forms}")
    return values


def _deviations(focal: Any, known0: bool, known1: bool) -> Tensor:
    """Deviations of the focal lengths of K, in the place where they stand beside px: (2, 2) or (B, 2, 2)."""
    values = _floating(0.0 if focal is None or isinstance(focal, Mapping) else focal, "focal")
    values = values.expand(2) if values.shape in ((), (1,)) else values
    if values.dim() > 2 or values.shape[-1] != 2:
        raise ValueError(f"focal has shape {tuple(values.shape)}; with K0 or K1 it must be {FORMS_WITH_K}")
    if not bool(((values >= 0) & ((values <= MAX_DEVIATION) | (values == torch.inf))).all()):
        text = "a relative deviation is not negative, such as 0.05, and unless it is infinite at most 2"
        raise ValueError(f"focal is {values.tolist()}; with K0 or K1 {text}")
    known = torch.tensor([known0, known1], device=values.device)
    values = torch.where(known, values, torch.inf)
    return torch.stack([torch.ones_like(values), values], -1)


def _floating(value: Any, name: str) -> Tensor:
    return widened(as_tensor(value, name))


def _normalized(box: Box, K: Tensor | None) -> bool:
    """Whether all coordinates of the pairs are too small for pixels, and not all of a pair zero."""
    reach = torch.maximum(-box.low, box.high).amax(1)
    small = (reach > 0) & (reach < MIN_PIXELS)
    if K is not None:
        small &= K.detach().to(reach.device)[:, (0, 1), (0, 1)].abs().amax(1) > 10 * MIN_PIXELS
    return bool(box.enough.any()) and bool((small | ~box.enough).all())


def _refuse(box: Box, i: int, calibrated: bool) -> None:
    """Raise ValueError that says what the points are and what to do."""
    span = f"from {box.low[box.enough].min():.3g} to {box.high[box.enough].max():.3g}"
    if calibrated:
        raise ValueError(
            f"x{i} runs {span}, as normalised points do, but K{i} is in pixels; give points in pixels, or normalised "
            f"ones with K{i} the identity"
        )
    raise ValueError(
        f"x{i} runs {span}: no pixels, in which thresholds are, so that every match would be an inlier. Give points in "
        "pixels (times the focal length), or normalised ones to find_essential with K0 and K1 the identity"
    )
