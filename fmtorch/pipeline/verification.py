"""Two-view geometries of a COLMAP database whose matches anyone made."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast, get_args

from fmtorch import presets
from fmtorch.core.arguments import number
from fmtorch.core.files import replacing
from fmtorch.core.stages import Estimator, model_of
from fmtorch.core.types import collate
from fmtorch.core.version import __version__
from fmtorch.pipeline.database_pairs import Cameras, DatabasePair, as_correspondences, geometries
from fmtorch.pipeline.estimation import estimated_by
from fmtorch.storage.exchange.colmap import imported
from fmtorch.storage.exchange.database import (
    Ids,
    MatchDatabase,
    copy_database,
    expect_database,
    move_database,
    remove_database,
)
from fmtorch.storage.exchange.verification_log import VerificationLog

BATCH = 64  # pairs in memory


@dataclasses.dataclass(frozen=True)
class Verification:
    """What `verify` did with a database.

    path: of the database with the geometries. pairs: that have matches. kept: of these, that had a geometry before or
    were finished by an interrupted run. configurations: of the others, how many of each of COLMAP's kinds. problems:
    why pairs could not be read, a line each; the next run tries them again. seconds: of the whole.
    """

    path: Path
    pairs: int
    kept: int
    configurations: Mapping[str, int]
    problems: tuple[str, ...]
    seconds: float

    @property
    def verified(self) -> int:
        """How many pairs were given a geometry: all but the degenerate ones."""
        return sum(count for kind, count in self.configurations.items() if kind != "degenerate")


def verify(
    path: Path | str,
    *,
    output: Path | str | None = None,
    cameras: str = "stored",
    estimator: str = "fmtorch",
    force: bool = False,
    seed: int = 0,
    config_dir: Path | str | None = None,
    report: Callable[[int, int], None] | None = None,
    **options: Any,
) -> Verification:
    """Estimate the two-view geometry of every pair with matches in a COLMAP database, as its mappers read it.

    Configuration, inlier matches, F, E, H and relative pose are written, batch by batch in transactions: a run that is
    killed leaves a database that can be read, and the same call continues it. Keypoints, matches, cameras, rigs and
    frames stay as they are.

    Args:
        path: the database, of COLMAP 3 or 4, with keypoints of 2, 4 or 6 columns and cameras of any model with a lens.
        output: a new database to write to instead; it gets this name once it is complete.
        cameras: "stored": points are undistorted, focal lengths are exact where the camera was calibrated, known within
            5 % where they have a prior and nothing else is known of the camera (EXIF), and unknown where they are
            COLMAP's guess; images of one camera share theirs. "shared": all images have one unknown focal length in
            units of the longer side, without distortion. "unknown": nothing is known.
        estimator: a preset of conf/estimator.
        force: estimate pairs that have a geometry as well, and replace an existing `output`.
        seed: of the random numbers.
        config_dir: a folder with presets of your own, as of `find_fundamental`.
        report: called with the pairs done and their number, at the start and after each batch.
        options: replace values of the preset (``inlier_threshold=1.0``).

    Returns:
        A `Verification` with counts and problems.

    Raises:
        FileNotFoundError: where there is no database.
        ValueError: for another file, a database of a newer COLMAP, without keypoints or without matches; for an
            `output` that exists, an unknown preset, option or kind of cameras.
        ImportError: without pycolmap.

    Example:
        >>> import tempfile, fmtorch, pycolmap
        >>> path = tempfile.mkdtemp() + "/database.db"
        >>> options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=3)
        >>> with pycolmap.Database.open(path) as database:
        ...     model = pycolmap.synthesize_dataset(options, database)
        ...     database.clear_two_view_geometries()
        >>> result = fmtorch.verify(path)
        >>> result.pairs, result.verified
        (3, 3)
    """
    built = presets.build("estimator", estimator, config_dir, **options)
    settings = {"estimator": estimator, "options": repr(sorted(options.items()))}
    return verify_by(
        built, settings, Path(path), None if output is None else Path(output), cameras, force, seed, report
    )


def verify_by(
    estimator: Estimator, settings: Mapping[str, Any], path: Path, output: Path | None, cameras: str, force: bool,
    seed: int, report: Callable[[int, int], None] | None,
) -> Verification:  # fmt: skip
    """The same by an estimator that is built; an interrupted run is continued by one of the same `settings`."""
    begin = time.perf_counter()
    seed = int(number("seed", seed, whole=True))
    if cameras not in get_args(Cameras):
        raise ValueError(f"cameras is {cameras!r}; it must be one of {', '.join(get_args(Cameras))}")
    known: Cameras = cast(Cameras, cameras)
    if (gives := model_of(estimator)) != "fundamental":
        raise ValueError(f"estimator gives {gives} matrices; verify needs one that gives fundamental matrices")
    imported()
    expect_database(path)
    settings = {**settings, "version": __version__, "cameras": cameras, "seed": seed, "force": force}
    work, log = _opened(path, output, settings, force)
    with MatchDatabase(work) as database:
        run = _Run(database, known, seed, estimator, log if force else None)
        run.each_batch(report)
    if output is not None:
        move_database(work, output)
    if log is not None:
        log.remove()
    return run.result(output or path, time.perf_counter() - begin)


def _opened(
    path: Path, output: Path | None, settings: Mapping[str, Any], force: bool
) -> tuple[Path, VerificationLog | None]:
    """The database to write to, and the log of the pairs that are done in it: of a copy, or where all are forced."""
    if output is None:
        return path, VerificationLog(path.with_name(f"{path.name}.verification"), settings) if force else None
    if output.exists() and output.samefile(path):
        raise ValueError(f"output={output} is the database itself; leave output out to write into it")
    if output.exists() and not force:
        raise ValueError(f"output={output} exists; name another file, or replace it with force=true")
    if not output.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {output.parent}; output={output} cannot be written")
    work, state = output.with_name(f"{output.name}.partial"), path.stat()
    source = {"source": str(path.absolute()), "size": state.st_size, "time": state.st_mtime_ns}
    log = VerificationLog(output.with_name(f"{output.name}.verification"), {**settings, **source})
    if not (log.continued and work.exists()):
        remove_database(work)
        log.done.clear()
        with replacing(work) as temporary:
            copy_database(path, temporary)
    return work, log


class _Run:
    """The pairs of one database. log: of the pairs that count as done, those with a geometry where it is None."""

    def __init__(
        self, database: MatchDatabase, cameras: Cameras, seed: int, estimator: Estimator, log: VerificationLog | None
    ) -> None:
        self.database, self.cameras, self.seed, self.estimator, self.log = database, cameras, seed, estimator, log
        self.pairs = database.pairs()
        self.configurations: Counter[str] = Counter()
        self.problems: list[str] = []
        self.kept = 0

    def each_batch(self, report: Callable[[int, int], None] | None) -> None:
        """Estimate and write the pairs that are not done, batch by batch."""
        todo = [pair for pair in self.pairs if not self._done(pair)]
        self.kept = len(self.pairs) - len(todo)
        if report is not None and todo:
            report(0, len(todo))
        for start in range(0, len(todo), BATCH):
            batch = todo[start : start + BATCH]
            self._verify(batch)
            if report is not None:
                report(start + len(batch), len(todo))

    def result(self, path: Path, seconds: float) -> Verification:
        """The summary."""
        counts = dict(self.configurations)
        return Verification(path, len(self.pairs), self.kept, counts, tuple(self.problems), seconds)

    def _done(self, pair: Ids) -> bool:
        return self.database.has_geometry(pair) if self.log is None else pair in self.log.done

    def _verify(self, batch: Sequence[Ids]) -> None:
        """Estimate a batch of pairs and write what is found."""
        ids, pairs, given = [], [], []
        for pair in batch:
            try:
                matches = self.database.matches(pair)
                pairs.append(DatabasePair(self.database.image(pair[0]), self.database.image(pair[1]), matches))
                given.append(as_correspondences(pairs[-1], self.cameras))
                ids.append(pair)
            except Exception as error:  # one pair does not end the work on the others
                del pairs[len(ids) :]
                names = ", ".join(self.database.name(image) for image in pair)
                self.problems.append(f"{names}: {error}".splitlines()[0])
        if not ids:
            return
        c = collate(given)
        results = geometries(pairs, c, estimated_by(self.estimator, c, self.seed), self.seed)
        self.database.write(zip(ids, results, strict=True))
        if self.log is not None:
            self.log.add(ids)
        self.configurations.update(result.kind for result in results)
