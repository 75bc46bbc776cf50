"""Names of runs: short, unlike one another, and about what differs."""

from typing import Any

from fmtorch import presets
from fmtorch.evaluation import run_names


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


def test_options_are_told_of_the_same_preset_only() -> None:
    two = [{**config(), "estimator": with_options("lmeds", hypotheses=n)} for n in (100, 200)]
    assert names(*two) == ["hypotheses=100", "hypotheses=200"]
    assert names(*two, config()) == ["lmeds hypotheses=100", "lmeds hypotheses=200", "ransac"]
    # Unlike its preset, though no other run has that preset.
    assert names(two[0], config()) == ["lmeds hypotheses=100", "ransac"]


def test_identities_tell_apart_what_names_do_not() -> None:
    assert names(config(), {**config(), "learned": ["x"]}) == ["sift_ratio 0abcde", "sift_ratio 1abcde"]
    many = [{**config(), "estimator": {"_target_": "m.M", **dict.fromkeys("abcd", value)}} for value in (1, 2)]
    assert names(*many) == ["sift_ratio 0abcde", "sift_ratio 1abcde"]  # more options than a name tells


def test_a_method_has_one_name_on_all_data_sets() -> None:
    runs = [config("sift_ratio"), config("sift_gms"), config("sift_ratio"), config("sift_gms"), config("sift_gms")]
    names = run_names(runs, [f"{i}abcdefgh" for i in range(5)], ["a", "a", "b", "b", "b"])
    assert names == ["sift_ratio", "sift_gms", "sift_ratio", "sift_gms 3abcde", "sift_gms 4abcde"]
