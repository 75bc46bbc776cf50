"""Robust estimators of OpenCV, kornia and, in the extra `peers`, of PoseLib, fastpose and the methods' authors."""

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core.options import Within
from fmtorch.estimators.external import pairwise
from fmtorch.estimators.external.pairwise import Confidence, Iterations, PairwiseEstimator, PixelPair, Points, Solution
from fmtorch.estimators.refinement import Pixels
from fmtorch.geometry.eight_point import eight_point
from fmtorch.geometry.pose import calibrated


def opencv(
    *, method: str, threshold: Pixels = 1.0, confidence: Confidence = 0.999, iterations: Iterations = 2000,
    essential: Pixels | None = None,
) -> PairwiseEstimator:  # fmt: skip
    """`cv2.findFundamentalMat` with one of its robust methods.

    USAC_PROSAC gets the matches best first, as it expects.

    Args:
        method: name of OpenCV's constant in any case, ransac, lmeds or usac_*; FM_RANSAC and FM_LMEDS as well.
        threshold: pixels, point to epipolar line (ransac) or Sampson distance (usac_*).
        confidence: of having drawn a sample without an outlier, at which the search ends.
        iterations: samples at most.
        essential: focal lengths; with it, where both cameras are known (`find_essential`, cameras=known),
            `cv2.findEssentialMat` at this threshold and `cv2.recoverPose`, as OANet tests pruners.

    Raises:
        ValueError: for a name that is no such constant.
    """
    name = method.upper()
    name = f"FM_{name}" if name in ("RANSAC", "LMEDS") else name
    code = getattr(cv2, name, None)
    if code is None or not name.startswith(("FM_", "USAC_")):
        raise ValueError(f"method is {method!r}; it must be ransac, lmeds, or one of cv2's constants USAC_* or FM_*")

    def solve(pair: PixelPair) -> Solution:
        if essential is not None and pair.exact is not None:
            options = {"method": int(code), "prob": confidence, "threshold": essential, "maxIters": iterations}
            return _of_essential(pair, pair.exact, options)
        F, mask = cv2.findFundamentalMat(pair.x0, pair.x1, int(code), threshold, confidence, iterations)
        return pairwise.without(pair) if mask is None else pairwise.solution(F, mask)

    return PairwiseEstimator(f"OpenCV {name}", solve, best_first=name == "USAC_PROSAC")


def _of_essential(pair: PixelPair, K: tuple[Points, Points], options: Mapping[str, Any]) -> Solution:
    rays = calibrated(pair.x0, K[0]), calibrated(pair.x1, K[1])
    E, mask = cv2.findEssentialMat(*rays, np.eye(3), **options)
    if E is None:
        return pairwise.without(pair)
    # Several where a sample is minimal, of which that counts which has most matches in front of both cameras.
    poses = [(each, *cv2.recoverPose(each, *rays, mask=mask.copy())) for each in E.reshape(-1, 3, 3)]
    best, _, R, t, _ = max(poses, key=lambda pose: pose[1])
    return pairwise.posed(K, R, t, mask > 0, best)


def weighted_eight_point(*, best: Annotated[float, Within(0, 1)] = 0.1) -> PairwiseEstimator:
    """The eight-point algorithm on all matches, weighted by P(inlier), without samples.

    So Yi et al. (CVPR 2018) and their successors test pruners without RANSAC: each match has the weight
    ``relu(tanh(logit P))``, zero where P is at most 1/2. Where both cameras are known (`find_essential`, cameras=known)
    coordinates are calibrated, and the matrix is not projected onto essential ones.

    Args:
        best: share of the matches, those of the largest P, by whose depths the pose is chosen.
    """

    def solve(pair: PixelPair) -> Solution:
        p, K = pair.likelihood, pair.exact
        weight = np.maximum(2 * p - 1, 0) / (p**2 + (1 - p) ** 2)
        if np.count_nonzero(weight) < pairwise.MIN_MATCHES:
            return Solution(None, weight > 0)
        if K is None:
            x0, x1, w = (torch.from_numpy(value)[None] for value in (pair.x0, pair.x1, weight))
            return Solution(eight_point(x0, x1, w)[0][0].numpy(), weight > 0)
        rays0, rays1 = calibrated(pair.x0, K[0]), calibrated(pair.x1, K[1])
        X = (np.insert(rays1, 2, 1, 1)[:, :, None] * np.insert(rays0, 2, 1, 1)[:, None]).reshape(-1, 9)
        E = np.linalg.eigh((X * weight[:, None]).T @ X)[1][:, 0].reshape(3, 3)
        kept = p >= np.sort(p)[::-1][min(max(1, int(best * len(p))), len(p) - 1)]
        _, R, t, _ = cv2.recoverPose(E, rays0[kept], rays1[kept])
        return pairwise.posed(K, R, t, weight > 0, E)

    return PairwiseEstimator("the weighted eight-point algorithm", solve)


def kornia_ransac(
    *, threshold: Pixels = 1.0, confidence: Confidence = 0.9999, batch_size: int = 2048, rounds: int = 10,
    prosac: bool = True,
) -> PairwiseEstimator:  # fmt: skip
    """`kornia.geometry.RANSAC` with MSAC scores.

    Args:
        threshold: pixels.
        confidence: of having drawn a sample without an outlier, at which the search ends.
        batch_size: samples that are drawn together.
        rounds: batches at most.
        prosac: draw samples from the best matches first.
    """

    import kornia  # nobody else's estimator waits for it

    def solve(pair: PixelPair) -> Solution:
        estimator = kornia.geometry.RANSAC(
            "fundamental", inl_th=threshold, batch_size=batch_size, max_iter=rounds, confidence=confidence,
            prosac_sampling=prosac, seed=pair.seed,
        )  # fmt: skip
        x0, x1, weights = (torch.from_numpy(a).to(torch.float32) for a in (pair.x0, pair.x1, pair.likelihood))
        return pairwise.solution(*estimator(x0, x1, weights))

    return PairwiseEstimator("kornia", solve, best_first=prosac)


# MAGSAC++, GC-RANSAC, DEGENSAC and SupeRANSAC as their authors published them (extra `peers`)

Part = TypeVar("Part", int, str)

MAX_SEED = 2**31 - 1  # of 32 bits, as DEGENSAC takes them
SAMPLERS = {"uniform": 0, "prosac": 1, "progressive_napsac": 2, "importance": 3, "adaptive": 4}
"""The numbers of the samplers in the authors' bindings of MAGSAC++ and GC-RANSAC."""
SUPERANSAC_SAMPLERS = {
    "uniform": "Uniform", "prosac": "PROSAC", "importance": "ImportanceSampler", "adaptive": "ARSampler",
}  # fmt: skip
SUPERANSAC_SCORES = {"ransac": "RANSAC", "msac": "MSAC", "magsac": "MAGSAC"}
"""The names of the parts in the binding of SupeRANSAC."""


@pairwise.computed_by("pymagsac")
def magsac_cpp(
    *, threshold: Pixels = 3.0, confidence: Confidence = 0.9999, iterations: Iterations = 10000,
    sampler: str = "adaptive",
) -> PairwiseEstimator:  # fmt: skip
    """MAGSAC++ by its authors (Barath et al., CVPR 2020), which draws its own random seed.

    Args:
        threshold: pixels, the largest noise scale.
        confidence, iterations: as of `opencv`.
        sampler: one of `SAMPLERS`.

    Raises:
        ImportError: where `pymagsac` is not installed.
        ValueError: for another sampler.
    """
    number, library = _named("sampler", sampler, SAMPLERS), pairwise.peer("pymagsac", "MAGSAC++")

    def solve(pair: PixelPair) -> Solution:
        (h0, w0), (h1, w1) = pair.size0, pair.size1
        weights = pair.likelihood.tolist() if number > 2 else []
        F, inside = library.findFundamentalMatrix(
            pair.joined, w0, h0, w1, h1, weights, number, True, threshold, confidence, 50, iterations, 5
        )
        return pairwise.solution(F, inside)

    return PairwiseEstimator("MAGSAC++", solve, best_first=number in (1, 2))


@pairwise.computed_by("pygcransac")
def gc_ransac_cpp(
    *, threshold: Pixels = 1.0, confidence: Confidence = 0.9999, iterations: Iterations = 10000,
    sampler: str = "prosac", coherence: float = 0.975,
) -> PairwiseEstimator:  # fmt: skip
    """GC-RANSAC by its authors (Barath & Matas, CVPR 2018), which draws its own random seed.

    Inliers are told from its F: the flags that its binding returns (pygcransac 0.1.1) are all set, or none.

    Args:
        threshold: pixels, Sampson distance.
        confidence, iterations: as of `opencv`.
        sampler: one of `SAMPLERS`.
        coherence: weight of the spatial term.

    Raises:
        ImportError: where `pygcransac` is not installed.
        ValueError: for another sampler.
    """
    number, library = _named("sampler", sampler, SAMPLERS), pairwise.peer("pygcransac", "GC-RANSAC")

    def solve(pair: PixelPair) -> Solution:
        weights = pair.likelihood.tolist() if number > 2 else []
        F, _ = library.findFundamentalMatrix(
            pair.joined, *pair.size0, *pair.size1, weights, threshold, confidence, coherence, iterations, 50, True,
            1e-5, number,
        )  # fmt: skip
        return pairwise.solution(F, [] if F is None else pairwise.within(F, pair, threshold))

    return PairwiseEstimator("GC-RANSAC", solve, best_first=number in (1, 2))


@pairwise.computed_by("pydegensac")
def degensac_cpp(
    *, threshold: Pixels = 0.5, confidence: Confidence = 0.9999, iterations: Iterations = 10000
) -> PairwiseEstimator:
    """DEGENSAC by its authors (Chum et al., CVPR 2005; Mishkin et al., 2015).

    Args:
        threshold: pixels, Sampson distance.
        confidence, iterations: as of `opencv`.

    Raises:
        ImportError: where `pydegensac` is not installed.
    """
    library = pairwise.peer("pydegensac", "DEGENSAC")

    def solve(pair: PixelPair) -> Solution:
        F, inside = library.findFundamentalMatrix(
            pair.x0, pair.x1, threshold, confidence, iterations, seed=pair.seed % (MAX_SEED - 1) + 1
        )
        return pairwise.solution(F, inside)

    return PairwiseEstimator("DEGENSAC", solve)


@pairwise.computed_by("pysuperansac")
def superansac_cpp(
    *, threshold: Pixels = 1.5, confidence: Confidence = 0.9999, iterations: Iterations = 10000,
    sampler: str = "prosac", score: str = "magsac",
) -> PairwiseEstimator:  # fmt: skip
    """SupeRANSAC by its author (Barath, arXiv 2506.04803), with nested RANSAC and a final iterated least-squares fit.

    It takes no seed. Its graph cut and progressive NAPSAC are left out: they refuse negative coordinates.

    Args:
        threshold: pixels.
        confidence, iterations: as of `opencv`.
        sampler: one of `SUPERANSAC_SAMPLERS`.
        score: one of `SUPERANSAC_SCORES`.

    Raises:
        ImportError: where `pysuperansac` is not installed.
        ValueError: for another sampler or score.
    """
    named = _named("sampler", sampler, SUPERANSAC_SAMPLERS), _named("score", score, SUPERANSAC_SCORES)
    library = pairwise.peer("pysuperansac", "SupeRANSAC")

    def solve(pair: PixelPair) -> Solution:
        settings = library.RANSACSettings()  # each call divides its threshold by the scale of the points
        settings.sampler = getattr(library.SamplerType, named[0])
        settings.scoring = getattr(library.ScoringType, named[1])
        settings.inlier_threshold, settings.confidence = threshold, confidence
        settings.min_iterations, settings.max_iterations = min(1000, iterations), iterations
        (h0, w0), (h1, w1) = pair.size0, pair.size1
        weights = pair.likelihood.tolist() if sampler in ("importance", "adaptive") else []
        F, indices, _, _ = library.estimateFundamentalMatrix(pair.joined, [w0, h0, w1, h1], weights, settings)
        inliers = np.zeros(len(pair.x0), dtype=np.bool_)
        inliers[indices] = True
        return pairwise.solution(F, inliers)

    return PairwiseEstimator("SupeRANSAC", solve, best_first=sampler == "prosac")


def _named(option: str, name: str, choices: Mapping[str, Part]) -> Part:
    """What an option's value stands for; raises ValueError for a name that is not among its choices."""
    if name not in choices:
        raise ValueError(f"{option} is {name!r}; it must be one of: {', '.join(choices)}")
    return choices[name]


LOSSES = ("trivial", "truncated", "huber", "cauchy", "truncated_cauchy", "truncated_le_zach")
"""The robust losses of its refinement."""


@pairwise.computed_by("poselib")
def poselib(
    *, threshold: Pixels = 1.0, confidence: Confidence = 0.9999, iterations: Iterations = 10000,
    min_iterations: int = 1000, prosac: bool = False, loss: str | None = None, loss_scale: Pixels | None = None,
    real_focal_check: bool = False, shared_focal: bool = False,
) -> PairwiseEstimator:  # fmt: skip
    """PoseLib's LO-RANSAC for fundamental matrices, or for two cameras of one unknown focal length (Larsson 2020).

    Where both focal lengths are exactly known (`find_essential`, `cameras=known`) it estimates a relative pose.

    Args:
        threshold: pixels, Sampson distance.
        confidence, iterations: as of `opencv`.
        min_iterations: samples at least, though not more than at most.
        prosac: draw samples from the best matches first.
        loss: of the non-linear refinement, one of `LOSSES`; PoseLib's own if not given.
        loss_scale: pixels; PoseLib's own, half the threshold, if not given.
        real_focal_check: reject samples whose models give an imaginary focal length for square pixels and central
            principal points.
        shared_focal: estimate a relative pose and one focal length, for square pixels and central principal points.
            Pairs whose images differ in size get a fundamental matrix all the same.

    Raises:
        ImportError: with a hint, where PoseLib is not installed.
        ValueError: for another loss, for both of the last two options, or where this version of PoseLib lacks one.
    """
    if real_focal_check and shared_focal:
        raise ValueError("real_focal_check is of fundamental matrices alone: leave it out, or shared_focal")
    library = pairwise.peer("poselib", "PoseLib")
    options = {
        "max_epipolar_error": threshold, "success_prob": confidence, "max_iterations": iterations,
        "min_iterations": min(min_iterations, iterations), "progressive_sampling": prosac,
    }  # fmt: skip
    if real_focal_check:
        if "real_focal_check" not in library.RansacOptions():
            raise ValueError("this version of PoseLib has no real_focal_check; 2.0.4 and later have it")
        options["real_focal_check"] = True
    if loss is not None and loss not in LOSSES:
        raise ValueError(f"loss is {loss!r}; it must be one of: {', '.join(LOSSES)}")
    chosen = {"loss_type": loss and loss.upper(), "loss_scale": loss_scale}
    refinement = {name: value for name, value in chosen.items() if value is not None}  # else PoseLib's own

    def solve(pair: PixelPair) -> Solution:
        seeded = {**options, "seed": pair.seed}
        if pair.exact is not None:
            return _relative_pose(library, pair, seeded, refinement)
        if shared_focal and pair.size0 == pair.size1:
            return _shared_focal(library, pair, seeded, refinement)
        centres = [_centre(size) * real_focal_check for size in (pair.size0, pair.size1)]
        F, info = library.estimate_fundamental(pair.x0 - centres[0], pair.x1 - centres[1], seeded, refinement)
        to_centre = [np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1]]) for x, y in centres]
        return pairwise.solution(to_centre[1].T @ F @ to_centre[0], info["inliers"])

    name = "PoseLib, shared focal length" if shared_focal else "PoseLib"
    return PairwiseEstimator(name, solve, best_first=prosac)


def _relative_pose(library: Any, pair: PixelPair, options: dict[str, Any], refinement: dict[str, Any]) -> Solution:
    """The relative pose of two calibrated cameras; their lenses have no distortion."""
    assert pair.exact is not None
    cameras = [
        {"model": "PINHOLE", "width": w, "height": h, "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
        for K, (h, w) in zip(pair.exact, (pair.size0, pair.size1), strict=True)
    ]
    pose, info = library.estimate_relative_pose(pair.x0, pair.x1, *cameras, options, refinement)
    return pairwise.posed(pair.exact, pose.R, pose.t, info["inliers"])


def _shared_focal(library: Any, pair: PixelPair, options: dict[str, Any], refinement: dict[str, Any]) -> Solution:
    """The fundamental matrix of the relative pose and the one focal length of two images of one size."""
    centre = _centre(pair.size0)
    image_pair, info = library.estimate_shared_focal_relative_pose(pair.x0, pair.x1, centre, options, refinement)
    focal, pose = image_pair.camera1.params[0], image_pair.pose
    if not (np.isfinite(focal) and focal > 0):
        return pairwise.without(pair)
    to_ray = np.array([[1 / focal, 0, -centre[0] / focal], [0, 1 / focal, -centre[1] / focal], [0, 0, 1]])
    F = to_ray.T @ np.cross(np.eye(3), np.asarray(pose.t)).T @ np.asarray(pose.R) @ to_ray
    return pairwise.solution(F, info["inliers"])


def _centre(size: tuple[int, int]) -> NDArray[np.float64]:
    return (np.array(size[::-1], np.float64) - 1) / 2


FOCALS = ("shared", "varying")
MODELS = ("fundamental", "homography")


@pairwise.computed_by("fastpose")
def fastpose(
    *, threshold: Pixels = 1.0, confidence: Confidence = 0.9999, iterations: Iterations = 10000,
    min_iterations: int = 1000, model: str = "fundamental", focal: str | None = None,
) -> PairwiseEstimator:  # fmt: skip
    """fastpose's LO-RANSAC, whose kernels numba compiles at the first call.

    Where both focal lengths are exactly known (`find_essential`, `cameras=known`) it estimates a relative pose, and
    where cameras with unknown focal lengths are asked for, these with the pose.

    Args:
        threshold: pixels; Sampson distance, for homographies the root mean square of both transfer errors.
        confidence, iterations: as of `opencv`.
        min_iterations: samples at least, though not more than at most.
        model: fundamental or homography.
        focal: shared or varying: estimate a relative pose with one unknown focal length or two, for square pixels and
            central principal points, even where no cameras are asked for.

    Raises:
        ImportError: with a hint, where fastpose is not installed.
        ValueError: for another model or `focal`, or for both.
    """
    if model not in MODELS or focal not in (None, *FOCALS):
        raise ValueError(f"model is {model!r} and focal {focal!r}; they must be of {MODELS} and {(None, *FOCALS)}")
    if model == "homography" and focal is not None:
        raise ValueError(f"focal={focal} is of fundamental matrices; leave it out, or model=homography")
    library = pairwise.peer("fastpose", "fastpose").estimators
    options = {"iterations": iterations, "min_iterations": min(min_iterations, iterations), "success_prob": confidence}

    def solve(pair: PixelPair) -> Solution:
        own: dict[str, Any] = {**options, "max_error": threshold, "seed": pair.seed % 2**32}
        if model == "homography":
            result, info = library.estimate_homography(pair.x0, pair.x1, **own)
            return pairwise.solution(result["H"], info["inliers"])
        if pair.exact is not None:
            result, info = library.estimate_relative_pose(pair.x0, pair.x1, *pair.exact, **own)
            return _of_fastpose(pair, result, info, pair.exact)
        kind = focal or (("varying", "shared")[pair.shared_focal] if pair.calibrations == (None, None) else None)
        if kind is not None:
            call = getattr(library, f"estimate_relative_pose_with_{kind}_focal{'s' * (kind == 'varying')}")
            centres = [_centre(size) for size in (pair.size0, pair.size1)]
            result, info = call(pair.x0, pair.x1, *centres, **own)
            focals = [result[name] for name in (("f", "f") if kind == "shared" else ("f1", "f2"))]
            ends = zip(focals, centres, strict=True)
            K0, K1 = (np.array([[f, 0, x], [0, f, y], [0, 0, 1]]) for f, (x, y) in ends)
            return _of_fastpose(pair, result, info, (K0, K1), np.array(focals))
        result, info = library.estimate_fundamental(pair.x0, pair.x1, **own)
        return pairwise.solution(result["F"], info["inliers"])

    return PairwiseEstimator("fastpose", solve, model=model)


def _of_fastpose(pair: PixelPair, result: Any, info: Any, K: tuple[Points, Points], focals: Any = None) -> Solution:
    if not info["num_inliers"]:
        return pairwise.without(pair)
    return pairwise.posed(K, result["R"], result["t"], info["inliers"], focals=focals)
