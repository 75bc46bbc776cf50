"""What benchmarks share: rows that are kept and resumed, what they depend on, methods in one word, memory."""

import dataclasses
from pathlib import Path

import pytest

from fmtorch.geometry import eight_point
from fmtorch.presets import build as preset
from scripts.benchmark import methods, runner
from scripts.benchmark.runner import Item, Kept, Measured, Row, measure
from tests.laws import scene
from tests.scripts.samples import item, pair, read


@dataclasses.dataclass
class Counted(Measured):
    """A method that is interrupted from its call of some number on."""

    name: str
    identity: str = "made with"
    end: int = 1000
    calls: int = 0

    def figures(self, item: Item, seed: int) -> Row:
        self.calls += 1
        if self.calls > self.end:
            raise KeyboardInterrupt
        return {"nsgd": seed + 0.5}


def items(count: int) -> list[Item]:
    return [item(pair(f"orbit/s/{i}"), scene(i, 60)) for i in range(count)]


def test_a_line_that_was_cut_off_goes_and_other_files_stay_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    Kept(path).add([{"pair": "a", "seed": 0}, {"pair": "b", "seed": 0}])
    path.write_bytes(path.read_bytes() + b'{"pair": "\xc3')
    again = Kept(path)
    again.add([{"pair": "b", "seed": 0, "new": True}])
    assert read(path) == again.rows == [{"pair": "a", "seed": 0}, {"pair": "b", "seed": 0}, again.rows[-1]]
    assert again.by("pair", "seed")["b", 0] == {"pair": "b", "seed": 0, "new": True}
    figures = tmp_path / "figures.json"
    figures.write_text('{\n"machine": 1,\n')
    with pytest.raises(SystemExit, match=r"figures\.json, line 1: no row"):
        Kept(figures)
    assert figures.read_text() == '{\n"machine": 1,\n'
    with pytest.raises(SystemExit, match=r"none/rows\.jsonl: there is no folder"):
        Kept(tmp_path / "none" / "rows.jsonl")


def test_an_interrupted_run_goes_on_and_measures_what_others_need(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    with pytest.raises(KeyboardInterrupt):
        measure([Counted("a", end=4), Counted("b")], items(3), 2, Kept(path))
    assert len(read(path)) == 6  # of the first pair both seeds, of the second one; the first call was not counted
    a, b = Counted("a"), Counted("b")
    rows = measure([a, b], items(3), 2, Kept(path))
    assert (a.calls, b.calls) == (4, 4)  # three that were missing, after one that is not counted
    assert rows == measure([Counted("a", end=0), Counted("b", end=0)], items(3), 2, Kept(path))
    assert len(rows) == len(read(path)) == 12
    for other, count, seeds in ((Counted("c"), 3, 1), (Counted("a", "otherwise"), 3, 1), (a, 4, 2), (a, 3, 3)):
        before = other.calls
        measure([other], items(count), seeds, Kept(path))
        assert other.calls > before
    elsewhere = Item(pair("orbit/s/0"), lambda: None)  # a pair of which nothing can be measured has no row
    assert measure([Counted("d", end=0)], [elsewhere], 1, Kept(None)) == []


def test_what_a_row_was_made_with_is_options_code_and_learned_files(monkeypatch: pytest.MonkeyPatch) -> None:
    def identities() -> list[str]:
        words = ["usac", "usac:threshold=0.7", "usac@ratio_prior", "poselib", "truth", "truth@lc:soft=true"]
        own = dict.fromkeys(words)
        monkeypatch.setattr(methods.presets, "build", lambda group, name, **changed: preset(group, name, **changed)
                            if name != "poselib" else None)  # fmt: skip
        return [methods.method(word).identity for word in own]

    monkeypatch.setattr(runner, "libraries", lambda others: dict.fromkeys(others, "1"))  # PoseLib may be absent
    before = identities()
    assert len(set(before)) == len(before)
    assert identities() == before
    with monkeypatch.context() as patch:
        patch.setattr(runner, "code_digest", lambda module: module)
        assert not set(before[:4]) & set(identities()[:4])
    monkeypatch.setattr(runner, "libraries", lambda others: dict.fromkeys(others, "2"))
    assert identities()[3] != before[3]


def test_options_are_numbers_switches_or_words_and_those_of_a_part_are_nested() -> None:
    assert methods.options("a=0.5,b=true,c=null,d=focal") == {"a": 0.5, "b": True, "c": None, "d": "focal"}
    assert methods.options("a.b=1,c=x,a.d=2") == {"a": {"b": 1, "d": 2}, "c": "x"}
    assert methods.options("") == {}


def test_truth_is_the_fit_that_starts_from_the_true_matrix() -> None:
    exact = scene(0, 200, outliers=0, noise=0)
    (F,), _ = eight_point(exact.x0.double(), exact.x1.double())
    noisy = scene(0, 200, outliers=0.5, noise=0.3)
    both = [item(pair("orbit/0/0", F.numpy()), noisy), item(pair("orbit/0/1", F.flip(0).numpy()), noisy)]
    for spec in ("truth", "truth@position_consistency"):
        near, far = (row["nsgd"] for row in measure([methods.method(spec)], both, 1, Kept(None)))
        assert 1e-6 < near < 0.01, spec  # the matches' noise moves it
        assert far > 0.05, spec  # and does not bring it home from elsewhere
