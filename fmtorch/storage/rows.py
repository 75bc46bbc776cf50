"""The result of one image pair, as one row of a table."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import pyarrow as pa

PAIR_SCHEMA = pa.schema(
    [
        pa.field("pair", pa.string(), nullable=False),
        pa.field("key", pa.int64(), nullable=False),
        pa.field("family", pa.string(), nullable=False),
        pa.field("scene", pa.string(), nullable=False),
        pa.field("ok", pa.bool_(), nullable=False),
        pa.field("reason", pa.string(), nullable=False),
        pa.field("nsgd", pa.float64(), nullable=False),
        pa.field("nsgd_released", pa.float64()),
        pa.field("inlier_rate", pa.float64()),
        pa.field("inlier_rate_before", pa.float64()),
        pa.field("corrs", pa.int64(), nullable=False),
        pa.field("corrs_before", pa.int64(), nullable=False),
        pa.field("features0", pa.int64(), nullable=False),
        pa.field("features1", pa.int64(), nullable=False),
        pa.field("draws", pa.int64(), nullable=False),
        pa.field("seconds_features", pa.float64()),
        pa.field("seconds_matching", pa.float64()),
        pa.field("seconds_pruning", pa.float64()),
        pa.field("seconds_estimation", pa.float64()),
        pa.field("seconds_metrics", pa.float64()),
        pa.field("F", pa.list_(pa.float64(), 9)),
        pa.field("significance", pa.float64()),
        pa.field("related", pa.bool_(), nullable=False),
        pa.field("rotation_error", pa.float64()),
        pa.field("translation_error", pa.float64()),
        pa.field("pose_reason", pa.string()),
        pa.field("configuration", pa.string()),
        pa.field("warning", pa.string()),
        pa.field("focal_error0", pa.float64()),
        pa.field("focal_error1", pa.float64()),
        pa.field("focal_log_ratio0", pa.float64()),
        pa.field("focal_log_ratio1", pa.float64()),
        pa.field("H", pa.list_(pa.float64(), 9)),
        pa.field("corner_error", pa.float64()),
    ]
)


@dataclasses.dataclass(frozen=True)
class PairRow:
    """The result of one image pair. What could not be computed is None or NaN, and null in the table.

    A pair of a known homography has a corner error, infinite where it failed, and H in place of F; its NSGD is NaN.

    Raises ValueError for a row that contradicts itself: a failed pair has a reason, NSGD 1 and no F; a sound one has no
    reason and nine finite elements of F or H; NSGD is in [0, 1]; there are both angles of a pose error or neither.
    """

    pair: str  # the pair's identity within its data set
    key: int  # the pair's stable 64-bit key, `pair_key(pair)`
    family: str  # what results are grouped by
    scene: str  # the cluster for the bootstrap
    ok: bool  # whether there is an estimate
    reason: str = ""  # why not
    nsgd: float = 1.0  # share of the image diagonal, in [0, 1]; 1 where the pair failed
    nsgd_released: float | None = None  # the same as the published evaluator computes it
    inlier_rate: float | None = None  # share of the estimator's inliers that obey the true F, in [0, 1]
    inlier_rate_before: float | None = None  # share of the matches given to the estimator that do
    corrs: int = 0  # the estimator's inliers
    corrs_before: int = 0  # the matches given to the estimator
    features0: int = 0  # features of image 0
    features1: int = 0  # features of image 1
    draws: int = 0  # minimal samples drawn
    seconds_features: float | None = None  # seconds of wall-clock time spent on this pair, stage by stage;
    seconds_matching: float | None = None  # a batch's time is shared equally among its pairs
    seconds_pruning: float | None = None
    seconds_estimation: float | None = None
    seconds_metrics: float | None = None
    F: Sequence[float] | None = None  # row by row, x1^T F x0 = 0 in pixels, unit Frobenius norm
    significance: float | None = None  # how far the support of F is beyond chance
    related: bool = False  # whether the images are therefore taken to show one scene; recall does not ask
    rotation_error: float | None = None  # degrees, in [0, 180]; 180 where the pair failed; None without a true pose
    translation_error: float | None = None  # of directions up to sign, in [0, 90], 90 where it failed; signed: to 180
    pose_reason: str | None = None  # why there is no pose error, or no pose; None where there is
    configuration: str | None = None  # of `CONFIGURATIONS`; None where there are no matches to tell it by
    warning: str | None = None  # what the configuration leaves open, empty where nothing
    focal_error0: float | None = None  # |f - f_true| / f_true of image 0 where f is estimated; infinite where it is
    focal_error1: float | None = None  # not determined; None where it is given exactly, or the true one is unknown
    focal_log_ratio0: float | None = None  # log(f / f_true); None where it is not determined, too
    focal_log_ratio1: float | None = None
    H: Sequence[float] | None = None  # row by row, x1 ~ H x0 in pixels, unit Frobenius norm
    corner_error: float | None = None  # px in image 1, of the corners of image 0; infinite where the pair failed

    def __post_init__(self) -> None:
        if self.corner_error is not None:
            _expect_homography(self)
            return
        if not 0.0 <= self.nsgd <= 1.0:
            raise ValueError(f"pair {self.pair!r}: nsgd is {self.nsgd}; it must be in [0, 1]")
        angles = [a for a in (self.rotation_error, self.translation_error) if a is not None and not math.isnan(a)]
        if len(angles) == 1 or not all(0.0 <= a <= 180.0 for a in angles):
            raise ValueError(
                f"pair {self.pair!r}: rotation_error is {self.rotation_error} and translation_error is "
                f"{self.translation_error}; both must be angles in [0, 180] degrees, or neither known"
            )
        if self.related and not self.ok:
            raise ValueError(f"pair {self.pair!r} failed, but is called related")
        if self.ok:
            if self.reason:
                raise ValueError(f"pair {self.pair!r} is ok but has a reason of failure: {self.reason!r}")
            if self.F is None or len(self.F) != 9 or not all(map(math.isfinite, self.F)):
                raise ValueError(f"pair {self.pair!r} is ok: F must be nine finite numbers, but is {self.F}")
        elif not self.reason or self.nsgd != 1.0 or self.F is not None:
            raise ValueError(
                f"pair {self.pair!r} failed: it needs a reason, nsgd 1 and no F, "
                f"but has reason={self.reason!r}, nsgd={self.nsgd}, F={self.F}"
            )


def _expect_homography(row: PairRow) -> None:
    """Raises ValueError for a row of a pair of a known homography that contradicts itself."""
    error, H = row.corner_error, row.H
    if error is None or not error >= 0.0 or not math.isnan(row.nsgd) or row.F is not None:
        raise ValueError(
            f"pair {row.pair!r} has a homography: it needs a corner error of at least 0, NSGD NaN and no F, but has "
            f"corner_error={error}, nsgd={row.nsgd}, F={row.F}"
        )
    has_homography = H is not None and len(H) == 9 and all(map(math.isfinite, H))
    if row.ok != has_homography or row.ok == bool(row.reason) or (not row.ok and math.isfinite(error)):
        raise ValueError(
            f"pair {row.pair!r} has a homography: it needs nine finite numbers of H and no reason, or a reason, no H "
            f"and an infinite corner error, but has H={H}, reason={row.reason!r}, corner_error={error}"
        )


def to_table(rows: Sequence[PairRow]) -> pa.Table:
    """The rows as a table of `PAIR_SCHEMA`; NaN becomes null."""
    columns = {name: [_plain(getattr(row, name)) for row in rows] for name in PAIR_SCHEMA.names}
    columns["nsgd"] = [row.nsgd for row in rows]  # NaN where there is no F
    return pa.table(columns, schema=PAIR_SCHEMA)


def _plain(value: object) -> object:
    return None if isinstance(value, float) and math.isnan(value) else value
