"""Every command in the fenced blocks of README.md and docs/ runs, on data and with sizes as small as they can be.

A command runs as it stands there, but for the words that `smaller` exchanges; a command that no rule knows fails. Those
that take long run with ``-m slow``."""

import contextlib
import importlib.util
import os
import re
import runpy
import shlex
import shutil
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra

from fmtorch import data
from fmtorch.data import read_image
from scripts.benchmark.methods import read_specs
from tests.conftest import own_cache
from tests.io import writers
from tests.processes import SOURCE, run_command
from tests.verification import databases, test_matches

GUIDES = [path.relative_to(SOURCE).as_posix() for path in sorted((SOURCE / "docs").rglob("*.md"))]
PAGES = ["README.md", "CONTRIBUTING.md", *GUIDES]
SETS = {"PhotoTourism": "a", "KITTI": "a", "TUM": "a", "Strecha": "ab", "Strecha_train": "ab", "TanksLike": "ab"}
"""Names of data sets, and of the scenes of each: two where one is for validation, or another shard's."""

ELSEWHERE = {
    r"python3? -m venv|pip install": "a fresh environment: continuous integration runs these",
    r"python -m pytest|ruff check|^\.ci/": "what continuous integration does",
    r"scripts/download": "tests/scripts/test_download.py runs it against a server of its own",
    r"benchmark homography": "needs a folder of photographs; tests/estimators/models/test_homography.py warps one",
    r"benchmark pair_types": "needs photographs; tests/scripts/test_benchmark_planes.py runs it on some",
    r"\bdask (scheduler|worker)\b": "tests/evaluation/test_executors.py runs a cluster",
    r"--config-dir my_conf (pruner|pipeline)=": "tests/training/test_train_command.py runs these files and commands",
    r"dataset=(tum|kitti|colmap|bundler|fmbench dataset\.root=KITTI)": "tests/data runs these on data of their layout",
    r"pipeline=vismatch|(dataset=|runs/)pair_list": "tests/matching/test_vismatch.py runs a stand-in on lists of pairs",
    r"dataset=hpatches|executor=processes": "tests/evaluation/test_poses.py runs these on sequences of its own",
    r"train .*layout=oanet": "tests/training/test_train_command.py trains on such files",
    r"'overlap=|HARD/": "tests/data/test_construction.py, tests/scripts/test_benchmark_runner.py run these",
    r"benchmark known_models": "needs the images of a scene; tests/scripts/test_benchmark_planes.py has some",
    r"--config-dir my_conf features=": "tests/docs/test_own_parts.py runs this page",
}
"""Commands that are not run here, and why."""

SLOW = (
    r"fmtorch train",
    r"benchmark (memory|features|scale)",
    r"-m pipeline=",
    r"benchmark (paper|gc_ransac|learned|refinement)",
)

PEERS = {"poselib": "poselib", "degensac_cpp": "pydegensac",
         "gc_ransac_cpp": "pygcransac", "magsac_cpp": "pymagsac", "superansac_cpp": "pysuperansac",
         "poselib_f": "poselib", "colmap": "pycolmap", "superansac": "pysuperansac",
}  # fmt: skip

TINY = ["features.max_features=500"]
DATASET = ["dataset=fmbench", "dataset.root=DATA/Strecha", "limit=1"]
TRAINED = [
    "optimisation.steps=4", "objective.classification_steps=2", "validation.every=2", "batch=2", "threads=1",
    "validation.scenes=1", "validation.pairs=1", "checkpoint_every=2", "workers=1", *TINY,
]  # fmt: skip
APPENDED = {
    "fmtorch match": ["pipeline=sift_gms", *TINY],
    "fmtorch eval": [*DATASET, *TINY, "workers=1"],
    "fmtorch train": ["dataset=fmbench", "dataset.root=DATA", "dataset.sets=[Strecha_train,TanksLike]", *TRAINED],
    "fmtorch pairs": ["dataset.root=DATA/Strecha", "workers=1"],
    "fmtorch verify": ["estimator.focal.rounds=3"],
    "fmtorch report": ["pictures=1", "root=DATA/Strecha"],
    "estimators": ["--limit", "1", "--seeds", "1"],
    "cameras": ["--limit", "1", "--seeds", "1"],
    "curves": ["--limit", "1", "--curves", "samples | msac:hypotheses={} | 50 100"],
    "pipelines": ["--limit", "1", "--seeds", "1", "--cache", "kept", "--pipelines", "rootsiftpca_*"],
    "paper": ["--limit", "1", "--seeds", "1", "--cache", "kept"],
    "gc_ransac": ["--limit", "1", "--cache", "kept", "--pipelines", "paper/*"],
    "pruning": ["--limit", "1", "--asift-limit", "0", "--cache", "kept", "--pipelines", "RATIO", "GMS*"],
    "refinement": ["--limit", "1", "--seeds", "1", "--cache", "kept", "--pipelines", "sift_fmtorch, fmtorch*"],
    "posebench": ["--threshold", "1", "--methods", "E:fmtorch", "F:fmtorch"],
    "related": ["--limit", "1", "--unrelated", "1", "--cache", "kept", "--pipelines", "sift_gms"],
    "learned": ["--limit", "1", "--cache", "kept", "--pipelines", "*LC, F", "RANSAC - ratio"],
    "similar": ["--root", "DATA/Strecha"],
    "stress": ["--limit", "1", "--only", "noise"],
    "verify": ["--root", "DATA", "--scenes", "Strecha/a", "--features", "colmap", "--seeds", "1", "--mappers"],
    "speed": ["--pairs", "2", "--batch", "2", "--repeats", "1", "--matches", "200"],
    "memory": ["--pairs", "1", "--matches", "200", "--estimators", "ransac"],
    "end_to_end": ["--limit", "1", "--pipelines", "sift_ratio estimator=lmeds_eight_point"],
    "features": ["--repeats", "1", "--size", "120", "160", "--features", "hesaffnet_fast"],
    "scale": ["--parts", "memory", "--rows", "100"],
}
"""Options that come last and win."""


def commands(page: str) -> list[str]:
    """The commands of a page's ```bash blocks, continued lines joined, comments at their ends kept."""
    lines = []
    for block in re.findall(r"```bash\n(.*?)```", (SOURCE / page).read_text(encoding="utf-8"), flags=re.DOTALL):
        lines += [line.strip() for line in block.replace("\\\n", " ").splitlines() if line.strip()]
    return lines


def smaller(command: str) -> list[str]:
    """The words to run instead: on a set of one scene in place of the rendered ones, with the least of everything."""
    words = shlex.split(command, comments=True)
    text = shlex.join(words)
    for pattern, replacement in (
        (r"--rendered \w+", "--root DATA/TUM"),
        (r"--root DATA/\w+ (?=.*--root)", ""),
        (r" dataset\.size=\w+", ""),
        (r" '?dataset\.sets=\[\S*\]'?", ""),
        (r"FOLDER", "kept"),
        (r"(dataset\.layout=(\w+) dataset\.root=)FILES", r"\1FILES/\2"),
        (r"benchmark posebench FILES", "benchmark posebench FILES/posebench"),
        (r" root=DIR", ""),
        (r"runs=\[runs/a,runs/b\]|runs/a runs/b", "runs=[runs/fmbench]"),
        (r" 'root=\[\S*\]'", ""),
        (r"^(python -m )?fmtorch[. ](\w+)", r"python -m fmtorch \2"),
    ):
        text = re.sub(pattern, replacement, text)
    words = shlex.split(text)
    name = words[3] if words[2] == "scripts.benchmark" else " ".join(words[2:4])
    if name not in APPENDED:
        raise AssertionError(f"no rule for {command!r}: say in APPENDED how to run it small, or in ELSEWHERE why not")
    added = APPENDED[name]
    if "dataset=h5" in words:
        added = ["limit=1", "workers=1"]
    if "--rows" in words and "--root" not in words and "--rendered" not in command:  # shows what is there
        added = []
    elif name == "pipelines" and "--overrides" not in words:
        added = [*added, "--overrides", *TINY]
    if name == "speed" and importlib.util.find_spec("poselib") is None:
        added = [*added, "--peers", "opencv:method=usac_magsac"]
    return [*(word for word in words if _installed(word)), *added]


def _installed(estimator: str) -> bool:
    library = PEERS.get(re.split("[:@]", estimator)[0])
    return library is None or importlib.util.find_spec(library) is not None


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like a checkout's, with the data that the pages leave to the reader; of the files of methods, all lines
    of which tests/scripts/test_benchmark_runner.py reads, every eighth."""
    folder = tmp_path_factory.mktemp("workplace")
    shutil.copytree(SOURCE / "docs", folder / "docs", ignore=shutil.ignore_patterns("site"))
    shutil.copy(SOURCE / "README.md", folder)
    (folder / "scripts" / "benchmark").mkdir(parents=True)
    for specs in (SOURCE / "scripts" / "benchmark").glob("*.txt"):
        lines = [line for line in read_specs(specs) if _installed(line.split(" ")[0])]
        (folder / "scripts" / "benchmark" / specs.name).write_text("\n".join(lines[::8]))
    pair = data.load("stereo")[0]
    whole = [read_image(source) for source in (pair.image0, pair.image1)]
    images = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in whole]
    halved = np.diag([2.0, 2.0, 1.0])
    F = halved.T @ pair.F @ halved
    for name, scenes in SETS.items():
        for scene in scenes:
            (folder / "DATA" / name / scene / "Images").mkdir(parents=True)
            for i, image in enumerate(images):
                cv2.imwrite(str(folder / "DATA" / name / scene / "Images" / f"{i:08d}.png"), image[..., ::-1])
            cameras = [(pair.K0, np.eye(3), np.zeros(3)), (pair.K1, pair.R, pair.t)]
            numbers = [np.concatenate([(np.diag([0.5, 0.5, 1]) @ K).ravel(), R.ravel(), t]) for K, R, t in cameras]
            np.savetxt(folder / "DATA" / name / scene / "Camera.txt", numbers)
        line = f"0 1 {' '.join(map(str, F.ravel()))}\n"
        (folder / "DATA" / name / "pairs_with_gt.txt").write_text(line * len(scenes))
        (folder / "DATA" / name / "pairs_which_dataset.txt").write_text("".join(f"{s}/\n" for s in scenes))
    (folder / "PHOTOS").mkdir()
    for name, image in zip(("a.jpg", "b.jpg"), images, strict=True):
        for place in (folder, folder / "PHOTOS"):
            cv2.imwrite(str(place / name), image[..., ::-1])
    for training in ("S1", "S2", "C", "N", "P500", "P1500", "PLANES"):
        (folder / training).mkdir()
        shutil.copy(SOURCE / "models" / "lc_f.safetensors", folder / training / "lc.safetensors")
    (folder / "PLANES_SIDE").mkdir()
    shutil.copy(SOURCE / "models" / "lc_side.safetensors", folder / "PLANES_SIDE")
    (folder / "list.txt").write_text("a.jpg b.jpg\n")
    for layout in ("posebench", "hloc", "oanet"):
        writers.WRITERS[layout](folder / "FILES" / layout)
    writers.truth(folder / "SET")
    databases.write(folder / "database.db", databases.scene(3))
    test_matches.write(folder, databases.scene(3))
    np.savez(folder / "matches.npz", **dict(zip(("x0", "x1"), test_matches.points()[0], strict=True)))
    (folder / "my_conf" / "estimator").mkdir(parents=True)
    page = (SOURCE / "README.md").read_text()
    yaml = re.findall(r"```yaml\n# my_conf/estimator/mine.yaml\n(.*?)```", page, re.DOTALL)
    (folder / "my_conf" / "estimator" / "mine.yaml").write_text(yaml[0] + "hypotheses: 100\n")
    (folder / "my_package.py").write_text(
        "from fmtorch import presets\n\n\n"
        "def MyEstimator(threshold, hypotheses):\n"
        "    return presets.build('estimator', 'ransac', threshold=threshold, hypotheses=hypotheses)\n"
    )
    return folder


@contextlib.contextmanager
def as_a_command(words: list[str], folder: Path) -> Iterator[None]:
    """The state of a process of its own, as far as the commands change it."""
    before, argv, threads = Path.cwd(), sys.argv, torch.get_num_threads()
    os.chdir(folder)
    sys.argv = words
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        os.chdir(before)
        sys.argv = argv
        sys.path.remove(str(folder))
        torch.set_num_threads(threads)
        GlobalHydra.instance().clear()


def run(words: list[str], folder: Path) -> None:
    """`python -m MODULE ...`: within this process, which saves its start, where the module can be run twice in one."""
    assert words[:2] == ["python", "-m"], words
    if words[2:4] == ["fmtorch", "report"]:  # defines classes of its own, which the tests' type checker would mistake
        ended = run_command("report", *words[4:], cwd=folder)
        assert ended.returncode == 0, ended.stderr
        return
    with as_a_command(words[2:], folder):
        try:
            runpy.run_module(words[2], run_name="__main__", alter_sys=True)
        except SystemExit as end:
            if end.code not in (None, 0):
                raise AssertionError(f"{shlex.join(words)} ended with: {end.code}") from end


def is_of(command: str, patterns: Iterable[str]) -> bool:
    return any(re.search(pattern, command) for pattern in patterns)


def parameters() -> Iterator[object]:
    """The commands of each page, and apart those that take long."""
    for word, marks in (("", ()), ("slow ", (pytest.mark.slow,))):
        for page in PAGES:
            here = [c for c in commands(page) if not is_of(c, ELSEWHERE) and is_of(c, SLOW) == bool(word)]
            if here:
                yield pytest.param(here, id=f"{word}{page}", marks=marks)


RUN: list[list[str]] = []
"""What has been run; a command that stands on several pages is run once."""


@pytest.mark.parametrize("page_commands", [*parameters()])
def test_the_commands_of_a_page_run(page_commands: list[str], workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FMTORCH_CACHE", str(own_cache(workplace)))
    for command in page_commands:
        print(command)
        if "report" in command and not (workplace / "runs").exists():
            run(smaller("fmtorch eval pipeline=sift_ratio"), workplace)
        words = smaller(command)
        if words not in RUN:
            run(words, workplace)
            RUN.append(words)


@pytest.mark.parametrize("page", PAGES)
def test_a_page_says_what_its_capital_words_are(page: str) -> None:
    """DATA, FOLDER and the like, which a reader replaces, are explained on the page that uses them."""
    spoken = [word for command in commands(page) for word in shlex.split(command, comments=True)]
    words = {name for word in spoken for name in re.findall(r"\b[A-Z]{3,}\b", word)} - {*SETS, "NSGD"}
    text = re.sub(r"```.*?```", "", (SOURCE / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    assert not {word for word in words if f"`{word}`" not in text}


def test_what_is_run_elsewhere_is_there() -> None:
    everything = "\n".join(command for page in PAGES for command in commands(page))
    assert all(re.search(pattern, everything) for pattern in ELSEWHERE)
    assert all(re.search(pattern, everything) for pattern in SLOW)
