"""LightGlue, the learned matcher (Lindenberger, Sarlin, Pollefeys, ICCV 2023), through kornia, for comparison."""

import kornia
import torch
from torch import Tensor, nn

from fmtorch.core.onnx_network import pretrained
from fmtorch.core.types import Correspondences, Features

# Those that need no more than positions and descriptors, and that this project reads
FEATURES = ("aliked", "disk", "xfeat")


class LightGlue:
    """Matches the features of two images by a transformer; the slots of the result are the matches found.
    score and prior: the network's score, its P(match). Frames are not handed on: the features that it is for have none.
    features: `aliked`, `disk` or `xfeat` (LighterGlue), what the weights were trained for; threshold: least score.
    device: auto, cpu, cuda. network: in place of the released one. For any number of threads. Raises ConnectionError
    where the weights cannot be fetched."""

    def __init__(
        self, features: str = "aliked", threshold: float = 0.1, device: str = "auto", network: nn.Module | None = None
    ) -> None:
        if features not in FEATURES:
            raise ValueError(f"no weights of LightGlue for {features!r}; there are: {', '.join(FEATURES)}")
        automatic = "cuda" if torch.cuda.is_available() else "cpu"
        self.device = torch.device(automatic if device == "auto" else device)
        kind = kornia.feature.LightGlue
        # The file that kornia's loader looks for in torch's folder of checkpoints: it replaces every dot of the name
        kept_as = f"{kind.features[features]['weights']}_{kind.version}.pth".replace(".", "-")
        publisher, file = "github.com/cvg/LightGlue", f"{features}_lightglue.pth"
        if features == "xfeat":
            publisher, file = "github.com/verlab/accelerated_features", "xfeat-lighterglue.pt"
            kept_as = file
        network = network or pretrained(
            lambda: kind(features, filter_threshold=threshold), f"LightGlue ({features})",
            f"{publisher} or huggingface.co/kornia", file, kept_as,
        )  # fmt: skip
        self.network = network.eval().to(self.device)
        self._length = int(kind.features[features]["input_dim"])

    def __call__(self, features0: Features, features1: Features) -> Correspondences:
        """The matches of one pair, a batch of one, on the device of `features0`.
        Raises ValueError for descriptors of a length that the network is not for."""
        for features in (features0, features1):
            shape = tuple(features.descriptors.shape)
            if len(shape) != 2 or shape[1] != self._length:
                raise ValueError(f"descriptors are {shape}; for this LightGlue they must be (N, {self._length})")
        pairs, score = self._matches(features0, features1)
        x0, x1 = features0.keypoints[pairs[:, 0]][None], features1.keypoints[pairs[:, 1]][None]
        mask, score = torch.ones_like(score, dtype=torch.bool)[None], score[None]
        size0, size1 = features0.image_size[None], features1.image_size[None]
        return Correspondences(x0, x1, mask, score=score, prior=score, size0=size0, size1=size1)

    def _matches(self, features0: Features, features1: Features) -> tuple[Tensor, Tensor]:
        home = features0.lafs.device
        if min(len(features0), len(features1)) < 2:  # the network normalises over the features
            return torch.zeros(0, 2, dtype=torch.int64, device=home), torch.zeros(0, device=home)
        images = {f"image{i}": self._input(features) for i, features in enumerate((features0, features1))}
        with torch.inference_mode():
            output = self.network(images)
        return output["matches"][0].to(home).clone(), output["scores"][0].to(home, torch.float32).clone()

    def _input(self, features: Features) -> dict[str, Tensor]:
        size = features.image_size.flip(0)[None]  # (w, h)
        inputs = {"keypoints": features.keypoints[None], "descriptors": features.descriptors[None], "image_size": size}
        return {name: value.to(self.device) for name, value in inputs.items()}
