import pytest

from fmtorch.evaluation import common_reasons


@pytest.mark.parametrize(
    ("reasons", "expected"),
    [
        (["7 matches; at least 8 are needed"], {"7 matches; at least 8 are needed": 1}),
        (
            [f"{n} matches; at least 8 are needed" for n in (7, 5, 7, 10)],
            {"5 to 10 matches; at least 8 are needed": 4},  # in the order of numbers, not of letters
        ),
        (
            ["no image scene/00000012.png", "no image scene/00000034.png"],
            {"no image scene/000000….png": 2},
        ),
        (["none in image 0", "late", "none in image 1"], {"none in image 0 to 1": 2, "late": 1}),
        (["share 0.5, too small", "share 0.25, too small"], {"share 0.25 to 0.5, too small": 2}),
        (["F7", "8"], {"…": 2}),
        ([], {}),
    ],
)  # fmt: skip
def test_reasons_that_differ_in_numbers_are_one(reasons: list[str], expected: dict[str, int]) -> None:
    common = common_reasons(reasons, 3)
    assert common == expected
    assert list(common) == list(expected)


def test_the_commonest_come_first_and_others_are_left_out() -> None:
    reasons = ["a"] * 2 + ["b"] * 4 + ["c"] + ["d"] * 3
    assert list(common_reasons(reasons, 3).items()) == [("b", 4), ("d", 3), ("a", 2)]
