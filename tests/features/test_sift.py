"""SIFT of OpenCV and of VLFeat, ASIFT, patches and SIFT of patches; detection by the Hessian, orientation of frames."""

from importlib.util import find_spec
from pathlib import Path

import cv2
import kornia
import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch import features
from fmtorch.features import SIFT, ImagePyramid, PatchSIFT, VLFeatSIFT, hessian, networks, project
from tests.conftest import oracle, shared_path
from tests.features.scenes import random_frames, texture
from tests.helpers import same
from tests.reference.local_features import dominant_gradient as reference_orientation
from tests.reference.local_features import hessian_keypoints, patch, sift

needs_vlfeat = pytest.mark.skipif(find_spec("pycolmap") is None, reason="extra colmap is not installed")
VLFEAT = VLFeatSIFT(peak_threshold=0.01)
TURNS = [(SIFT(), (160, 200), 0.1, 0.9), pytest.param(VLFEAT, (120, 160), 0.05, 0.95, marks=needs_vlfeat)]


@pytest.mark.parametrize("number", ["000", "001"])
@pytest.mark.parametrize("case", ["default", "n1000_ct02"])
def test_equals_stored_keypoints(number: str, case: str) -> None:
    file = oracle("sift.npz")
    options = {"default": (8000, 0.04), "n1000_ct02": (1000, 0.02)}[case]
    found = features.SIFT(*options, precise_upscale=False)(file[f"{number}.image"])
    expected = {name: file[f"{number}.{case}.{name}"] for name in ("xy", "size", "angle", "response", "desc")}
    np.testing.assert_array_equal(found.keypoints, expected["xy"])
    np.testing.assert_array_equal(found.scores, expected["response"])
    # OpenCV rounds to whole numbers what it sums in vectors of the processor's width: relative errors of 1e-7 of up to
    # 255 are some 3e-5, and so cross a half in 6e-5 of the entries.
    difference = np.abs(found.descriptors.numpy() - expected["desc"])
    assert difference.max() <= 1
    assert np.count_nonzero(difference) < 1e-4 * difference.size
    assert found.image_size.tolist() == [512, 768]
    # Frames through kornia's own readers; angles in degrees carry a float32 rounding of about 2e-5.
    scale = kornia.feature.get_laf_scale(found.lafs[None])[0, :, 0, 0]
    np.testing.assert_allclose(scale, features.FRAME_SIGMAS * expected["size"] / 2, rtol=1e-6)
    angle = kornia.feature.get_laf_orientation(found.lafs[None])[0, :, 0]
    difference = (angle.numpy() + expected["angle"] + 180) % 360 - 180
    assert np.abs(difference).max() < 1e-3


@pytest.mark.parametrize(("extract", "size", "gap", "share"), TURNS)
def test_frames_turn_with_the_image(extract, size, gap, share):
    # Turning an image by 90 degrees maps (x, y) to (y, w - 1 - x); frames must follow. OpenCV rounds the upright
    # direction into 36 bins, which 90 degrees respects; the blurred pyramid is symmetric up to float rounding.
    image = texture(3, *size)
    expected, turned = torch.tensor([[0.0, 1.0], [-1.0, 0.0]]) @ extract(image).lafs, extract(np.rot90(image)).lafs
    expected[..., 2] += torch.tensor([0.0, image.shape[1] - 1.0])
    gaps = (expected[:, None] - turned[None]).abs().amax((2, 3)).amin(1)
    assert len(expected) > 50
    assert (gaps < gap).float().mean() > share


def test_root_sift_compares_by_hellinger() -> None:
    plain, root = features.SIFT()(texture(1)), features.SIFT(root=True)(texture(1))
    torch.testing.assert_close(root.descriptors.square() * plain.descriptors.sum(-1, keepdim=True), plain.descriptors)
    torch.testing.assert_close(root.descriptors.norm(dim=-1), torch.ones(len(root)))
    assert not features.root_sift(torch.zeros(1, 128)).any()


def test_views_are_the_published_ones() -> None:
    # Morel and Yu: tilts sqrt(2)^k, longitudes 72 / t apart below 180 degrees.
    views = features.simulated_views(6)
    tilts = [t for t, _ in views]
    counts = [tilts.count(t) for t in sorted(set(tilts))]
    assert (counts, views[0]) == ([1, 4, 5, 8, 10, 15], (1.0, 0.0))
    assert max(angle for _, angle in views) < 180
    with pytest.raises(ValueError, match="at least one"):
        features.simulated_views(0)


@pytest.mark.parametrize(("tilt", "angle"), [(2**0.5, 0.0), (2.0, 36.0), (4.0, 126.0)])
def test_a_view_shows_the_image_where_its_map_says(tilt: float, angle: float) -> None:
    # A slow wave loses nothing by blur and interpolation, so the view must show it at the mapped places.
    y, x = np.mgrid[0:120, 0:160]
    wave = 128 + 60 * np.sin(x / 15) + 60 * np.cos(y / 18)
    view, to_view = features.simulate_view(wave.round().astype(np.uint8), tilt, angle)
    points = np.random.default_rng(0).uniform((30, 30), (129, 89), (500, 2))
    u, v = (to_view[:, :2] @ points.T + to_view[:, 2:]).astype(np.float32)
    found = cv2.remap(view.astype(np.float32), u[:, None], v[:, None], cv2.INTER_LINEAR)[:, 0]
    expected = 128 + 60 * np.sin(points[:, 0] / 15) + 60 * np.cos(points[:, 1] / 18)
    # Roundings to 8 bits, 3 * 0.5; interpolation and the blur of sigma 0.8 sqrt(t^2 - 1) <= 3.1 px lose less than
    # 60 (1 - exp(-3.1^2 / (2 * 15^2))) = 1.3 of each amplitude; linear interpolation over t <= 4 px 60 (4 / 15)^2 / 8.
    assert np.abs(found - expected).max() < 1.5 + 2.6 + 0.6 * 2
    corners = to_view[:, :2] @ np.array([[0, 159, 0, 159], [0, 0, 119, 119]]) + to_view[:, 2:]
    assert corners.min() > -1e-9
    assert (corners.max(1) <= np.array(view.shape[::-1]) - 1 + 1).all()


def test_one_tilt_is_sift() -> None:
    image = texture(0)
    assert same(features.ASIFT(tilts=1, max_features=8000)(image), features.SIFT()(image))


def test_frames_carry_the_view() -> None:
    image = texture(1)
    found = features.ASIFT(tilts=3)(image)
    assert len(found) > 2 * len(features.SIFT()(image))
    singular = torch.linalg.svdvals(found.lafs[..., :2].double())
    elongation = singular[:, 0] / singular[:, 1]
    nearest = torch.stack([(elongation - t).abs() for t in (1, 2**0.5, 2)]).amin(0)
    assert nearest.max() < 1e-3  # float32 entries
    for t in (2**0.5, 2):  # what the view reduced along its x was longer in the image
        assert ((elongation - t).abs() < 1e-3).sum() > 20
    centres = found.keypoints
    assert (centres >= 0).all()
    assert (centres <= torch.tensor([199.0, 159.0])).all()


def error(found: torch.Tensor, expected: np.ndarray) -> float:
    return float(255 * np.sqrt(np.mean((found.numpy() - expected) ** 2)))


@pytest.mark.parametrize("side", [8.0, 15.0, 24.0, 45.0, 90.0, 160.0])
def test_sees_what_a_camera_would(side: float) -> None:
    # Noise with detail down to a camera's blur: what is not averaged away is aliased.
    image = texture(0, 800, 800, sigma=0.8)
    lafs = random_frames(1, 5, 40, 40, side, side * 1.2)
    lafs[..., 2] += 380
    expected = np.stack([patch(image / 255, laf.double().numpy(), dense=4) for laf in lafs])
    ours = error(features.ImagePyramid(image).extract(lafs)[:, 0], expected)
    tensor = torch.from_numpy(image)[None, None].float() / 255
    plain = error(kornia.feature.extract_patches_simple(tensor, lafs[None])[0, :, 0], expected)
    peer = error(kornia.feature.extract_patches_from_pyramid(tensor, lafs[None])[0, :, 0], expected)
    assert ours < 1.05 * peer
    if side > 40:
        assert ours < 0.3 * plain


def test_small_frames_are_kornias_patches() -> None:
    # Where pixels of the patch are denser than the image's, both interpolate the image itself.
    image, lafs = texture(0), random_frames(0, 30, 160, 200, 3, 14)
    lafs = torch.cat([lafs[..., :2] * 0.8, lafs[..., 2:]], -1)
    tensor = torch.from_numpy(image)[None, None].float() / 255
    expected = kornia.feature.extract_patches_simple(tensor, lafs[None])[0]
    torch.testing.assert_close(features.ImagePyramid(image).extract(lafs), expected, atol=2e-4, rtol=0)


def test_neighbours_are_invisible() -> None:
    image, lafs = texture(4), random_frames(4, 40, 160, 200)
    lafs[7] = torch.nan
    lafs[9, 0, 0] = torch.inf
    together = features.ImagePyramid(image).extract(lafs)
    assert torch.isfinite(together).all()
    assert not together[[7, 9]].any()
    for i in (0, 8, 39):
        assert torch.equal(features.ImagePyramid(image).extract(lafs[i : i + 1])[0], together[i])
    assert features.ImagePyramid(image).extract(lafs[:0]).shape == (0, 1, 32, 32)


@pytest.mark.parametrize("shape", [(1, 1), (1, 90), (70, 1), (5, 7), (31, 33)])
def test_small_images_continue_at_their_border(shape: tuple[int, int]) -> None:
    flat = np.full(shape, 51, np.uint8)
    lafs = features.upright_frames(torch.tensor([[0.0, 0.0], [3.0, 2.0]]), torch.tensor([1.0, 40.0]))
    torch.testing.assert_close(features.ImagePyramid(flat).extract(lafs), torch.full((2, 1, 32, 32), 0.2))


def test_equals_the_definition() -> None:
    patches = features.ImagePyramid(texture(0)).extract(random_frames(0, 20, 160, 200))
    expected = np.stack([sift(p[0].double().numpy()) for p in patches])
    np.testing.assert_allclose(features.sift_of_patches(patches), expected, atol=2e-5)


def test_domain_sizes_are_averaged() -> None:
    pyramid, lafs = features.ImagePyramid(texture(1)), random_frames(1, 30, 160, 200)
    pooled = features.PatchSIFT(smallest=0.5, largest=2.0, sizes=4)(pyramid, lafs)
    single = []
    for size in (0.5, 1.0, 1.5, 2.0):
        scaled = lafs.clone()
        scaled[..., :2] *= size
        single.append(features.PatchSIFT()(pyramid, scaled))
    mean = torch.stack(single).mean(0)
    torch.testing.assert_close(pooled, mean / mean.norm(dim=1, keepdim=True))
    root = features.PatchSIFT(root=True)(pyramid, lafs)
    torch.testing.assert_close(root, features.root_sift(features.PatchSIFT()(pyramid, lafs)))


def test_unaffected_by_light_and_neighbours() -> None:
    patches = features.ImagePyramid(texture(3)).extract(random_frames(3, 150, 160, 200))
    together = features.sift_of_patches(patches)
    torch.testing.assert_close(features.sift_of_patches(0.3 * patches + 0.2), together, atol=1e-4, rtol=0)
    torch.testing.assert_close(features.sift_of_patches(patches[70:71]), together[70:71], atol=1e-5, rtol=0)
    flat = features.sift_of_patches(torch.full((2, 1, 32, 32), 0.5))
    assert not flat.any()
    assert features.sift_of_patches(patches[:0]).shape == (0, 128)


def test_projection_keeps_the_variance() -> None:
    x = torch.randn(3000, 128, generator=torch.Generator().manual_seed(0)) * torch.linspace(2, 0.01, 128) + 1
    mean, basis = features.learn_projection(x, 20)
    torch.testing.assert_close(mean, x.mean(0), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(basis.T @ basis, torch.eye(20), atol=1e-5, rtol=0)
    variance = ((x - mean) @ basis).var(0)
    assert (variance.diff() < 0).all()
    singular = torch.linalg.svdvals(x - x.mean(0))[:20].square() / (len(x) - 1)
    torch.testing.assert_close(variance, singular, rtol=1e-3, atol=0)
    projected = project(x, mean, basis, 0.5)
    torch.testing.assert_close(projected.norm(dim=1), torch.ones(len(x)))
    plain = (x - mean) @ basis
    assert torch.equal(projected.sign(), plain.sign())
    torch.testing.assert_close(projected[0].square() / projected[0, 0] ** 2, plain[0].abs() / plain[0, 0].abs())


def test_a_projection_that_is_absent_or_broken(tmp_path: Path) -> None:
    pyramid, lafs = features.ImagePyramid(texture(5)), random_frames(5, 2, 160, 200)
    with pytest.raises(FileNotFoundError, match=r"absent\.npz.*make_models"):
        features.RootSIFTPCA(model=tmp_path / "absent.npz")(pyramid, lafs)
    (tmp_path / "text.npz").write_text("no projection")
    np.savez(tmp_path / "shape.npz", mean=np.zeros(5), basis=np.zeros((128, 80)))
    np.savez(tmp_path / "names.npz", average=np.zeros(128))
    for name in ("text", "shape", "names"):
        with pytest.raises(ValueError, match=rf"{name}\.npz.*make_models"):
            features.RootSIFTPCA(model=tmp_path / f"{name}.npz")(pyramid, lafs)


@pytest.mark.parametrize("number", ["000", "001"])
def test_resembles_opencvs_descriptors(number: str) -> None:
    file = oracle("sift.npz")
    image = file[f"{number}.image"]
    found = SIFT()(image)
    ours = PatchSIFT()(ImagePyramid(image), found.lafs)
    theirs = found.descriptors / found.descriptors.norm(dim=1, keepdim=True)
    cosine = (ours * theirs).sum(1)
    assert cosine.median() > 0.99
    assert cosine.quantile(0.05) > 0.95


@needs_vlfeat
def test_vlfeat_agrees_with_opencv_where_both_find_a_keypoint() -> None:
    image = cv2.resize(texture(5), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    ours, opencv = VLFeatSIFT(peak_threshold=0.005)(image), SIFT()(image)
    distance, i = torch.cdist(opencv.keypoints, ours.keypoints).min(1)
    near = distance < 0.3
    assert near.sum() > 30
    a, b = ours.lafs[i[near]], opencv.lafs[near]
    assert (a - b)[..., 2].median(0).values.abs().max() < 0.05
    assert ((a[..., 0] - b[..., 0]).norm(dim=1) / b[..., 0].norm(dim=1)).median() < 0.1
    between = (ours.descriptors[i[near]] - opencv.descriptors[near]).norm(dim=1)
    assert between.median() < 0.3 * 512  # of vectors of length 512


def keypoints(detector: features.HessianDetector, image: np.ndarray) -> np.ndarray:
    """Rows (x, y, sigma, response)."""
    lafs, scores = detector.detect(image)
    return torch.cat([lafs[:, :, 2], lafs[:, :1, 0] / features.FRAME_SIGMAS, scores[:, None]], 1).double().numpy()


@pytest.mark.parametrize("levels", [2, 3])
def test_hessian_keypoints_equal_the_definition(levels: int) -> None:
    image = texture(0, hessian.STRIP + 11, 61)  # worked on in two strips
    expected = hessian_keypoints(image / 255, 1e-4, levels)
    found = keypoints(features.HessianDetector(levels=levels, border=0.0), image)
    assert len(found) == len(expected) > 15
    expected = expected[np.argsort(-expected[:, 3])]
    # float32 filters: rounding of 2^-24 of intensities against differences of about 0.01.
    np.testing.assert_allclose(found[:, :3], expected[:, :3], atol=2e-3)
    np.testing.assert_allclose(found[:, 3], expected[:, 3], rtol=1e-3)


def test_of_equal_neighbours_one_remains() -> None:
    # A blob centred between two pixels: their responses are equal in exact arithmetic.
    y, x = np.mgrid[0:60, 0:61]
    blob = np.exp(-((x - 29.5) ** 2 + (y - 30) ** 2) / (2 * 3.0**2))
    found = keypoints(features.HessianDetector(), (100 + 100 * blob).round().astype(np.uint8))
    assert (np.abs(found[:, :2] - [29.5, 30]) < 0.1).all(1).sum() == 1


def test_hessian_keypoints_keep_from_the_border() -> None:
    h, w = 100, 120
    for border in (0.0, 3.0, 6.0):
        x, y, sigma = keypoints(features.HessianDetector(border=border), texture(2, h, w))[:, :3].T
        room = np.min([x, y, w - 1 - x, h - 1 - y], 0)
        assert (room >= border * sigma - 1e-3).all()
        assert len(room) > 10


def test_frame_algebra_is_kornias() -> None:
    lafs = random_frames(0, 50, 100, 100)
    torch.testing.assert_close(features.frame_scale(lafs), kornia.feature.get_laf_scale(lafs[None])[0, :, 0, 0])
    upright = kornia.feature.make_upright(lafs[None])[0]
    torch.testing.assert_close(features.make_upright(lafs), upright, rtol=1e-4, atol=1e-4)
    angle = torch.linspace(-3, 3, 50)
    turned = kornia.feature.rotate_laf(lafs[None], torch.rad2deg(angle)[None, :, None])[0]
    torch.testing.assert_close(features.rotate_frames(lafs, angle), turned, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(features.make_upright(turned), features.make_upright(lafs), rtol=1e-4, atol=1e-3)


def test_orientation_equals_the_definition() -> None:
    patches = features.ImagePyramid(texture(0)).extract(random_frames(0, 25, 160, 200))
    expected = torch.tensor([reference_orientation(p[0].double().numpy()) for p in patches])
    differences = (features.dominant_gradient(patches) - expected + np.pi) % (2 * np.pi) - np.pi
    assert differences.abs().max() < 1e-4
    assert torch.isfinite(features.dominant_gradient(torch.full((2, 1, 32, 32), 0.3))).all()


@pytest.mark.parametrize("part", [features.NetworkShape, features.NetworkOrientation])
def test_no_frames(part: type) -> None:
    def network(patches: Tensor) -> Tensor:
        raise AssertionError("called without patches")

    assert part(network)(features.ImagePyramid(texture(0)), torch.zeros(0, 2, 3)).shape == (0, 2, 3)
    assert features.dominant_gradient(torch.zeros(0, 1, 32, 32)).shape == (0,)


def test_shape_is_composed_as_kornias() -> None:
    # The same numbers for a frame through both: kornia's network is replaced by one that gives known numbers.
    lafs = random_frames(5, 64, 160, 200)
    numbers = torch.empty(64, 3).uniform_(-0.4, 0.4, generator=torch.Generator().manual_seed(0))
    peer = kornia.feature.LAFAffNetShapeEstimator(False, preserve_orientation=False).eval()
    del peer.features
    peer.features = lambda patches: numbers
    image = texture(5)
    expected = peer(lafs[None], torch.from_numpy(image)[None, None].float() / 255)[0]
    found = features.NetworkShape(lambda patches: numbers)(features.ImagePyramid(image), lafs)
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(features.frame_scale(found), features.frame_scale(lafs), rtol=1e-4, atol=1e-4)


def test_impossible_shapes_keep_the_frame() -> None:
    lafs = random_frames(6, 5, 160, 200)
    bad = torch.tensor([[0.1, 0, 0], [-1, 0, 0], [torch.nan, 0, 0], [0, 50, 0], [0.8, 0, -0.9]])
    found = features.NetworkShape(lambda patches: bad)(features.ImagePyramid(texture(6)), lafs)
    torch.testing.assert_close(found[1:], features.make_upright(lafs)[1:])
    assert not torch.allclose(found[0], features.make_upright(lafs)[0])


def test_orientation_network_turns_by_its_vector() -> None:
    lafs = random_frames(7, 3, 160, 200)
    vectors = torch.tensor([[0.0, 0.3], [0.5, 0.0], [0.1, -0.1]])
    found = features.NetworkOrientation(lambda patches: vectors)(features.ImagePyramid(texture(7)), lafs)
    expected = features.rotate_frames(lafs, torch.tensor([0.0, np.pi / 2, 0.75 * np.pi]))
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


def test_authors_networks_give_the_stored_frames() -> None:
    file = oracle("affnet_orinet.npz")
    images = oracle("sift.npz")
    shape, orientation = (networks.build(name).eval() for name in ("affnet", "orinet"))
    networks.load_weights(shape, shared_path("weights/AffNet.pth"))
    networks.load_weights(orientation, shared_path("weights/OriNet.pth"))
    gaps = []
    for number in (0, 1):
        chosen = file["keypoints"][:, 4] == number
        image = images[f"{number:03d}.image"]
        lafs = torch.from_numpy(file["laf_in"][chosen]).float()
        stored = torch.from_numpy(file["laf_affnet"][chosen]).float()
        turned = torch.from_numpy(file["laf_oriented"][chosen]).float()
        # Through kornia's patches, the stored frames. Entries of up to 100 px in float32 through a network.
        shaped = features.NetworkShape(shape)(KorniaPyramid(image), lafs)
        torch.testing.assert_close(shaped, stored, atol=5e-3, rtol=1e-3)
        oriented = features.NetworkOrientation(orientation)(KorniaPyramid(image), stored)
        torch.testing.assert_close(oriented, turned, atol=5e-3, rtol=1e-3)
        # Through ours, which are blurred otherwise, nearly so.
        found = features.NetworkShape(shape)(features.ImagePyramid(image), lafs)
        gaps.append((found - stored)[..., :2].abs().amax((1, 2)) / features.frame_scale(lafs))
    assert torch.cat(gaps).median() < 0.05


class KorniaPyramid(features.ImagePyramid):
    def extract(self, lafs: Tensor, size: int = 32) -> Tensor:
        return kornia.feature.extract_patches_from_pyramid(self.levels[0][None, None], lafs[None], size)[0]
