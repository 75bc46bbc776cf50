"""Names of runs: short, unlike one another, and about what differs."""

from typing import Any

from fmtorch import presets
from fmtorch.evaluation.page import run_names


def config(pipeline: str = "sift_ratio", estimator: str = "ransac", **changes: Any) -> dict[str, Any]:
    stages = {
        "features": presets.load("features", "sift"),
        "pruner": [{"ratio": {"_target_": "a.Ratio", "threshold": 0.8}}, {"one_to_one": {"_target_": "a.OneToOne"}}],
        "estimator": presets.load("estimator", estimator),
    }
    return {"pipeline": pipeline, **stages, "seed": 0, "version": "1", **changes}


def names(*configs: dict[str, Any]) -> list[str]:
    return run_names(configs, [f"{i}abcdefgh" for i in range(len(configs))])


def with_options(estimator: str, **options: Any) -> dict[str, Any]:
    return {**presets.load("estimator", estimator), **options}


def ratio(threshold: float) -> list[dict[str, Any]]:
    return [{"ratio": {"_target_": "a.Ratio", "threshold": threshold}}, {"one_to_one": {"_target_": "a.OneToOne"}}]


def test_pipelines_alone_need_no_more_than_their_names() -> None:
    assert names(config()) == ["sift_ratio"]
    assert names(config("sift_ratio"), config("sift_gms", "lmeds")) == ["sift_ratio", "sift_gms"]


def test_what_all_runs_share_is_left_out() -> None:
    assert names(config(), config(estimator="lmeds")) == ["ransac", "lmeds"]
    assert names(config(seed=1), config(seed=2)) == ["seed=1", "seed=2"]
    assert names(config(pruner=ratio(0.8)), config(pruner=ratio(0.9))) == ["threshold=0.8", "threshold=0.9"]
    assert names(config(), config(estimator="lmeds"), config("sift_gms")) == [
        "sift_ratio ransac", "sift_ratio lmeds", "sift_gms",
    ]  # fmt: skip


def test_a_pipeline_as_it_is_needs_no_more_words() -> None:
    usual = {"pipeline": "sift_ratio", **(presets.pipeline_stages("sift_ratio") or {})}
    changed = {**usual, "estimator": presets.load("estimator", "lmeds")}
    assert names(usual, changed) == ["sift_ratio", "sift_ratio lmeds"]
    assert presets.pipeline_stages("nowhere") is None


def test_options_are_told_of_the_same_preset_only() -> None:
    two = [{**config(), "estimator": with_options("lmeds", hypotheses=n)} for n in (100, 200)]
    assert names(*two) == ["hypotheses=100", "hypotheses=200"]
    assert names(*two, config()) == ["lmeds hypotheses=100", "lmeds hypotheses=200", "ransac"]
    # Unlike its preset, though no other run has that preset.
    assert names(two[0], config()) == ["lmeds hypotheses=100", "ransac"]


def test_parts_of_ones_own_go_by_their_class() -> None:
    mine = {**config(), "estimator": {"_target_": "my.package.Mine", "threshold": 1.0}}
    other = {**mine, "estimator": {"_target_": "my.package.Mine", "threshold": 2.0}}
    assert names(mine, config()) == ["Mine", "ransac"]
    assert names(mine, other) == ["threshold=1.0", "threshold=2.0"]
    assert names({"pipeline": "theirs"}, {}) == ["theirs", "run"]
    assert names({"pipeline": "theirs"}, config("theirs"))[0] == "theirs"  # it says nothing of its stages


def test_identities_tell_apart_what_names_do_not() -> None:
    assert names(config(), {**config(), "learned": ["x"]}) == ["sift_ratio 0abcde", "sift_ratio 1abcde"]
    many = [{**config(), "estimator": {"_target_": "m.M", **dict.fromkeys("abcd", value)}} for value in (1, 2)]
    assert names(*many) == ["sift_ratio 0abcde", "sift_ratio 1abcde"]  # more options than a name tells


def test_a_method_has_one_name_on_all_data_sets() -> None:
    runs = [config("sift_ratio"), config("sift_gms"), config("sift_ratio"), config("sift_gms"), config("sift_gms")]
    names = run_names(runs, [f"{i}abcdefgh" for i in range(5)], ["a", "a", "b", "b", "b"])
    assert names == ["sift_ratio", "sift_gms", "sift_ratio", "sift_gms 3abcde", "sift_gms 4abcde"]


def test_versions_are_told_by_their_first_digits() -> None:
    runs = [config(version=f"0.1.0+g{commit}") for commit in ("5c0279c1d2e3", "6c0279c1d2e3.dirty.0f1e2d3c4b5a")]
    assert names(*runs) == ["version=0.1.0+g5c0279c", "version=0.1.0+g6c0279c.dirty.0f1e2d3"]
