"""`MatchedPairs`: computed once, resumed, never stale, never damaged, readable from any process; its files."""

import dataclasses
import hashlib
import pickle
import re
import runpy
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pytest
import torch
from torch.utils.data import DataLoader

from fmtorch import presets, training
from fmtorch.data import DataError, ImagePair, ImageSource, load
from fmtorch.pipeline import Pipeline, load_pipeline
from fmtorch.pruning import LC
from fmtorch.pruning.networks.learned import predict
from fmtorch.scenes import FAMILIES, PLANS, RenderedPairs, Task
from fmtorch.training import MatchedPairs, OANetPairs, SimilarLengthBatches, collate, collate_trimmed
from fmtorch.training.labelled import label
from fmtorch.training.stored_matches import SCHEMA, Shard, ShardError, write_shard
from tests.io import writers
from tests.training.conftest import FAMILY, SIFT, TINY, exact

PAGE = Path(__file__).resolve().parents[2] / "docs" / "guides" / "training.md"


def contents(folder: Path) -> dict[str, str]:
    return {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in folder.glob("shard-*")}


class Some(list[ImagePair]):
    name, digest = "some", "1"


def test_items_are_the_pipelines_matches_with_labels(rendered: RenderedPairs, matched: MatchedPairs) -> None:
    pipeline = load_pipeline("sift_ratio", overrides=["pruner=[one_to_one]"])
    assert len(matched) == len(rendered) > 4
    assert not matched.failures
    by_identity = {pair.identity: pair for pair in rendered}
    for index in range(0, len(matched), 2):
        about = matched.pairs[index]
        pair = by_identity[about["identity"]]
        expected = pipeline.correspondences([pair])[0].correspondences
        item = matched[index]
        c = item.correspondences
        for name in ("x0", "x1", "ratio", "mutual", "lafs0", "lafs1", "size0", "size1", "K0", "K1", "key", "mask"):
            assert torch.equal(getattr(c, name), getattr(expected, name)), name
            assert getattr(c, name).dtype == getattr(expected, name).dtype
        np.testing.assert_allclose(item.F[0].numpy(), pair.F, atol=1e-15)
        x0, x1 = (x[0].double().numpy() for x in (c.x0, c.x1))
        assert item.label[0].tolist() == label(rendered, pair, x0, x1).tolist()
        assert about["inliers"] == int(item.inlier.sum())
        assert about["inliers"] + about["outliers"] == int(item.labelled.sum())
        assert about["scene"] == pair.scene
    assert sum(about["inliers"] for about in matched.pairs) > 100


def test_computed_once_by_any_number_of_workers(rendered: RenderedPairs, matched: MatchedPairs, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    two = MatchedPairs(rendered, **SIFT, root=tmp_path, workers=2, progress=lambda *c: calls.append(c))
    assert contents(two.folder) == contents(matched.folder)
    assert (two.folder.name, calls[0]) == (matched.folder.name, (0, len(rendered)))
    assert calls[-1] == (len(rendered), len(rendered))
    pipeline = load_pipeline("sift_ratio", overrides=["pruner=[one_to_one]", f"cache={tmp_path / 'features'}"])
    calls.clear()
    again = MatchedPairs(rendered, pipeline, root=tmp_path, progress=lambda *c: calls.append(c))
    assert again.folder == two.folder  # neither a feature cache nor the estimator matters
    assert calls == [(len(rendered), len(rendered))]


def test_an_interrupted_computation_goes_on(rendered, matched, tmp_path, monkeypatch):
    written, interrupts = list[Path](), [False, True]  # at the second file, once

    def write(path: Path, rows: Any) -> None:
        if interrupts and interrupts.pop(0):
            raise KeyboardInterrupt
        written.append(path)
        write_shard(path, rows)

    monkeypatch.setattr("fmtorch.training.matched_pairs.write_shard", write)
    with pytest.raises(KeyboardInterrupt):
        MatchedPairs(rendered, **SIFT, root=tmp_path, workers=1)
    folder = tmp_path / matched.folder.name
    assert set(contents(folder)) == {path.name for path in written}
    assert len(contents(matched.folder)) > 1
    calls: list[tuple[int, int]] = []
    MatchedPairs(rendered, **SIFT, root=tmp_path, workers=1, progress=lambda *c: calls.append(c))
    assert 0 < calls[0][0] < len(rendered) == calls[-1][0]
    assert len(written) == len(set(written)) == len(contents(matched.folder))
    assert contents(folder) == contents(matched.folder)


@pytest.mark.parametrize("damage", ["changed", "cut", "fewer pairs"])
def test_a_damaged_file_is_computed_anew(rendered, matched, tmp_path, damage):
    folder = shutil.copytree(matched.folder, tmp_path / matched.folder.name)
    victim = folder / "shard-00001.arrow"
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= damage == "changed"
    victim.write_bytes(data[:-100] if damage == "cut" else data)
    if damage == "fewer pairs":
        write_shard(victim, [])
    with pytest.warns(UserWarning, match=r"shard-00001\.arrow.* computed anew"):
        MatchedPairs(rendered, **SIFT, root=tmp_path, workers=1)
    assert contents(folder) == contents(matched.folder)


def test_what_would_change_the_matches_has_a_folder_of_its_own(rendered, matched, tmp_path, monkeypatch):
    pairs = Some([rendered[0]])
    names = {MatchedPairs(pairs, **SIFT, root=tmp_path).folder.name}
    names.add(MatchedPairs(pairs, "sift_ratio", root=tmp_path).folder.name)
    names.add(MatchedPairs(pairs, "sift_ratio", overrides=["features.max_features=200"], root=tmp_path).folder.name)
    monkeypatch.setattr("fmtorch.training.labelled.VERSION", 99)
    names.add(MatchedPairs(pairs, **SIFT, root=tmp_path).folder.name)
    pairs.digest = "2"
    names.add(MatchedPairs(pairs, **SIFT, root=tmp_path).folder.name)
    assert len(names) == 5
    assert all((tmp_path / name / "about.json").is_file() for name in names)


def test_pairs_that_fail_are_left_out_and_reported(rendered: RenderedPairs, tmp_path: Path) -> None:
    good = rendered[0]
    gone = dataclasses.replace(good, identity="gone", image1=ImageSource("gone", tmp_path / "gone.png"))
    unusable = dataclasses.replace(good, identity="unusable", problem="line 3: F is zero")
    with pytest.warns(UserWarning, match="2 of 3 pairs have no matches"):
        matches = MatchedPairs(Some([gone, good, unusable]), **SIFT, root=tmp_path)
    assert len(matches) == 1
    assert [about["identity"] for about in matches.pairs] == [good.identity]
    assert dict(matches.failures)["unusable"] == "line 3: F is zero"
    assert "gone.png" in dict(matches.failures)["gone"]
    stages = load_pipeline("sift_ratio")
    nameless = Pipeline(stages.extractor, lambda a, b: stages.matcher(a, b), {}, stages.estimator)
    for pairs, pipeline, overrides, said in (
        ([unusable], "sift_ratio", SIFT["overrides"], "1 of 1 pairs have no matches"),
        ([], "sift_ratio", SIFT["overrides"], "no pairs"),
        ([good], "sift", (), "no preset 'sift'"),
        ([good], "sift_ratio", ["pruner=[one_to_on]"], "no preset 'one_to_on' in pruner; there are: one_to_one"),
        ([good], stages, ["pruner=[]"], "overrides"),
        ([good], nameless, (), "cannot be kept"),
    ):
        with pytest.raises(ValueError, match=said):
            MatchedPairs(Some(pairs), pipeline, overrides=overrides, root=tmp_path / "b")


def test_workers_of_a_loader_read_what_this_process_reads(matched: MatchedPairs) -> None:
    pairs = training.StoredMatches(matched.folder, augmentation=training.Augmentation(), seed=5)
    assert torch.equal(pairs[0].label, pairs[0].label)  # files are open when the workers start
    assert len(pickle.dumps(pairs)) < 1000 * len(pairs) + 5000
    batches = SimilarLengthBatches(pairs, 3, seed=1)
    batches.set_epoch(2)
    sent = pickle.loads(pickle.dumps(pairs))  # as processes get them that are not forked
    loaded = list(DataLoader(sent, batch_sampler=batches, collate_fn=collate_trimmed, num_workers=1))
    assert len(loaded) == len(batches)
    for draws, batch in zip(batches, loaded, strict=True):
        expected = collate_trimmed([pairs[draw] for draw in draws])
        assert torch.equal(batch.label, expected.label)
        assert torch.equal(batch.correspondences.x0, expected.correspondences.x0)
        assert torch.equal(batch.F, expected.F)


def test_validation_scenes_are_the_last_of_each_family(matched: MatchedPairs) -> None:
    first, validation = training.split_scenes(matched, last=1)
    assert len(first) + len(validation) == len(matched)
    parts = [{about["scene"] for about in part.pairs} for part in (first, validation)]
    assert parts == [{"indoor-train-000"}, {"indoor-train-001"}]
    where = [about["identity"] for about in matched.pairs].index(validation.pairs[0]["identity"])
    assert torch.equal(validation[0].label, matched[where].label)
    with pytest.raises(ValueError, match="2 scenes"):
        training.split_scenes(matched)


def rows(n: int = 5) -> list[dict[str, Any]]:
    rng = np.random.default_rng(0)
    of = {"family": "set", "scene": "s", "reason": "", "F": rng.normal(size=9), "size0": np.array([480, 640])}
    drawn = []
    for count in rng.integers(1, 50, n).tolist():
        numbers = {"x0": 2, "x1": 2, "ratio": 1, "lafs0": 6, "lafs1": 6}  # of each match
        arrays = {name: rng.normal(size=count * size).astype(np.float32) for name, size in numbers.items()}
        arrays |= {"label": rng.integers(-1, 2, count).astype(np.int8), "mutual": np.ones(count, np.uint8)}
        about = {"key": int(rng.integers(-(2**62), 2**62)), "identity": f"{count}", "matches": count, "inliers": 1}
        drawn.append({**of, **about, "outliers": count - 1, "size1": np.array([300, 500]), **arrays})
    none = dict.fromkeys(("matches", "inliers", "outliers"), 0)
    return [*drawn, {"key": 7, "identity": "failed", "family": "set", "scene": "s", "reason": "no keypoints", **none}]


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "shard.arrow"
    written = rows()
    write_shard(path, written)
    shard = Shard(path, verify=True)
    assert len(shard) == len(written)
    index = shard.index()
    for number, row in enumerate(written):
        for name, values in index.items():
            assert values[number] == row[name]
        arrays = shard.read(number)
        expected = {name: value for name, value in row.items() if isinstance(value, np.ndarray)}
        assert set(arrays) == set(expected)
        for name, value in expected.items():
            assert arrays[name].dtype == value.dtype
            np.testing.assert_array_equal(arrays[name].ravel(), value)
    first = shard.read(0, ("x0", "lafs1", "F", "K0"))
    n = written[0]["matches"]
    assert {name: value.shape for name, value in first.items()} == {"x0": (n, 2), "lafs1": (n, 2, 3), "F": (3, 3)}
    assert not first["x0"].flags.owndata  # a view of the file
    assert [file.name for file in tmp_path.iterdir()] == ["shard.arrow"]
    table = pa.ipc.open_file(path).read_all()  # as any library of data frames does
    assert (table.schema.names, table.column("matches").to_pylist()[-1]) == (SCHEMA.names, 0)
    write_shard(tmp_path / "again.arrow", rows())
    assert (tmp_path / "again.arrow").read_bytes() == path.read_bytes()


def test_any_changed_byte_of_the_values_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "shard.arrow"
    write_shard(path, rows())
    intact = path.read_bytes()
    values = np.random.default_rng(0).choice(len(intact), 60, replace=False)
    noticed = 0
    for position in values:
        changed = bytearray(intact)
        changed[position] ^= 0x10
        path.write_bytes(changed)
        try:
            shard = Shard(path, verify=True)
        except ShardError:
            noticed += 1
        else:  # padding between buffers, or a number in the headers that no reader looks at
            path.write_bytes(intact)
            for row in range(len(shard)):
                for name, value in Shard(path).read(row).items():
                    np.testing.assert_array_equal(shard.read(row)[name], value)
    assert noticed > 20


def test_what_is_no_such_file_is_refused(tmp_path: Path) -> None:
    path, batch = tmp_path / "shard.arrow", pa.record_batch({"a": [1]})
    with pytest.raises(ShardError, match=r"shard\.arrow"):
        Shard(path)
    write_shard(path, rows())
    intact = path.read_bytes()
    with pa.ipc.new_file(str(path), batch.schema) as writer:  # other columns
        writer.write_batch(batch)
    for content in (path.read_bytes(), b"", intact[: len(intact) // 2], pickle.dumps([1])):
        path.write_bytes(content)
        with pytest.raises(ShardError, match=r"shard\.arrow"):
            Shard(path)


@pytest.mark.skipif(not PAGE.is_file(), reason="the documentation is in a checkout only")
def test_the_training_loop_of_the_page_runs(rendered, cache, tmp_path, monkeypatch):
    section = PAGE.read_text(encoding="utf-8").split("## Labelled matches")[1]
    code = re.search(r"```python\n(.*?)```", section, re.DOTALL)[1]
    loop = code.partition("\n\n")[2].strip().splitlines()
    assert len(loop) == 15
    assert 'load("rendered", split="train")' in code
    monkeypatch.setenv("FMTORCH_CACHE", str(cache))
    monkeypatch.setattr("fmtorch.scenes.dataset.PLANS", {("small", "train"): TINY})  # what `rendered` has drawn
    monkeypatch.setattr("fmtorch.scenes.dataset.FAMILIES", {FAMILY: FAMILIES[FAMILY]})
    (tmp_path / "loop.py").write_text(code)
    torch.manual_seed(0)
    names = runpy.run_path(str(tmp_path / "loop.py"))
    assert torch.isfinite(names["loss"])
    assert len(names["matches"]) == len(rendered)
    assert any((cache / "matched").iterdir())
    first = next(iter(names["loader"]))
    assert first.label.shape == first.correspondences.mask.shape


class Pairs(training.StoredMatches):
    """Pairs of which only the lengths are known, as various as those of the rendered scenes."""

    def __init__(self, n: int = 300) -> None:
        self.counts = np.random.default_rng(0).lognormal(6, 0.8, n).astype(int) + 20

    def __len__(self) -> int:
        return len(self.counts)

    def lengths(self, epoch: int) -> Sequence[float]:
        return self.counts.tolist()


def padding(m: training.LabelledMatches) -> float:
    return 1 - float(m.correspondences.mask.double().mean())


def test_every_pair_comes_once_an_epoch_in_other_batches_each_time() -> None:
    batches = SimilarLengthBatches(Pairs(), 32, seed=1)
    epochs = []
    for epoch in range(2):
        batches.set_epoch(epoch)
        drawn = list(batches)
        assert len(drawn) == len(batches) == 10
        assert sorted(d.pair for batch in drawn for d in batch) == list(range(300))
        assert {d.epoch for batch in drawn for d in batch} == {epoch}
        assert all(len({d.matches for d in batch}) == 1 for batch in drawn)
        assert sorted(map(len, drawn)) == [12, *[32] * 9]
        epochs.append([frozenset(d.pair for d in batch) for batch in drawn])
    assert not set(epochs[0]) & set(epochs[1])
    sizes = [batch[0].matches for batch in drawn]
    assert len(set(sizes)) > 5
    assert all(50 <= size <= 4000 for size in sizes)


def test_batches_are_a_function_of_seed_and_epoch_and_go_on_where_they_stopped() -> None:
    batches, again, other = (SimilarLengthBatches(Pairs(), 16, seed=seed) for seed in (2, 2, 3))
    for each, start in ((batches, 0), (again, 5), (other, 0)):
        each.set_epoch(7, start=start)
    epoch = list(batches)
    assert (list(again), len(again)) == (epoch[5:], len(epoch) - 5)
    assert list(other) != epoch


@pytest.mark.parametrize("world_size", [2, 3, 4])
def test_ranks_share_the_epoch_out_and_have_as_many_batches(world_size: int) -> None:
    ranks = [list(SimilarLengthBatches(Pairs(), 32, rank=r, world_size=world_size)) for r in range(world_size)]
    assert len({len(drawn) for drawn in ranks}) == 1
    single = list(SimilarLengthBatches(Pairs(), 32))
    shared = [batch for drawn in zip(*ranks, strict=True) for batch in drawn]
    assert shared[: len(single)] == single
    assert shared[len(single) :] == single[: len(shared) - len(single)]
    sampler = SimilarLengthBatches(Pairs(), 32, rank=world_size - 1, world_size=world_size)
    assert len(sampler) == len(ranks[-1])


def test_trimmed_collation_keeps_real_matches_and_the_bound() -> None:
    items = [exact(seed, n=n) for seed, n in enumerate((20, 150, 160, 170, 400))]
    assert padding(collate(items)) > 0.5
    batch = collate_trimmed(items)
    assert padding(batch) <= 0.2
    for i, item in enumerate(items):
        mine = batch[i].compact()
        n = mine.label.shape[1]
        assert torch.equal(mine.label, item.label[:, :n])
        assert torch.equal(mine.correspondences.x0, item.correspondences.x0[:, :n])
    assert padding(collate_trimmed(items, padding=0.0)) == 0
    with pytest.raises(ValueError, match="at least one"):
        collate_trimmed([])


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="batch is 0"):
        SimilarLengthBatches(Pairs(), 0)
    with pytest.raises(ValueError, match="rank is 2 of 2"):
        SimilarLengthBatches(Pairs(), rank=2, world_size=2)
    assert training.Draw(3) == (3, 0, None)


def oanet(tmp_path: Path, **options: Any) -> tuple[OANetPairs, MatchedPairs]:
    """The pairs of a file read directly, and through the stages of a pipeline and shards."""
    root = writers.write_oanet(tmp_path / "oanet", outliers=20)
    overrides, before = ["pruner=[one_to_one]"], [presets.build("pruner", "one_to_one")]
    given = load("h5", root=root, layout="oanet")
    stored = MatchedPairs(given, "sift_ratio", overrides=overrides, root=tmp_path / "matched", workers=1, **options)
    return OANetPairs(root, before=before, **options), stored


@pytest.mark.parametrize("labels", ["geodesic", "pixels"])
def test_oanets_files_train_as_the_same_pairs_matched(labels: str, tmp_path: Path) -> None:
    direct, stored = oanet(tmp_path, labels=labels)
    place = {about["key"]: i for i, about in enumerate(stored.pairs)}
    order = [place[about["key"]] for about in direct.pairs]
    torch.manual_seed(0)
    network = LC(channels=8, blocks=1, coordinates="K")
    objective = training.Objective(coordinates="K", classification_steps=0)
    batches = [collate([direct[i] for i in range(len(direct))]), collate([stored[i] for i in order])]
    assert torch.equal(batches[0].label, batches[1].label)
    assert {0, 1} <= set(batches[0].label.unique().tolist())
    losses = [objective(predict(network, b.correspondences), b, 1)["loss"] for b in batches]
    torch.testing.assert_close(losses[0], losses[1], rtol=1e-6, atol=0)
    assert direct.lengths(0) == [float(about["matches"]) for about in direct.pairs]
    augmented = [each.augmented(training.Augmentation(), seed=3) for each in (direct, stored)]
    a, b = augmented[0][1], augmented[1][order[1]]
    torch.testing.assert_close(a.correspondences.x0, b.correspondences.x0, rtol=0, atol=1e-3)
    assert [round(n, 9) for n in augmented[1].select(order).lengths(1)] != [0.0] * len(direct)


def test_workers_read_oanets_files_for_themselves(tmp_path: Path) -> None:
    direct, _ = oanet(tmp_path)
    alone = [direct[i].correspondences.x0 for i in (2, 0, 1)]
    for pairs in (direct, pickle.loads(pickle.dumps(direct))):
        loaded = DataLoader(pairs, sampler=[2, 0, 1], batch_size=None, num_workers=2)
        assert all(torch.equal(a, m.correspondences.x0) for a, m in zip(alone, loaded, strict=True))


@pytest.mark.parametrize(
    ("key", "change", "said"),
    [
        ("ys", None, "'ys' is missing, which labels=geodesic needs"),
        ("ys/1", None, "'ys/1' is missing"),
        ("ys/1", np.zeros((4, 1)), "'ys/1' has 4 entries, but 'xs/1' has 65"),
        ("ratios", None, "'ratios' is missing; give"),
        ("ts/1", np.zeros((3, 1)), "'ts/1' is zero"),
        ("xs/1", np.zeros((1, 0, 4)), ""),
        ("xs", None, "'xs' is missing; it is no file of OANet's layout"),
    ],
)
def test_what_oanets_files_lack_is_named(key: str, change: Any, said: str, tmp_path: Path) -> None:
    path = next(writers.write_oanet(tmp_path / "oanet").glob("*"))
    with h5py.File(path, "a") as file:
        del file[key]
        if change is not None:
            file[key] = change
    if not said:
        with pytest.warns(UserWarning, match="1 of 3 pairs have no matches .*'xs/1' is empty"):
            assert len(OANetPairs(path)) == 2
        return
    with pytest.raises(DataError, match=f"{path.name}: {said}"):  # noqa: PT012
        pairs = OANetPairs(path)
        pairs.expect_ratios("give")
        pairs[1]


def test_truncated_files_of_oanet_are_named(tmp_path: Path) -> None:
    path = next(writers.write_oanet(tmp_path / "oanet").glob("*"))
    for length in (100, 0):
        path.write_bytes(path.read_bytes()[:length])
        with pytest.raises(DataError, match="hdf5: is not a valid HDF5 file"):
            OANetPairs(path)


def test_training_has_no_scene_of_the_test_split(matched: MatchedPairs) -> None:
    """What the scenes are made of is compared in tests/scenes/test_rendered.py."""
    plans = {plan for (_, split), plan in PLANS.items() if split == "test"}
    test = {Task(family, "test", n, 0, plan).name for plan in plans for family in FAMILIES for n in range(plan.scenes)}
    training = {about["scene"] for about in matched.pairs}
    assert (bool(test), bool(training), training & test) == (True, True, set())
    assert all(f"rendered/{about['scene']}/" in about["identity"] for about in matched.pairs)
