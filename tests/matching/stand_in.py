"""A package `vismatch` of the documented interface, for tests: matchers by names, in a folder of its own."""

import sys
from pathlib import Path

import pytest

from tests.helpers import write_file

PACKAGE = '''
import cv2, numpy as np, torch
available_models = ["sift-nn", "superpoint-lightglue", "silent", "broken", "no-download", "random", "uneven", "romav2"]
calls = []


class Matcher(torch.nn.Module):
    """SIFT with the ratio test, called as vismatch's matchers: tensors (3, H, W) in [0, 1]."""

    def __init__(self, name, count):
        super().__init__()
        self.name, self.count = name, count
        self.weight = torch.nn.Parameter(torch.ones(3))

    def forward(self, image0, image1):
        for image in (image0, image1):
            assert image.shape[0] == 3 and image.dtype == torch.float32 and 0 <= image.min() <= image.max() <= 1
        if self.name == "broken":
            raise RuntimeError("out of memory\\nand more")
        if self.name == "silent":
            nothing = np.empty([0, 2])
            return {"matched_kpts0": nothing, "matched_kpts1": nothing, "matched_confidences": None}
        if self.name == "random":
            return {f"matched_kpts{k}": 50 * torch.rand(20, 2).numpy() for k in (0, 1)}
        x0, x1, ratios = sift(image0, image1, self.count)
        if self.name == "uneven":
            x0 = x0[1:]
        return {"matched_kpts0": x0, "matched_kpts1": x1, "matched_confidences": 1 - ratios}


def sift(image0, image1, count):
    pixels = [(255 * i.permute(1, 2, 0).numpy()).astype(np.uint8) for i in (image0, image1)]
    grey = [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY) for p in pixels]
    (k0, d0), (k1, d1) = (cv2.SIFT_create(count).detectAndCompute(g, None) for g in grey)
    good = [(m.queryIdx, m.trainIdx, m.distance / n.distance) for m, n in cv2.BFMatcher().knnMatch(d0, d1, k=2)]
    good = [g for g in good if g[2] < 0.75]
    x0, x1 = (np.array([k[g[i]].pt for g in good]) for i, k in enumerate((k0, k1)))
    return x0, x1, np.array([g[2] for g in good])


class RoMaV2:
    """What vismatch's wrapper calls of the released model."""

    H_lr, W_lr, H_hr, W_hr = 64, 64, 100, 200

    def sample(self, preds, count):
        (x0, x1, ratios), sizes = preds
        ends = [torch.as_tensor((x + 0.5) / [w / 2, h / 2] - 1) for x, (h, w) in zip((x0, x1), sizes)]
        precision = torch.eye(2).repeat(len(x0), 1, 1)
        precision[::2] *= 4.0
        precision[0] *= float("nan")
        return torch.cat(ends, 1), torch.as_tensor(1 - ratios), precision, precision.clone()

    def to_pixel_coordinates(self, matches, h0, w0, h1, w1):
        sizes = torch.tensor([w0, h0]), torch.tensor([w1, h1])
        return tuple((m + 1) / 2 * size for m, size in zip((matches[:, :2], matches[:, 2:]), sizes))


class RoMaV2Matcher(torch.nn.Module):
    def __init__(self, count):
        super().__init__()
        self.romav2_model, self.count = RoMaV2(), count

    def forward(self, image0, image1):
        preds = sift(image0, image1, self.count), (image0.shape[1:], image1.shape[1:])
        matches, confidence, _, _ = self.romav2_model.sample(preds, self.count)
        x0, x1 = self.romav2_model.to_pixel_coordinates(matches, *image0.shape[1:], *image1.shape[1:])
        return {"matched_kpts0": x0.numpy(), "matched_kpts1": x1.numpy(), "matched_confidences": confidence.numpy()}


def get_matcher(matcher_name="sift-nn", device="cpu", max_num_keypoints=2048, **options):
    calls.append((matcher_name, device, max_num_keypoints, options))
    if matcher_name == "no-download":
        raise OSError("no connection\\nto anywhere")
    return RoMaV2Matcher(max_num_keypoints) if matcher_name == "romav2" else Matcher(matcher_name, max_num_keypoints)
'''


def install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the package before all others; it is gone after the test."""
    write_file(folder / "vismatch" / "__init__.py", PACKAGE)
    write_file(folder / "vismatch-9.9.dist-info" / "METADATA", "Name: vismatch\nVersion: 9.9\n")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setitem(sys.modules, "vismatch", None)  # whose end takes away what the test has imported since
    del sys.modules["vismatch"]
