"""What is found of two photographs, with its pictures and files."""

from __future__ import annotations

import dataclasses
import html
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.display import picture_html
from fmtorch.core.files import replacing
from fmtorch.core.types import RELATED, Correspondences
from fmtorch.data.cameras import Lens, undistorted
from fmtorch.io.match_store import PairGeometry
from fmtorch.pipeline.photographs import GivenImage, Image, given_image
from fmtorch.pipeline.pictures import draw_epipolar_lines, draw_matches, headed
from fmtorch.two_view.arguments import Arrays

FLAT = ("planar", "rotation", "identical")  # pair types of which a homography explains all matches
Picture = Literal["matches", "pruning", "epipolar"]
Lenses = tuple[Lens | None, Lens | None]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class MatchResult:
    """The matches of two photographs and their fundamental matrix, ``x1^T F x0 = 0``, in pixels of the photographs.

    keypoints0, keypoints1: all that were detected, (N0, 2) and (N1, 2).
    putative: the matcher's matches, a batch of one. kept: which of them the pruners kept, (M,).
    correspondences: the kept ones, a batch of one. inliers: which of those agree with F, (K,).
    F: (3, 3) float64 of unit Frobenius norm; zero where there is none, and `reason` then says why.
    significance: how far the support of F is beyond chance (`fmtorch.geometry.significance`); -inf where there is no F.
    warning: why F, though found, means little; mostly empty. counts: matches after each step, in order. seconds: of
    each step, cached features with those they took when they were computed.
    R (3, 3), t (3,), focals (2,): X1 = R X0 + t with a t of unit length, and focal lengths in pixels of the
    photographs, where cameras were asked for; NaN where not determined.
    pair_type: one of `PAIR_TYPES`; empty where nothing could be matched. geometry: the two-view geometry for
    COLMAP, whose inliers are indices of the kept matches, twice. undistorted: where a lens distorts, the kept matches
    as pinholes would have them, which F and homography relate; points are otherwise those of the photographs.
    lens: (2,), lambda of both lenses as of `Estimate.lens`, where these were estimated.
    photographs: as they were given, lenses: as they are known or were estimated; for pictures.
    """

    keypoints0: Float[Tensor, "n0 2"]
    keypoints1: Float[Tensor, "n1 2"]
    putative: Correspondences
    kept: Bool[Tensor, " m"]
    correspondences: Correspondences
    inliers: Bool[Tensor, " k"]
    F: Float[Tensor, "3 3"]
    reason: str = ""
    warning: str = ""
    counts: dict[str, int] = dataclasses.field(default_factory=dict)
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    significance: float = -math.inf
    R: Float[Tensor, "3 3"] | None = None
    t: Float[Tensor, " 3"] | None = None
    focals: Float[Tensor, " 2"] | None = None
    lens: Float[Tensor, " 2"] | None = None
    pair_type: str = ""
    geometry: PairGeometry | None = None
    undistorted: Correspondences | None = None
    photographs: tuple[GivenImage, GivenImage] | None = None
    lenses: Lenses = (None, None)

    @property
    def homography(self) -> Float[Tensor, "3 3"] | None:
        """Of planes, rotations and copies: ``x1 ~ H x0`` in pixels of the photographs; else None."""
        H = None if self.geometry is None or self.pair_type not in FLAT else self.geometry.H
        return None if H is None else torch.from_numpy(H)

    @property
    def related(self) -> bool:
        """Whether the photographs are taken to show one scene: F was found, and its support is beyond chance."""
        return self.ok and self.significance >= RELATED

    @property
    def ok(self) -> bool:
        """Whether a fundamental matrix was found."""
        return not self.reason

    def draw(self, what: Picture = "matches", *, truth: Arrays | None = None) -> Image:
        """A picture of both photographs, RGB (H, W, 3).

        Args:
            what: "matches", of which inliers are green; "pruning", what was kept; "epipolar", inliers with their lines.
            truth: the true F (3, 3), whose epipolar lines are dashed; they are drawn alone where no F was found.

        Raises:
            ValueError: for another picture, and for epipolar lines where there is no F.
        """
        if what not in get_args(Picture):
            raise ValueError(f"what is {what!r}; it must be one of {', '.join(get_args(Picture))}")
        if what == "epipolar":
            return self._epipolar(truth, None)
        kept = self.kept.cpu().numpy()
        good, names = kept.copy(), ("kept", "dropped by pruning")
        if what == "pruning":
            names = (f"kept by pruning ({', '.join(self._pruners)})", "dropped")
        elif self.ok:
            good[good] = self.inliers.cpu().numpy()
            names = ("inliers of F", "others, dropped by pruning or estimation")
        picture = draw_matches(*self._images(), self.putative.x0[0], self.putative.x1[0], good, names=names)
        return headed(picture, *self._verdict)

    def save(
        self, folder: Path | str, *, truth: Arrays | None = None, report: Mapping[str, Any] | None = None
    ) -> list[str]:
        """Write `result.json` and the pictures into a folder, as `fmtorch match` does.

        Args:
            folder: made where it is missing.
            truth: as of `draw`.
            report: further entries of `result.json`.

        Returns:
            The names of the files.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        names = ["matches"]
        if self._pruners:
            names.append("pruning")
        if self.ok or truth is not None:
            names.append("epipolar")
        with replacing(folder / "result.json") as path:
            path.write_text(json.dumps({**(report or {}), **self.report()}) + "\n")
        for name in get_args(Picture):
            path = folder / f"{name}.png"
            if name not in names:  # of an earlier run
                path.unlink(missing_ok=True)
                continue
            with replacing(path) as temporary:
                nsgd = (report or {}).get("nsgd")
                picture = self._epipolar(truth, nsgd) if name == "epipolar" else self.draw(name)
                temporary.write_bytes(_encoded(picture, "png"))
        return ["result.json", *(f"{name}.png" for name in names)]

    def report(self) -> dict[str, Any]:
        """What result.json holds: plain values, points in pixels of the photographs."""
        c, H = self.correspondences, self.homography
        report: dict[str, Any] = {
            "size0": _plain(c.size0), "size1": _plain(c.size1),
            "F": self.F.tolist() if self.ok else None, "reason": self.reason, "warning": self.warning,
            "pair_type": self.pair_type or None, "homography": None if H is None else H.tolist(),
            "related": self.related, "significance": self.significance if math.isfinite(self.significance) else None,
            "features": [len(self.keypoints0), len(self.keypoints1)], "matches": self.counts, "seconds": self.seconds,
            "x0": c.x0[0].tolist(), "x1": c.x1[0].tolist(), "inliers": self.inliers.tolist(),
            "ratio": _plain(c.ratio), "score": _plain(c.score),
        }  # fmt: skip
        if (pinhole := self.undistorted) is not None:
            report |= {"undistorted_x0": pinhole.x0[0].tolist(), "undistorted_x1": pinhole.x1[0].tolist()}
        if self.R is not None and self.t is not None and self.focals is not None:
            determined = self.ok and bool(torch.isfinite(self.R).all())
            report |= {name: value.tolist() if determined else None for name, value in (("R", self.R), ("t", self.t))}
            report["focals"] = [focal if math.isfinite(focal) else None for focal in self.focals.tolist()]
        if self.lens is not None:
            report["lens"] = [value if math.isfinite(value) else None for value in self.lens.tolist()]
        return report

    def __repr__(self) -> str:
        """One line: matches, inliers, and what they say of the photographs."""
        found = [f"{len(self.inliers)} matches"]
        if self.ok:
            verdict = "related" if self.related else "not related"
            found += [f"{int(self.inliers.sum())} inliers", f"significance {self.significance:.1f}", verdict]
            found += [self.pair_type] if self.pair_type not in ("", "unrelated") else []
        else:
            found.append(f"no F: {self.reason}")
        return f"MatchResult({', '.join(found)})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the line, and the picture of the matches where the photographs are at hand."""
        line = f"<p>{html.escape(repr(self))}</p>"
        if self.photographs is None:
            return line
        return line + picture_html(_encoded(self.draw(), "jpeg"), "jpeg", "matches")

    @property
    def _pruners(self) -> list[str]:
        return [step for step in self.counts if step not in ("matching", "estimation")]

    def _images(self) -> tuple[Image, Image]:
        if self.photographs is None:
            raise ValueError("the photographs are not at hand; fmtorch.draw_matches draws matches into any two images")
        image0, image1 = (given_image(image, f"image{i}") for i, image in enumerate(self.photographs))
        return image0, image1

    @property
    def _verdict(self) -> tuple[str, bool]:
        """What pictures say of the pair, and whether it is not to be relied on."""
        if not self.ok:
            return f"no F: {self.reason}", True
        if self.pair_type in FLAT:
            return f"{self.pair_type}: these matches do not determine F", True
        if not self.related:
            return f"not related: so many inliers agree by chance (significance {self.significance:.1f})", True
        return f"related, {self.pair_type or 'general'}", False

    def _epipolar(self, truth: Arrays | None, nsgd: float | None) -> Image:
        if not self.ok and truth is None:
            raise ValueError(f"there are no epipolar lines without F: {self.reason}")
        seen = self.correspondences if self.undistorted is None else self.undistorted
        good = self.inliers if self.ok else seen.mask[0]
        bent = zip(self._images(), self.lenses, strict=True)
        image0, image1 = (image if lens is None else undistorted(image, lens) for image, lens in bent)
        F = self.F if self.ok or truth is None else truth
        dashed = truth if self.ok else None
        picture = draw_epipolar_lines(image0, image1, seen.x0[0][good], seen.x1[0][good], F, truth=dashed)
        said, doubtful = self._verdict
        said += "; a point and the line of its partner have one colour"
        said += "" if dashed is None else "; dashed white: true lines"
        return headed(picture, said + ("" if nsgd is None else f"; NSGD {nsgd:.4f}"), doubtful)


def _plain(value: Tensor | None) -> Any:
    """The only row of a tensor as numbers."""
    return None if value is None else value[0].tolist()


def _encoded(picture: Image, kind: str) -> bytes:
    """The bytes of a picture's file."""
    return bytes(cv2.imencode(f".{kind}", picture[..., ::-1])[1])
