"""OANet, CLNet, NCMNet, ConvMatch: sizes, layers against slow references, stages, few matches, authors' checkpoints."""

import pickle
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from fmtorch.core import Correspondences, collate
from fmtorch.pruning import LearnedPruner
from fmtorch.pruning.networks import CLNet, ConvMatch, NCMNet, OANet, layers
from fmtorch.pruning.networks.layers import Slots
from fmtorch.training import LabelledMatches, Objective
from scripts.convert_checkpoint import NETWORKS, UNUSED, authors_key, main
from tests.laws import calibrated, degenerate, scene
from tests.reference import pruner_layers as reference
from tests.training.conftest import exact

SMALL = {
    "oanet": lambda: OANet(channels=16, blocks=4, clusters=10),
    "clnet": lambda: CLNet(channels=16),
    "ncmnet": lambda: NCMNet(channels=16, clusters=10),
    "convmatch": lambda: ConvMatch(channels=16, layers=2, grid=4),
}
every = pytest.mark.parametrize("name", SMALL)
PAIRS = (9, 4, 23)  # matches: more and fewer than neighbours


def randomized(module: nn.Module, seed: int = 0) -> nn.Module:
    """In double precision, at inference, with statistics and scales that are not those of the start."""
    generator = torch.Generator().manual_seed(seed)
    for key, value in module.state_dict().items():
        value.copy_(torch.rand(value.shape, generator=generator) + (0.5 if key.endswith("var") else -0.5))
    return module.double().eval()


@pytest.mark.parametrize(
    ("network", "count"), [(OANet, 2_472_538), (CLNet, 953_606), (NCMNet, 4_485_238), (ConvMatch, 7_493_670)]
)
def test_parameters_are_as_many_as_the_authors(network: type[nn.Module], count: int) -> None:
    """By their code; of CLNet and NCMNet without 313,728 and 280,704 of perceptrons that it has and never calls."""
    with torch.device("meta"):
        assert sum(p.numel() for p in network().parameters()) == count


def features(channels: int) -> tuple[Tensor, Slots]:
    """Of pairs with padding, and one without matches."""
    generator = torch.Generator().manual_seed(3)
    x = torch.randn(channels, len(PAIRS) + 1, max(PAIRS), generator=generator, dtype=torch.float64)
    mask = torch.arange(max(PAIRS)) < torch.tensor([*PAIRS, 0])[:, None]
    return x * mask, Slots.of(mask, torch.float64)


def assert_pairs_equal(y: Tensor, expected: list[Tensor]) -> None:
    for i, alone in enumerate(expected):
        torch.testing.assert_close(y[:, i, : alone.shape[1]], alone, rtol=1e-9, atol=1e-10)
        assert not y[:, i, alone.shape[1] :].any()
    assert not y[:, len(expected) :].any()


def test_layers_are_those_of_the_definitions() -> None:
    x, slots = features(8)
    alone = [x[:, i, :n] for i, n in enumerate(PAIRS)]
    context = randomized(OANet(channels=8, blocks=8, clusters=5).stages[0].context)
    assert_pairs_equal(context(x, slots), [reference.context(context, pair) for pair in alone])
    annular, near = randomized(layers.AnnularConvolution(8, 3)), layers.nearest(x, slots, 9)
    assert [near[i, :n].tolist() for i, n in enumerate(PAIRS)] == [reference.neighbors(pair, 9) for pair in alone]
    rings = [reference.annular(annular, pair, reference.neighbors(pair, 9)) for pair in alone]
    assert_pairs_equal(annular(x, slots, near), rings)
    graph, logit = randomized(layers.GlobalGraph(8)), x.sum(0)
    graphs = [reference.graph(graph, pair, logit[i, : pair.shape[1]]) for i, pair in enumerate(alone)]
    assert_pairs_equal(graph(x, logit, slots), graphs)
    attended = slots.clean(layers.attention(x, 2 * x, x.sin(), slots, heads=2))
    assert_pairs_equal(attended, [reference.attention(pair, 2 * pair, pair.sin(), 2) for pair in alone])
    index, left = layers.likeliest(logit, slots.mask > 0, 0.5)
    kept = [index[i, left[i]].tolist() for i in range(len(PAIRS) + 1)]
    assert kept == [reference.pruned(logit[i, :n].tolist(), 0.5) for i, n in enumerate((*PAIRS, 0))]


def test_neighbors_are_the_same_a_part_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    x, slots = features(8)
    whole = layers.nearest(x, slots, 6)
    monkeypatch.setattr(layers, "TABLE", 200)
    assert torch.equal(layers.nearest(x, slots, 6), whole)


def test_batch_norm_is_torchs_over_all_matches() -> None:
    x, slots = features(8)
    ours, theirs = layers.BatchNormReLU(8).double(), nn.BatchNorm1d(8).double()
    for _ in range(2):
        expected = torch.relu(theirs(x[:, slots.mask > 0].T)).T
        torch.testing.assert_close(ours(x + 7 * (slots.mask == 0), slots)[:, slots.mask > 0], expected)
    for name in ("running_mean", "running_var"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name))


@pytest.mark.parametrize("name", ["clnet", "ncmnet"])
def test_stages_judge_what_is_left(name: str) -> None:
    """Half, then a quarter of the matches; verification, of all, is not trained on."""
    torch.manual_seed(0)
    prediction = SMALL[name]().eval()(collate([scene(0, count=101), scene(1, count=30)]))
    assert prediction.judged.sum(-1).tolist() == [[101, 30], [101, 30], [50, 15], [50, 15], [25, 7], [0, 0]]
    assert not (prediction.judged[4] & ~prediction.judged[2]).any()
    torch.testing.assert_close(prediction.weight.sum(-1), torch.ones(1, 2))
    assert torch.equal(prediction.weight[0] > 0, prediction.judged[4])
    assert torch.equal(prediction.logit[5, 1, :30], prediction.logit[1, 1, :30])  # seven matches are no fit


@every
def test_a_step_of_training_has_finite_gradients_and_repeats(name: str) -> None:
    """With pairs of 7 to 20 matches, degenerate ones and none, under the whole objective, also in mixed precision."""
    sound = exact(0, 40, pairs=1).correspondences
    few = [exact(n, n).correspondences for n in (7, 8, 13, 20)]
    pairs = (sound, *few, *degenerate().values())
    c = collate([Correspondences(p.x0.float(), p.x1.float(), p.mask, size0=p.size0, size1=p.size1) for p in pairs])
    label = torch.where(c.mask, torch.arange(c.mask.shape[1]) % 2, -1).to(torch.int8)
    batch = LabelledMatches(c, label, exact(0, 40).F.expand(len(c.mask), 3, 3))
    for mixed in (False, True):
        outcomes = []
        for _ in range(2):
            torch.manual_seed(1)
            network = SMALL[name]().train()
            with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
                prediction = network(c)
            loss = Objective()(prediction, batch, 10**6)["loss"]
            trained = [p for p in network.parameters() if p.requires_grad]
            outcomes.append([loss, *torch.autograd.grad(loss, trained, allow_unused=True), *network.buffers()])
        assert all(torch.isfinite(value).all() for value in outcomes[0] if value is not None)
        assert sum(value is None for value in outcomes[0]) == 0
        assert all(torch.equal(a, b) for a, b in zip(*outcomes, strict=True))


def expanded(pattern: str) -> Iterator[str]:
    """``a{b,c}d`` is abd and acd."""
    match = re.search(r"\{([^{}]*)\}", pattern)
    if match is None:
        yield pattern
        return
    for part in match[1].split(","):
        yield from expanded(pattern[: match.start()] + part + pattern[match.end() :])


NORM = "{weight,bias,running_mean,running_var,num_batches_tracked}"
AUTHORS = {
    "oanet": [
        "{weights_init,weights_iter.0}.{conv1,output}.{weight,bias}",
        "{weights_init,weights_iter.0}.l1_{1,2}.{0,1,2}.conv.{3,7}.{weight,bias}",
        "{weights_init,weights_iter.0}.l1_{1,2}.{0,1,2}.conv.{1,5}.N",
        "{weights_init,weights_iter.0}.l1_2.0.shot_cut.{weight,bias}",
        "{weights_init,weights_iter.0}.{down1,up1}.conv.{1.N,3.weight,3.bias}",
        "{weights_init,weights_iter.0}.l2.{0,1,2}.{conv1.3,conv2.2,conv3.4}.{weight,bias}",
        "{weights_init,weights_iter.0}.l2.{0,1,2}.{conv1.1,conv2.0,conv3.2}.N",
    ],
    "clnet": [
        "ds_{0,1}.{conv,gcn.conv}.{0.weight,0.bias,1.N}",
        "ds_{0,1}.embed_{0.{0,1,2,3,5,6,7,8},1.0}.{{right.0,left.0,left.4}.{weight,bias},left.{2,6}.N}",
        "ds_{0,1}.embed_0.4.conv.{0.weight,0.bias,1.N,3.weight,3.bias,4.N}",
        "ds_1.embed_2.{{left.0,left.4,right.0}.{weight,bias},left.{2,6}.N}",
        "{ds_0.linear_{0,1},ds_1.linear_{0,1,2}}.{weight,bias}",
    ],
    "ncmnet": [
        "ds_{0,1}.{conv,gcn1.conv,gcn2.conv,gs.conv}.{0.weight,0.bias,1.N}",
        "ds_{0,1}.sce{1,2,3,11,22,33}.conv.{0.weight,0.bias,1.N,3.weight,3.bias,4.N}",
        "ds_{0,1}.cci{1,2,3,11,22,33}.{{attq,attk,attv,conv}.{0.weight,0.bias,1.N},gamma}",
        "ds_{0,1}.{down1,up1,down2,up2}.conv.{1.N,3.weight,3.bias}",
        "ds_{0,1}.{l1,l2}.{0,1}.{{conv1.3,conv2.2,conv3.4}.{weight,bias},{conv1.1,conv2.0,conv3.2}.N}",
        "{ds_{0,1}.embed_{0{0,1,2}.{0,1,2},1.0},ds_1.embed_2}.{{left.0,left.4,right.0}.{weight,bias},left.{2,6}.N}",
        "{ds_{0,1}.{mlp1,mlp2,linear_0,linear_1},ds_1.linear_2}.{weight,bias}",
    ],
    "convmatch": [
        "{pos_embed.position_encoder,grid_pos_embed.position_encoder,init_project.init_project}.{0,3,6}.{weight,bias}",
        "{pos_embed.position_encoder,grid_pos_embed.position_encoder,init_project.init_project}.{1,4}.N",
        "layer_blocks.{0,1,2,3,4,5}.{align,dealign}.{query,key,value,mh}_filter.{weight,bias}",
        "layer_blocks.{0,1,2,3,4,5}.{align,dealign}.cat_filter.{0.weight,0.bias,1.N,3.weight,3.bias}",
        "layer_blocks.{0,1,2,3,4,5}.filter.filter.resnet.{0,1,2}.net.{0.weight,0.bias,1.N,3.weight,3.bias,4.N}",
        "layer_blocks.{0,1,2,3,4,5}.filter.filter.scale.0.{weight,bias}",
        "layer_blocks.{0,1,2,3,4,5}.inlier_pre.inlier_pre.{0,4,8,12}.{weight,bias}",
        "layer_blocks.{0,1,2,3,4,5}.inlier_pre.inlier_pre.{2,6,10}.N",
    ],
}


def listed(name: str) -> set[str]:
    return {key for pattern in AUTHORS[name] for key in expanded(pattern.replace(".N", f".{NORM}"))}


def written(name: str, network: nn.Module, file: Path, without: str = "") -> None:
    """A checkpoint as the authors' code writes it on several cards: convolutions are 4-D, a figure is NumPy's."""
    values = {authors_key(name, key): value for key, value in network.state_dict().items()}
    state = {key: value[..., None, None] if value.dim() == 2 else value for key, value in values.items()}
    unused = listed(name) - state.keys()
    assert state.keys() <= listed(name)
    assert all(UNUSED.search(key) for key in unused)
    state |= dict.fromkeys(unused, torch.zeros(1))
    state = {f"module.{key}": value for key, value in state.items() if key != without}
    torch.save({"epoch": 3, "state_dict": state, "best_acc": np.float64(0.5), "optimizer": {"state": {}}}, file)


def convert(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["convert_checkpoint.py", *map(str, words)])
    main()


@every
def test_a_checkpoint_of_the_authors_code_becomes_a_pruner(name, tmp_path, monkeypatch) -> None:
    torch.manual_seed(2)
    network, c = NETWORKS[name][0](coordinates="K", side=["ratio"]), calibrated(scene(0))
    written(name, network, tmp_path / "model_best.pth")
    convert(monkeypatch, name, tmp_path / "model_best.pth", tmp_path / "out.safetensors", "--side", "ratio")
    read = LearnedPruner(NETWORKS[name][0](coordinates="K", side=["ratio"]), file=tmp_path / "out.safetensors")
    assert torch.equal(read.probability(c), LearnedPruner(network).probability(c))


def test_what_is_no_such_checkpoint_is_refused_in_a_line(tmp_path, monkeypatch) -> None:
    file, out = tmp_path / "model.pth", tmp_path / "out.safetensors"
    written("clnet", CLNet(coordinates="K"), file, without="ds_0.linear_1.bias")
    with pytest.raises(SystemExit, match=r"^error: no checkpoint of CLNet\(.*\): ds_0\.linear_1\.bias is missing"):
        convert(monkeypatch, "clnet", file, out)
    written("clnet", CLNet(coordinates="K"), file)
    with pytest.raises(SystemExit, match=r"ds_0\.conv\.0\.weight has 512 numbers, not 640"):
        convert(monkeypatch, "clnet", file, out, "--side", "ratio")
    written("oanet", OANet(coordinates="K"), file)
    with pytest.raises(SystemExit, match=r"^error: no checkpoint of ConvMatch\(.*is missing"):
        convert(monkeypatch, "convmatch", file, out)
    file.write_bytes(pickle.dumps(Path("x")))
    with pytest.raises(SystemExit, match=r"model\.pth holds no tensors"):
        convert(monkeypatch, "oanet", file, out)
    assert not out.exists()
