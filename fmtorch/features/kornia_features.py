"""Learned detectors and descriptors of others, through kornia: DISK, ALIKED and XFeat, for comparison."""

from typing import Annotated, Any, cast

import kornia
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.core import Features, Within
from fmtorch.core.onnx_network import pretrained
from fmtorch.features.patches import Image
from fmtorch.features.sift import strongest

SMALLEST = 32  # px, the shorter side: the networks reduce the image 16 and 32 times


class _NetworkFeatures:
    """What they have in common: pixels in, unit-length descriptors out, no frames but positions.
    identity: what defines the results, for caches. For any number of threads."""

    def __init__(self, network: nn.Module, device: str, **options: int | float) -> None:
        automatic = "cuda" if torch.cuda.is_available() else "cpu"
        self.device = torch.device(automatic if device == "auto" else device)
        self.network = network.eval().to(self.device)
        self.identity = {"device": self.device.type, "network": self.network, **options}

    def __call__(self, image: Image) -> Features:
        """The features of a grey (H, W) or RGB (H, W, 3) uint8 image; none, with N = 0, where nothing is found.
        lafs: circles of one pixel, which say nothing of scale or orientation: give them to no pruner. scores: the
        network's. descriptors: (N, 128), of XFeat (N, 64), of unit length. Raises ValueError for an image of another
        type or shape or with a side below `SMALLEST`."""
        keypoints, scores, descriptors = self._run(self._tensor(image))
        lafs = torch.cat([torch.eye(2).to(keypoints).expand(len(keypoints), 2, 2), keypoints[..., None]], -1)
        size = torch.tensor(image.shape[:2], dtype=torch.int64, device=self.device)
        return Features(lafs, scores, descriptors, size)

    def _run(self, image: Float[Tensor, "1 3 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        """Keypoints in pixels (0 is the centre of the first), scores, descriptors."""
        raise NotImplementedError

    def _tensor(self, image: Image) -> Float[Tensor, "1 3 h w"]:
        colour = image.ndim == 3 and image.shape[-1] == 3
        if image.dtype != np.uint8 or not (image.ndim == 2 or colour) or min(image.shape[:2]) < SMALLEST:
            wanted = f"uint8, (H, W) or RGB (H, W, 3), of at least {SMALLEST} x {SMALLEST} px"
            raise ValueError(f"image is {image.dtype} {image.shape}; it must be {wanted}")
        channels = np.broadcast_to(image if colour else image[..., None], (*image.shape[:2], 3))
        return torch.from_numpy(channels.transpose(2, 0, 1).copy()).to(self.device)[None].to(torch.float32) / 255


class DISK(_NetworkFeatures):
    """DISK (Tyszkiewicz, Fua, Trulls, NeurIPS 2020): whole-pixel keypoints, descriptors of 128 numbers.
    weights: `depth` or `epipolar`, the released models. max_features: the strongest kept. window: side in pixels of the
    non-maximum suppression. score_threshold: least score, a logit. device: auto, cpu, cuda. network: in place of the
    released one. Raises ConnectionError where the weights cannot be fetched."""

    def __init__(
        self, weights: str = "depth", max_features: Annotated[int, Within(1)] = 2048, window: int = 5,
        score_threshold: float = 0.0, device: str = "auto", network: nn.Module | None = None,
    ) -> None:  # fmt: skip
        known = kornia.feature.disk.disk.urls
        if weights not in known:
            raise ValueError(f"no weights {weights!r} of DISK; there are: {', '.join(known)}")
        network = network or pretrained(
            lambda: kornia.feature.DISK.from_pretrained(weights), f"DISK ({weights})",
            "github.com/cvlab-epfl/disk or huggingface.co/kornia", f"{weights}-save.pth",
        )  # fmt: skip
        self._options: dict[str, Any] = {"n": max_features, "window_size": window, "score_threshold": score_threshold}
        super().__init__(network, device, **self._options)

    def _run(self, image: Float[Tensor, "1 3 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        with torch.inference_mode():
            (detected,) = self.network(image, pad_if_not_divisible=True, **self._options)
        return detected.keypoints.clone(), detected.detection_scores.clone(), detected.descriptors.clone()


class ALIKED(_NetworkFeatures):
    """ALIKED (Zhao et al., TIM 2023): sub-pixel keypoints, descriptors of 128 numbers.
    weights: `aliked-n16`, `aliked-n16rot`, `aliked-n32` or `aliked-t16` (whose descriptors have 64 numbers).
    max_features: the strongest kept. score_threshold: least score, in (0, 1). radius: of the non-maximum suppression,
    in pixels. device, network, errors: as of `DISK`."""

    def __init__(
        self, weights: str = "aliked-n16", max_features: Annotated[int, Within(1)] = 2048, score_threshold: float = 0.2,
        radius: int = 2, device: str = "auto", network: nn.Module | None = None,
    ) -> None:  # fmt: skip
        known = kornia.feature.aliked.aliked._ALIKED_CFGS
        if weights not in known:
            raise ValueError(f"no weights {weights!r} of ALIKED; there are: {', '.join(known)}")
        network = network or pretrained(
            lambda: kornia.feature.ALIKED.from_pretrained(
                weights, detection_threshold=score_threshold, nms_radius=radius
            ),
            f"ALIKED ({weights})", "github.com/Shiaoming/ALIKED or huggingface.co/kornia", f"{weights}.pth",
        )  # fmt: skip
        self.max_features = max_features
        super().__init__(network, device, max_features=max_features, score_threshold=score_threshold, radius=radius)

    def _run(self, image: Float[Tensor, "1 3 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        with torch.inference_mode():
            (detected,) = self.network(image)
        kept = torch.from_numpy(strongest(detected.keypoint_scores.cpu().numpy(), self.max_features)).to(self.device)
        outputs = (detected.keypoints, detected.keypoint_scores, detected.descriptors)
        keypoints, scores, descriptors = (output[kept].clone() for output in outputs)
        return keypoints, scores, descriptors


class XFeat(_NetworkFeatures):
    """XFeat (Potje et al., CVPR 2024): whole pixels of the image resized to sides divisible by 32, descriptors of 64
    numbers. max_features: the strongest kept. score_threshold: least keypoint probability, in (0, 1). device: auto,
    cpu, cuda. network: in place of the released one. Raises ConnectionError where the weights cannot be fetched."""

    def __init__(
        self, max_features: Annotated[int, Within(1)] = 2048, score_threshold: float = 0.05, device: str = "auto",
        network: nn.Module | None = None,
    ) -> None:  # fmt: skip
        network = network or pretrained(
            lambda: kornia.feature.XFeat.from_pretrained(detection_threshold=score_threshold),
            "XFeat", "github.com/verlab/accelerated_features", "xfeat.pt",
        )  # fmt: skip
        self.max_features = max_features
        super().__init__(network, device, max_features=max_features, score_threshold=score_threshold)

    def _run(self, image: Float[Tensor, "1 3 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        with torch.inference_mode():
            (detected,) = cast(Any, self.network).detectAndCompute(image, top_k=self.max_features)
        sides = torch.tensor([image.shape[3], image.shape[2]]).to(image)
        scale = sides / (sides // 32 * 32)  # by which kornia multiplies keypoints; a pixel's centre is at a half
        keypoints = detected["keypoints"] + (scale - 1) / 2
        return keypoints, detected["scores"].clone(), detected["descriptors"].clone()
