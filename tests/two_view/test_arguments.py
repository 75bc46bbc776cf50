"""What users hand over: lists of pairs, sizes for all, NumPy everywhere, presets of their own, empty batches."""

import typing
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

import fmtorch
from fmtorch import metrics
from fmtorch.core import Correspondences, Estimate, collate
from fmtorch.data import ImageSource
from fmtorch.evaluation import evaluate
from fmtorch.pipeline import load_pipeline
from fmtorch.two_view import estimation
from tests.helpers import draw, pair, small_pipeline, write_file
from tests.laws import quick, scene, shown
from tests.processes import run_command
from tests.reference import known_cameras
from tests.variants import OTHER_LIBRARIES, built, keywords, variants

PAIRS = [scene(i, count) for i, count in enumerate((60, 90, 40))]
FAST = {"estimator": "msac", "hypotheses": 100}
SCENE = known_cameras.scene(7, 200, noise=0.2)
FROM_CENTRE = [x - (319.5, 239.5) for x in SCENE[:2]]  # outside on one side, and never beyond the other
EASY = {"estimator": "msac", "hypotheses": 300}
WRONG = [
    ("prior", 1.5, r"prior of match 3 of pair 1 is 1\.5; it is P\(inlier\), within \[0, 1\]"),
    ("prior", -0.1, "prior of match 3 of pair 1 is -0.1"),
    ("noise", 0.0, r"noise of match 3 of pair 1 is 0\.0; it is a standard deviation, positive"),
    ("noise", -1.0, "noise of match 3 of pair 1 is -1"),
    ("noise", float("nan"), "noise of match 3 of pair 1 is nan"),
    ("size0", 0, r"size0 is \(640, 0\); image sizes \(h, w\) are positive"),
    ("size1", -960, r"size1 is \(640, -960\); image sizes"),
]
WITHOUT = (*OTHER_LIBRARIES, "homography", "weighted_eight_point")
OWN = [name for name in variants("estimator") if not name.startswith(WITHOUT)]
C = scene(1, 60, outliers=0.2)


REFUSED = {name: ("prior",) for name in OWN if name.startswith("paper/")} | {"paper/usac": ("x0", "prior")}
"""Gradients that the final fit takes no account of: that of paper/usac is none, those of the others are unweighted."""


def test_a_list_of_pairs_is_a_padded_batch() -> None:
    batch = collate(PAIRS)
    batched = fmtorch.find_fundamental(
        batch.x0, batch.x1, mask=batch.mask, ratio=batch.ratio, lafs0=batch.lafs0, lafs1=batch.lafs1,
        size0=batch.size0, size1=batch.size1, key=batch.key,
    )  # fmt: skip
    listed = fmtorch.find_fundamental(
        [c.x0[0].numpy() for c in PAIRS], [c.x1[0] for c in PAIRS], ratio=[c.ratio[0].numpy() for c in PAIRS],
        lafs0=[c.lafs0[0] for c in PAIRS], lafs1=[c.lafs1[0] for c in PAIRS], size0=(640, 960), size1=[640, 960],
        key=[1, 2, 3],
    )  # fmt: skip
    assert torch.equal(listed.F, batched.F)
    assert torch.equal(listed.inliers, batched.inliers)
    assert bool(listed.ok.all())


def test_gradients_reach_the_pairs_of_a_list_and_nan_is_a_prior_of_zero() -> None:
    points, x1 = [c.x0[0].double().requires_grad_() for c in PAIRS], [c.x1[0] for c in PAIRS]
    sound = [torch.arange(len(x)) % 3 / 2 for x in points]
    priors = [torch.where(prior > 0, prior + 5e-7 * (prior == 1), torch.nan).requires_grad_() for prior in sound]
    expected, F = (fmtorch.find_fundamental(points, x1, prior=p, **FAST).F for p in (sound, priors))
    F.sum().backward()
    assert torch.equal(F, expected)
    assert all(bool(x.grad.isfinite().all() & (x.grad != 0).any()) for x in points + priors)


def test_one_size_is_that_of_all_pairs() -> None:
    batch = collate([PAIRS[0], PAIRS[0]])
    each = fmtorch.find_fundamental(batch.x0, batch.x1, size0=batch.size0, size1=batch.size1)
    for size in ((640, 960), np.array([640, 960]), torch.tensor([[640, 960]])):
        assert torch.equal(fmtorch.find_fundamental(batch.x0, batch.x1, size0=size, size1=size).F, each.F)
    with pytest.raises(ValueError, match=r"size0 has shape \(3, 2\)"):
        fmtorch.find_fundamental(batch.x0, batch.x1, size0=[(640, 960)] * 3, size1=(640, 960))


@pytest.mark.parametrize(
    ("x0", "x1", "options", "message"),
    [
        ([C.x0[0]], C.x1, {}, "x0 is a list of pairs and the other is not"),
        ([C.x0[0]] * 2, [C.x1[0]], {}, "x1 must be a list of 2 arrays"),
        ([np.zeros((9, 2))], [np.zeros((8, 2))], {}, "pair 0: x0 has shape .9, 2. but x1 .8, 2."),
        ([np.zeros((9, 3))], [np.zeros((9, 3))], {}, "pair 0: x0 has shape .9, 3.; it must be"),
        ([np.zeros((9, 2))], [np.zeros((9, 2))], {"prior": np.zeros((2, 9))}, "prior must be a list of 1 arrays"),
        *(([SCENE.x0] * 2, [SCENE.x1] * 2, {name: [np.ones(200), None]}, f"{name} of pair 1 is None; give it for all")
          for name in ("score", "prior", "ratio", "noise")),
        (*SCENE[:2], {**EASY, "score": torch.ones(200, requires_grad=True)}, "score requires a gradient, .* passes"),
        (*SCENE[:2], {"estimator": "poselib", "threshold": -1}, "threshold=-1; it must be a number above 0"),
        (np.zeros((9, 2)), np.zeros((9, 2)), {"key": np.array(0.5)}, "key is of torch.float64; it must be whole"),
        (*SCENE[:2], {"size0": (640, 480), "size1": (640, 480)}, r"size1 is \(640, 480\), but .* looks like \(w, h\)"),
        (*SCENE[:2], {"size0": (480, 640), "size1": (48, 64)}, r"size1 is \(48, 64\), but .* of x1 lie outside such"),
        (*FROM_CENTRE, {"size0": (480, 640), "size1": (480, 640)}, r"size0 is .*640\), but .* of x0 lie outside such"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(x0: object, x1: object, options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fmtorch.find_fundamental(x0, x1, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.uint8, torch.int16, torch.uint16, torch.int64])
def test_numbers_of_any_type_are_those_of_float64(kind: torch.dtype) -> None:
    """Points, priors and calibrations of mixed precision or of whole numbers: what they are, not how they are held."""
    x0, x1 = ((torch.from_numpy(x) / 3).to(kind) for x in (SCENE.x0, SCENE.x1))
    K0, K1 = (torch.from_numpy(K).to(torch.float16).to(torch.float64) for K in (known_cameras.K0, known_cameras.K1))
    prior = torch.from_numpy(np.where(SCENE.right, 0.75, 0.25))
    wide = (x0.double(), x1.double(), K0, K1)
    given = fmtorch.find_essential(x0, x1, K0.half(), K1.half(), prior=prior.half(), **EASY)
    expected = fmtorch.find_essential(*wide, prior=prior, **EASY)
    assert torch.equal(given.inliers, expected.inliers)
    torch.testing.assert_close(given.F.double(), expected.F.double(), rtol=0, atol=1e-6)
    small = [x.to(torch.float8_e5m2) for x in (x0, x1)]
    assert torch.equal(fmtorch.find_fundamental(*small).F, fmtorch.find_fundamental(*[x.float() for x in small]).F)
    if kind == torch.uint16:
        assert torch.equal(fmtorch.find_essential(x0.numpy(), x1.numpy(), K0, K1, prior=prior, **EASY).F, expected.F)


def test_masked_complex_and_boolean_points_are_refused() -> None:
    x0, x1 = SCENE.x0, SCENE.x1
    masked = np.ma.masked_array(x0, mask=np.zeros_like(x0, bool))
    assert bool(fmtorch.find_fundamental(masked, x1, **EASY).ok)
    masked[3] = np.ma.masked
    with pytest.raises(ValueError, match="x0 is a masked array; give its data, and what counts in `mask`"):
        fmtorch.find_fundamental(masked, x1)
    with pytest.raises(TypeError, match=r"x1 is a tensor of torch\.complex128; it must hold real numbers"):
        fmtorch.find_fundamental(x0, torch.from_numpy(x1 + 0j))
    with pytest.raises(TypeError, match="x0 holds booleans"):
        fmtorch.find_fundamental(x0 > 0, x1)


def test_raw_distances_are_no_ratios() -> None:
    """They were taken for ratios, and an easy pair had a wrong F or none; a score beyond 1 is refused by its name."""
    distances = np.where(SCENE.right, 120.0, 310.0)
    said = r"^ratio of match 0 of pair 0 is .*within \[0, 1\]\. Of raw distances.*`score`"
    with pytest.raises(ValueError, match=said):
        fmtorch.find_fundamental(SCENE.x0, SCENE.x1, ratio=distances)
    with pytest.raises(ValueError, match=r"^score of match 0 of pair 0 is 310"):
        fmtorch.find_fundamental(SCENE.x0, SCENE.x1, score=np.flip(np.sort(distances)))
    assert bool(fmtorch.find_fundamental(SCENE.x0, SCENE.x1, ratio=distances / 310, **EASY).ok)


def test_a_list_of_single_points_is_one_pair() -> None:
    """As `list(points)` of OpenCV's (n, 1, 2) is; the other points may come in another form."""
    listed = [list(x[:, None]) for x in (SCENE.x0, SCENE.x1)]
    expected = fmtorch.find_fundamental(SCENE.x0, SCENE.x1, **EASY)
    for x0, x1 in (listed, (SCENE.x0, listed[1]), (listed[0], [torch.from_numpy(x) for x in listed[1]])):
        assert torch.equal(fmtorch.find_fundamental(x0, x1, **EASY).F, expected.F)


NUMBERS = "it must be an array or tensor of numbers"
IMAGE = "it must be a file's path, a Pillow image or a uint8 array of NumPy"
PIPELINE = "it must be the name of a preset or a Pipeline"
WRONG_TYPES = {
    "find_fundamental(None, None)": f"TypeError: x0 is a NoneType of object; {NUMBERS}",
    "find_fundamental('ab', 'ab')": f"TypeError: x0 is a str of <U2; {NUMBERS}",
    "find_fundamental([[1, 2], [3]], x)": "TypeError: x0 is a list of uneven rows; it must be an array or a tensor",
    "find_fundamental(x, x, ratio=object())": f"TypeError: ratio is a object of object; {NUMBERS}",
    "find_fundamental([x], [x], prior=0.5)": "ValueError: prior must be a list of 1 arrays, one for each pair of x0",
    "find_fundamental(x, x, lafs1=x)": "ValueError: of lafs0 and lafs1 one is given; give both, or neither",
    "find_fundamental(x, x, estimator=x)": "TypeError: estimator is of type ndarray; it must be the name of a preset",
    "match(None, image)": f"TypeError: image0 is a NoneType; {IMAGE}",
    "match(image, [1, 2])": f"TypeError: image1 is a list; {IMAGE}",
    "match(b'a.jpg', b'b.jpg')": f"TypeError: image0 is a bytes; {IMAGE}",
    "match(torch.zeros(4, 4), image)": f"TypeError: image0 is a Tensor; {IMAGE}",
    "match(image, image, pipeline=None)": f"TypeError: pipeline is a NoneType; {PIPELINE}",
}
CALLS = """
import sys, numpy as np, torch
from fmtorch import find_fundamental, match
x, image = np.zeros((9, 2)), np.zeros((9, 9), np.uint8)
for call in sys.argv[1:]:
    try:
        print("taken", eval(call))
    except Exception as error:
        print(f"{type(error).__name__}: {error}")
"""


def test_wrong_types_are_named(tmp_path: Path) -> None:
    """In a process of its own: the tests' import hook would refuse them before we do."""
    done = run_command("-c", CALLS, *WRONG_TYPES, cwd=tmp_path)
    assert done.stdout.splitlines() == list(WRONG_TYPES.values()), done.stderr


def test_presets_of_ones_own(tmp_path: Path) -> None:
    text = "_target_: fmtorch.estimators.Ransac\nthreshold: 0.5\nhypotheses: 100\n"
    file = write_file(tmp_path / "estimator" / "mine.yaml", text)
    text = "defaults:\n  - override /estimator: mine\n  - override /pruner: [one_to_one, ratio]\n"
    write_file(tmp_path / "pipeline" / "my_pipeline.yaml", f"# @package _global_\n{text}")
    x0, x1 = PAIRS[0].x0[0], PAIRS[0].x1[0]
    own = fmtorch.find_fundamental(x0, x1, estimator="mine", config_dir=tmp_path)
    assert torch.equal(own.F, fmtorch.find_fundamental(x0, x1, threshold=0.5, final="least_squares", **FAST).F)
    file.write_text(file.read_text().replace("0.5", "2.5"))  # edited: read anew
    assert not torch.equal(own.F, fmtorch.find_fundamental(x0, x1, estimator="mine", config_dir=str(tmp_path)).F)
    built = load_pipeline("my_pipeline", config_dir=tmp_path)
    assert list(built.pruners) == ["one_to_one", "ratio"]
    assert built.estimator.search.hypotheses == 100  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=r"no preset 'their_pipeline' in conf/pipeline; there are: .*my_pipeline"):
        load_pipeline("their_pipeline", config_dir=tmp_path)
    with pytest.raises(ValueError, match=r"config_dir=.*nowhere is no folder"):
        load_pipeline("my_pipeline", config_dir=tmp_path / "nowhere")
    with pytest.raises(ValueError, match="no preset 'mine'"):
        fmtorch.find_fundamental(x0, x1, estimator="mine")


def test_an_empty_batch_gives_an_empty_result() -> None:
    estimators = {n: quick(n) for n in variants("estimator") if not n.startswith(OTHER_LIBRARIES[1:])}
    pruners = {name: shown(built("pruner", name)) for name in variants("pruner")}
    for b, n in ((0, 5), (0, 0), (2, 0)):
        numbers, frames, sizes = torch.zeros(b, n), torch.zeros(b, n, 2, 3), torch.ones(b, 2, dtype=torch.int64)
        yes, x = torch.ones(b, n, dtype=torch.bool), torch.zeros(b, n, 2)
        known = {"size0": sizes, "size1": sizes, "mutual": yes, "noise": numbers}
        c = Correspondences(x, x, yes, ratio=numbers, prior=numbers, lafs0=frames, lafs1=frames, **known)
        for name, estimator in estimators.items():
            estimate = estimator(c)
            assert estimate.matrix.shape == (b, 3, 3), name
            assert not bool(estimate.ok.any()), name
        for name, pruner in pruners.items():
            assert pruner(c).compact().mask.shape == (b, 0), name
        assert len(fmtorch.find_fundamental(x, x)) == b
        F = torch.zeros(b, 3, 3)
        assert metrics.nsgd(F, F, sizes, sizes).shape == metrics.nsgd_released(F, F, sizes, sizes).shape == (b,)
        assert metrics.inlier_rate(F, x, x, yes, sizes, sizes).after.shape == (b,)
    assert len(fmtorch.find_fundamental([], [])) == 0


@pytest.mark.parametrize("name", [n for n in variants("estimator") if n.startswith(("opencv", "kornia"))])
def test_estimators_without_gradients_say_so(name: str) -> None:
    x0, x1 = PAIRS[0].x0[0].double(), PAIRS[0].x1[0].double()
    assert bool(fmtorch.find_fundamental(x0, x1, **keywords(name)).ok)
    with pytest.raises(ValueError, match="passes no gradient on"):
        fmtorch.find_fundamental(x0.requires_grad_(), x1, **keywords(name))
    with torch.no_grad():
        assert bool(fmtorch.find_fundamental(x0, x1, **keywords(name)).ok)


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), 0.0])
def test_an_estimator_that_gives_no_matrix_makes_failed_rows(wrong: float, tmp_path: Path) -> None:
    images = [draw(tmp_path / f"{i}.png", seed=0, shift=9 * i) for i in range(3)]
    built = small_pipeline()
    sound = built.estimator

    def spoiled(c: Correspondences, seed: int = 0) -> Estimate:
        estimate = sound(c, seed)
        F = estimate.F.clone()
        F[0] = wrong if wrong != wrong or wrong else 0
        return estimate.replace(matrix=F)

    built.estimator = spoiled
    pairs = [pair(name, images[0], ImageSource(name, image.path)) for name, image in zip("ab", images[1:], strict=True)]
    first, second = evaluate(built.run(pairs))
    assert (first.ok, second.ok) == (False, True)
    assert first.reason == "estimation: F is zero or not finite, though the estimator calls it ok"
    assert first.corrs == 0


def with_wrong(name: str, value: float) -> Correspondences:
    """Two pairs, of which the second has a wrong value of the field."""
    c = collate([scene(0, 60), scene(1, 60)]).replace(noise=torch.ones(2, 60))
    field = getattr(c, name).clone()
    field[1, 1 if name.startswith("size") else 3] = value
    return c.replace(**{name: field})


@pytest.mark.parametrize(("name", "value", "message"), WRONG)
def test_wrong_values_are_named_to_who_gives_them(name: str, value: float, message: str) -> None:
    c = with_wrong(name, value)
    given = {field: getattr(c, field) for field in ("prior", "noise", "size0", "size1")}
    with pytest.raises(ValueError, match=message):
        fmtorch.find_fundamental(c.x0, c.x1, **given)
    if not name.startswith("size"):  # what is masked means nothing
        mask = c.mask.clone()
        mask[1, 3] = False
        masked = fmtorch.find_fundamental(c.x0, c.x1, mask=mask, estimator="msac", hypotheses=50, **given)
        assert bool(masked.ok.all())


def test_sizes_of_one_image_and_points_as_opencv_stores_them_are_refused() -> None:
    c = scene(0, 60)
    for known, missing in (("size0", "size1"), ("size1", "size0")):
        with pytest.raises(ValueError, match=f"{known} is given but {missing} is not"):
            fmtorch.find_fundamental(c.x0, c.x1, **{known: c.size0})
    opencv = [x[0, :, None].numpy() for x in (c.x0, c.x1)]
    with pytest.raises(ValueError, match=r"shape \(60, 1, 2\), as OpenCV stores 60 points; give x0\[:, 0\]"):
        fmtorch.find_fundamental(*opencv)
    batch = fmtorch.find_fundamental(*opencv, mask=np.ones((60, 1), bool), estimator="msac")
    assert not bool(batch.ok.any())
    assert set(batch.reason) == {"1 matches; at least 7 are needed"}


@pytest.mark.parametrize("metric", ["sgd", "nsgd", "nsgd_released", "inlier_rate"])
@pytest.mark.parametrize("wrong", [[0, 640], [480, -640], [float("nan"), 640.0], [float("inf"), 640.0]])
def test_metrics_refuse_sizes_of_no_image(metric: str, wrong: list[float]) -> None:
    F = torch.tensor([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]).expand(3, 3, 3)
    sound = torch.tensor([[480, 640]] * 3, dtype=torch.float64)
    sizes = sound.clone()
    sizes[1] = torch.tensor(wrong)
    x = torch.rand(3, 10, 2)
    points = (F, x, x, torch.ones(3, 10, dtype=torch.bool)) if metric == "inlier_rate" else (F, F)
    function = getattr(metrics, metric)
    assert torch.isfinite(torch.as_tensor(function(*points, sound, sound)[0])).all()
    for name, given in (("size0", (sizes, sound)), ("size1", (sound, sizes))):
        with pytest.raises(ValueError, match=rf"{name} is \(.*\); image sizes \(h, w\) are positive"):
            function(*points, *given)


@pytest.mark.parametrize("name", OWN)
def test_gradients_arrive_or_are_refused_and_change_no_estimate(name: str) -> None:
    def find(attached: str) -> tuple[Tensor, Estimate]:
        values = {key: getattr(C, key).double().requires_grad_(key == attached) for key in ("x0", "x1", "prior")}
        return values.get(attached), fmtorch.find_fundamental(**values, **keywords(name), key=C.key)

    plain = find("")[1]
    assert not plain.F.requires_grad
    for field in ("x0", "prior"):
        if field in REFUSED.get(name, ()):
            said = f"{field} requires a gradient, and the final fit of estimator={name.partition(':')[0]} passes none"
            with pytest.raises(ValueError, match=said):
                find(field)
            with torch.no_grad():
                estimate = find(field)[1]
        else:
            asked, estimate = find(field)
            (gradient,) = torch.autograd.grad(estimate.F.square().sum() + estimate.F.sum(), asked)
            assert bool(gradient.any())
        assert torch.equal(estimate.F.detach(), plain.F)
        assert torch.equal(estimate.inliers, plain.inliers)


def test_a_compiled_model_may_estimate() -> None:
    c = scene(0, 60)
    x1 = c.x1.clone().requires_grad_()

    def loss(x0: Tensor, x1: Tensor) -> Tensor:
        return fmtorch.find_fundamental(x0 * 1.0, x1 + 0.0).F.square().sum(-1).sum()

    expected = torch.autograd.grad(loss(c.x0, x1), x1)[0]
    compiled = torch.compile(loss, backend="eager")
    for _ in range(2):
        assert torch.equal(torch.autograd.grad(compiled(c.x0, x1), x1)[0], expected)


def test_a_list_of_pairs_computes_with_one_thread_of_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine threads of torch wait for one another; pairs have threads of their own."""
    seen = []
    estimated = estimation.estimated_by

    def spied(*arguments: object) -> fmtorch.Estimate:
        seen.append(torch.get_num_threads())
        return estimated(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(estimation, "estimated_by", spied)
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        c = scene(0, 60)
        fmtorch.find_fundamental([c.x0[0]] * 3, [c.x1[0]] * 3)
        assert torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(before)
    assert seen == [1]


def test_an_editor_knows_that_a_pose_is_there() -> None:
    kind = typing.get_type_hints(fmtorch.find_essential)["return"]
    assert kind is fmtorch.PoseEstimate
    assert all(type(None) not in typing.get_args(hint) for hint in map(typing.get_type_hints(kind).get, "ERt"))
    c, K = scene(0, 60), torch.tensor([[800.0, 0, 480], [0, 800, 320], [0, 0, 1]])
    estimate = fmtorch.find_essential(c.x0, c.x1, K, K)
    assert isinstance(estimate[0].to("cpu"), fmtorch.PoseEstimate)
    assert isinstance(fmtorch.find_essential([], [], K, K), fmtorch.PoseEstimate)


def test_keypoints_of_opencv_and_arrays_that_are_shared_are_points() -> None:
    class Shared:
        """An array of another library: DLPack alone."""

        def __init__(self, value: Tensor) -> None:
            self.value = value

        def __dlpack__(self, **options: object) -> object:
            return self.value.__dlpack__(**options)  # type: ignore[arg-type]

        def __dlpack_device__(self) -> object:
            return self.value.__dlpack_device__()

    c = scene(0, 60)
    ends = c.x0[0].float(), c.x1[0].float()
    expected = fmtorch.find_fundamental(*ends).F
    keypoints = [[cv2.KeyPoint(float(x), float(y), 3.0) for x, y in points] for points in ends]
    assert torch.equal(fmtorch.find_fundamental(*keypoints).F, expected)
    assert torch.equal(fmtorch.find_fundamental([keypoints[0]] * 2, [keypoints[1]] * 2).F[1:], expected)
    assert torch.equal(fmtorch.find_fundamental(*map(Shared, ends)).F, expected)
