"""Learned pruners: files, runtimes, what they do to matches; padding and neighbours are invisible to the bit."""

import pickle
from collections.abc import Callable
from pathlib import Path

import onnx
import pytest
import torch
from torch import Tensor, nn

from fmtorch.core import Correspondences, NetworkFileError, collate
from fmtorch.pruning import DFE, LC, LearnedPruner
from fmtorch.pruning.networks import ConvMatch, learned_file
from fmtorch.runs import configuration
from fmtorch.runs.fingerprint import learned
from fmtorch.training import export_onnx, save_weights
from tests.laws import calibrated, scene

SIDE = ["ratio", "mutual", "scale", "rotation", "agreement"]
VARIANTS: dict[str, Callable[[], nn.Module]] = {
    "lc": lambda: LC(channels=16, blocks=2, coordinates="K", side=SIDE),
    "dfe": lambda: DFE(widths=(16, 32), iterations=2, side=SIDE),
    "convmatch": lambda: ConvMatch(channels=16, layers=1, grid=4, side=SIDE),
}


def small(variant: str = "lc", seed: int = 0) -> nn.Module:
    """An untrained network whose running statistics are not those of the start."""
    torch.manual_seed(seed)
    network = VARIANTS[variant]()
    for name, buffer in network.named_buffers():
        buffer.copy_(torch.rand_like(buffer) + (0.5 if name.endswith("var") else 0))
    return network


def pairs_of_several_lengths() -> list[Correspondences]:
    """Pairs of several lengths, among them less than a minimal sample and none."""
    return [calibrated(scene(i, count=n)) for i, n in enumerate((150, 3, 40, 1, 0, 97))]


class Ratio(nn.Module):
    def forward(self, c: Correspondences) -> Tensor:
        return 4 - 8 * c.ratio


@pytest.fixture(scope="module", params=VARIANTS)
def files(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[nn.Module, Path]:
    """A network and where its files are, without suffix."""
    path = tmp_path_factory.mktemp("learned") / request.param
    network = small(request.param)
    save_weights(network, path.with_suffix(".safetensors"), temperature=2.5, notes={"seed": "0"})
    export_onnx(network, path.with_suffix(".onnx"), temperature=2.5)
    return network, path


@pytest.mark.parametrize("runtime", ["torch", "onnx"])
def test_files_give_the_networks_probabilities(files: tuple[nn.Module, Path], runtime: str) -> None:
    network, path = files
    other = small(path.name, seed=1)  # whose weights the file replaces
    for c in pairs_of_several_lengths():
        probability = LearnedPruner(other, file=path, runtime=runtime).probability(c)
        if not probability.numel():
            continue
        with torch.no_grad():
            expected = torch.sigmoid(network.eval()(c).logit[-1] / 2.5)
        torch.testing.assert_close(probability, expected, rtol=0, atol=1e-4 / 4)  # 1e-4 in log-odds


@pytest.mark.parametrize("runtime", ["torch", "onnx"])
def test_padding_and_neighbours_are_invisible(files: tuple[nn.Module, Path], runtime: str) -> None:
    network, path = files
    pruner = LearnedPruner(network, file=path, runtime=runtime)
    alone = [pruner.probability(c) for c in pairs_of_several_lengths()]
    batch = collate(pairs_of_several_lengths())
    nan = {"x0": torch.where(batch.mask[..., None], batch.x0, torch.nan),
           "ratio": torch.where(batch.mask, batch.ratio, torch.nan)}  # fmt: skip
    for c, order in ((batch, range(6)), (batch[[5, 2, 0]], (5, 2, 0)), (batch.replace(**nan), range(6))):
        together = pruner.probability(c)
        for row, i in enumerate(order):
            n = alone[i].shape[1]
            assert torch.equal(together[row, :n], alone[i][0])
            assert not together[row, n:].any()
    spread = torch.arange(150) % 3 != 0  # the same matches with holes between them
    c = pairs_of_several_lengths()[0]
    held = pruner.probability(c.keep(spread[None]))[0, spread]
    assert torch.equal(held, pruner.probability(c.keep(spread[None]).compact())[0])


def test_prior_and_threshold() -> None:
    c = scene(0)
    p = torch.sigmoid(4 - 8 * c.ratio)
    soft = LearnedPruner(Ratio())(c)
    torch.testing.assert_close(soft.prior, p)
    assert torch.equal(soft.mask, c.mask)
    hard = LearnedPruner(Ratio(), threshold=0.5, prior=False)(c)
    assert hard.prior is c.prior
    assert torch.equal(hard.mask, p >= 0.5)
    both = LearnedPruner(Ratio(), threshold=0.5)(c)
    assert torch.equal(both.mask, hard.mask)
    assert both.prior is not None
    cold = LearnedPruner(Ratio(), temperature=2.0).probability(c)
    torch.testing.assert_close(cold, torch.sigmoid((4 - 8 * c.ratio) / 2))


def test_a_match_that_is_not_finite_has_no_chance() -> None:
    c = calibrated(scene(0))
    x1 = c.x1.clone()
    x1[0, 3, 1] = torch.inf
    p = LearnedPruner(small()).probability(c.replace(x1=x1))
    assert p[0, 3] == 0
    without = torch.ones_like(c.mask)
    without[0, 3] = False
    assert torch.equal(p, LearnedPruner(small()).probability(c.keep(without)))


def test_temperature_of_the_option_comes_before_the_files(files: tuple[nn.Module, Path]) -> None:
    network, path = files
    c = pairs_of_several_lengths()[0]
    stated, own = (LearnedPruner(network, file=path, temperature=t).probability(c) for t in (None, 1.0))
    torch.testing.assert_close(torch.logit(own), torch.logit(stated) * 2.5, rtol=1e-3, atol=1e-4)


def test_auto_takes_onnx_where_there_is_one(files: tuple[nn.Module, Path], tmp_path: Path) -> None:
    network, path = files
    c = pairs_of_several_lengths()[0]
    auto, onnx_only = (LearnedPruner(network, file=path, runtime=r).probability(c) for r in ("auto", "onnx"))
    assert torch.equal(auto, onnx_only)
    (tmp_path / "lc.safetensors").write_bytes(path.with_suffix(".safetensors").read_bytes())
    files = ((tmp_path / "lc", "auto"), (path.with_suffix(".safetensors"), "torch"))
    lone, torch_only = (LearnedPruner(network, file=f, runtime=r).probability(c) for f, r in files)
    assert torch.equal(lone, torch_only)


@pytest.mark.parametrize("runtime", ["torch", "onnx", "auto"])
def test_a_missing_file_says_what_makes_it(tmp_path: Path, runtime: str) -> None:
    pruner = LearnedPruner(small(), file=tmp_path / "absent", runtime=runtime, command="make it")
    for use in (lambda: pruner(scene(0)), lambda: pruner.identity):
        with pytest.raises(NetworkFileError, match=r"absent\.\w+ does not exist: make it"):
            use()


def test_a_file_of_another_network_or_of_none(files: tuple[nn.Module, Path], tmp_path: Path) -> None:
    _, path = files
    wide = LC(channels=32, blocks=2)
    for runtime in ("torch", "onnx"):
        with pytest.raises(NetworkFileError, match=r"holds .*\[?(16|3).*names .*'channels': 32"):
            LearnedPruner(wide, file=path, runtime=runtime)(scene(0))
        broken = learned_file(tmp_path / "broken", runtime)
        broken.write_bytes(b"not a network")
        with pytest.raises(NetworkFileError, match=rf"{broken.name}"):
            LearnedPruner(wide, file=broken)(scene(0))
    model = onnx.load(path.with_suffix(".onnx"))
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "silent.onnx")
    with pytest.raises(NetworkFileError, match="does not state its network"):
        LearnedPruner(small(), file=tmp_path / "silent.onnx")(scene(0))
    model.graph.input[0].name = "x"
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(NetworkFileError, match=r"other\.onnx"):
        LearnedPruner(small(), file=tmp_path / "other.onnx")(scene(0))


def test_a_checkpoint_is_no_safetensors_and_is_not_executed(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, ...]:
            return exec, ("raise SystemExit('executed')",)

    (tmp_path / "evil.safetensors").write_bytes(pickle.dumps(Evil()))
    with pytest.raises(NetworkFileError, match="no safetensors file"):
        LearnedPruner(small(), file=tmp_path / "evil.safetensors")(scene(0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"runtime": "tensorrt"}, "runtime=tensorrt; there are: auto, torch, onnx"),
        ({"prior": False}, "would do nothing"),
        ({"threshold": 2.0}, "threshold=2.0"),
        ({"temperature": 0.0}, "temperature=0.0"),
        ({"runtime": "torch", "file": "a.onnx"}, r"runtime=torch reads \.safetensors, not a\.onnx"),
        ({"runtime": "onnx"}, "needs a `file`"),
    ],
)
def test_options(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LearnedPruner(small(), **options)  # type: ignore[arg-type]


def test_a_users_network_runs_with_torch_alone() -> None:
    with pytest.raises(ValueError, match="Ratio is not `Exportable`"):
        LearnedPruner(Ratio(), file="a.onnx")
    with pytest.raises(ValueError, match="Ratio has no `backbone`"):
        export_onnx(Ratio(), Path("a.onnx"))

    class Wrong(nn.Module):
        def forward(self, c: Correspondences) -> Tensor:
            return torch.zeros(3)

    with pytest.raises(ValueError, match=r"Wrong returns log-odds of shape \(3,\) for matches of shape \(1, 150\)"):
        LearnedPruner(Wrong())(scene(0))


def test_identity_is_the_file_and_the_options(files: tuple[nn.Module, Path], tmp_path: Path) -> None:
    network, path = files
    pruner = LearnedPruner(network, file=path)
    assert configuration(pruner) == configuration(LearnedPruner(small(path.name, seed=5), file=path))
    assert configuration(pruner) != configuration(LearnedPruner(network, file=path, threshold=0.5))
    assert len(learned(pruner)) == 2  # both files
    other = LC(channels=16, blocks=2, coordinates="K", side=["rotation"])
    assert configuration(pruner) != configuration(LearnedPruner(other, file=path))
    for suffix in (".onnx", ".safetensors"):
        (tmp_path / path.name).with_suffix(suffix).write_bytes(path.with_suffix(suffix).read_bytes() + b" ")
    assert configuration(pruner) != configuration(LearnedPruner(network, file=tmp_path / path.name))
    assert configuration(LearnedPruner(small(seed=0))) != configuration(LearnedPruner(small(seed=1)))
