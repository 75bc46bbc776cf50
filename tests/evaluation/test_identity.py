"""What defines a run: everything that decides a result is in its identity, nothing that does not."""

import dataclasses
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from fmtorch import presets
from fmtorch.core import Correspondences, Estimate, Pruner
from fmtorch.evaluation import run_identity
from fmtorch.pipeline import Pipeline, build_pipeline, load_pipeline
from fmtorch.runs import identity_digest, libraries
from tests.helpers import compose

GROUPS = ("features", "matcher", "pruner", "estimator", "dataset")


@dataclasses.dataclass(frozen=True)
class Learned:
    """A stage of any kind that says which file it was learned from."""

    model: Path

    def __call__(self, c: Correspondences) -> Correspondences:
        return c


class Secretive:
    """A stage that reads a file and says nothing of it."""

    def __init__(self, weights: str) -> None:
        self.values = Path(weights).read_bytes()

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        raise NotImplementedError


class Described:
    """A stage whose `identity` names its file, and a network of its own."""

    def __init__(self, model: Path) -> None:
        self.identity = {"threshold": 0.5, "files": [model]}

    def __call__(self, c: Correspondences) -> Correspondences:
        return c


def identity(*overrides: str, pipeline: Pipeline | None = None, **own: dict[str, object]) -> dict[str, object]:
    composed = compose("eval", ("pipeline=sift_ratio", "cache=off", *overrides))
    config = OmegaConf.create({**{name: composed[name] for name in composed}, **own})
    return run_identity(config, "sift_ratio", pipeline or build_pipeline(config), "abc")


def test_what_changes_speed_alone_is_no_part_of_it() -> None:
    plain = identity()
    for change in ("limit=3", "batch=1", "workers=7", "processes=true", "device=cuda", "output=x", "cache_limit=1"):
        assert identity(change) == plain, change
    for change in ("seed=1", "pruner.ratio.threshold=0.9", "pruner=[one_to_one,ratio]", "dataset.size=full"):
        assert identity_digest(identity(change)) != identity_digest(plain), change


def test_signed_translations_are_part_of_it_and_folded_ones_change_no_earlier_identity() -> None:
    config = compose("eval", ("pipeline=sift_ratio", "cache=off"))
    pipeline = build_pipeline(config)
    folded, signed = (run_identity(config, "sift_ratio", pipeline, "abc", signed=s) for s in (False, True))
    assert "pose" not in folded
    assert signed == {**folded, "pose": {"signed": True}}


def test_versions_of_libraries_are_part_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert {"torch", "opencv", "onnxruntime", "numpy"} <= set(libraries())
    assert identity()["libraries"]["torch"] == torch.__version__.partition("+")[0]  # not for which device it was built
    assert "poselib" not in identity()["libraries"]
    pytest.importorskip("poselib", reason="poselib (extra `peers`) is not installed")
    assert "poselib" in identity("estimator=poselib")["libraries"]


def test_whether_kernels_are_used_is_part_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FMTORCH_KERNELS", "off")
    assert identity()["kernels"] == "off"
    monkeypatch.setenv("FMTORCH_KERNELS", "on")
    numba = pytest.importorskip("numba", reason="numba is not installed")
    assert identity()["kernels"] == f"numba {numba.__version__}"


def test_learned_files_of_every_stage_are_part_of_it(tmp_path: Path) -> None:
    files = {name: tmp_path / f"{name}.bin" for name in ("matcher", "first", "second", "estimator")}
    for name, file in files.items():
        file.write_bytes(name.encode())

    def learned() -> dict[str, list[str]]:
        pruners: dict[str, Pruner] = {"a": Learned(files["first"]), "b": Described(files["second"])}
        estimator = {"_target_": f"{__name__}.Secretive", "weights": str(files["estimator"])}
        parts = Pipeline(
            presets.build("features", "rootsiftpca"), Learned(files["matcher"]), pruners,  # type: ignore[arg-type]
            presets.instantiate(estimator, "estimator"),
        )  # fmt: skip
        digests = identity(pipeline=parts, estimator=estimator)["learned"]
        assert isinstance(digests, dict)
        return digests

    before = learned()
    assert {group: len(digests) for group, digests in before.items()} == {
        "features": 1, "matcher": 1, "pruner": 2, "estimator": 1,
    }  # fmt: skip
    for name, file in files.items():
        file.write_bytes(b"other")
        now = learned()
        group = "pruner" if name in ("first", "second") else name
        assert {g for g in now if now[g] != before[g]} == {group}, name
        before = now


@pytest.mark.parametrize("group", GROUPS)
def test_code_of_a_users_own_stage_is_part_of_it(group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert identity()["code"] == {}
    own = {"_target_": f"{__name__}.Learned", "model": "x"}
    parts = load_pipeline("sift_ratio")
    changed = {group: {"mine": own} if group == "pruner" else own}
    first = identity(pipeline=parts, **changed)
    assert list(first["code"]) == [f"{__name__}.Learned"]  # type: ignore[call-overload]
    monkeypatch.setattr("fmtorch.evaluation.run.code_digest", lambda module: f"edited {module}")
    second = identity(pipeline=parts, **changed)
    assert second["code"] == {f"{__name__}.Learned": f"edited {__name__}"}
    assert identity_digest(first) != identity_digest(second)
