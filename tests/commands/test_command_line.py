"""The doors of the commands: one name each in `python -m`, in the console script and in Python."""

import importlib
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import fmtorch.__main__
from fmtorch.commands import COMMANDS, hydra_arguments
from fmtorch.core import exits_with_message, terminal
from fmtorch.presets import available
from tests.conftest import own_cache
from tests.helpers import draw, draw_set

CHECKOUT = Path(__file__).resolve().parents[2]
COUNT = "it must be a whole number of at least 1"
SMALL = ["dataset=fmbench", "dataset.root=Set", "features.max_features=300", "estimator.hypotheses=100"]


def python(code: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_help_lists_the_commands_without_torch() -> None:
    python(
        "import sys, io, contextlib\n"
        "from fmtorch.__main__ import main\n"
        "sys.argv = ['fmtorch', '--help']\n"
        "with contextlib.redirect_stdout(io.StringIO()) as page: main()\n"
        "names = ('eval', 'list', 'match', 'pairs', 'report', 'train', 'verify', 'warm-up')\n"
        "assert all(f'  {name} ' in page.getvalue() for name in names)\n"
        "with contextlib.redirect_stdout(io.StringIO()) as page: main(['eval', '--help'])\n"
        "assert '  limit=null ' in page.getvalue()\n"
        "libraries = {'torch', 'hydra', 'numpy', 'cv2', 'pyarrow', 'rich', 'yaml'} & set(sys.modules)\n"
        "assert not libraries, libraries"
    )


def test_a_subcommand_runs_as_its_module_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of a user's own are found in the working folder, wherever the script lies."""
    called = []
    monkeypatch.setattr("fmtorch.commands.eval.main", lambda: called.append((sys.argv, sys.path[0])))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["/usr/bin", *sys.path])
    monkeypatch.setattr(sys, "argv", ["/usr/bin/fmtorch", "eval", "-m", "seed=1,2"])
    fmtorch.__main__.main()
    assert called == [(["/usr/bin/fmtorch", "-m", "seed=1,2"], str(tmp_path))]
    monkeypatch.setattr(sys, "argv", ["fmtorch", "evaluate"])
    with pytest.raises(SystemExit, match="error: no command 'evaluate'; there are: eval, "):
        fmtorch.__main__.main()


def test_public_names_are_imported_when_they_are_used() -> None:
    python(
        "import inspect, fmtorch\n"
        "assert inspect.isfunction(fmtorch.match) and inspect.isfunction(fmtorch.verify)\n"
        "from fmtorch import match\n"
        "assert match is fmtorch.match\n"
        "assert fmtorch.Pipeline.__module__ == 'fmtorch.pipeline.pipeline'\n"
        "assert set(fmtorch.__all__) <= set(dir(fmtorch)) and fmtorch.geometry.sampson\n"
        "assert not hasattr(fmtorch, 'nothing')\n"
    )


def ended(monkeypatch: pytest.MonkeyPatch, folder: Path, command: str, *words: str) -> str:
    """What a command ends with that is run in a folder, in this process."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("FMTORCH_CACHE", str(own_cache(folder)))
    monkeypatch.setattr(sys, "argv", [command, *words])
    with pytest.raises(SystemExit) as end:
        importlib.import_module(f"fmtorch.commands.{command}").main()
    return str(end.value.code)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("eval executor=mpi", "no preset 'mpi' in executor; there are: "),
        ("eval executor=dask processes=true", "processes=true and executor=dask differ; give one of them"),
        ("eval shard=0/2", "shard=0/2; it must be i/n with i from 1 to n: shard=2/8"),
        ("eval processes=maybe", "processes=maybe; it must be true or false or null"),
        ("eval device=gpu", "device=gpu; it must be text that names a device: auto, cpu, cuda, cuda:1 or mps"),
        ("eval estimator=cf_ransac estimator.fine.hypotheses=many", "estimator.fine.hypotheses=many; it must be"),
        ("eval +estimator.treshold=2", "estimator: no option treshold; there are: threshold"),
        ("eval +dataset.sise=full", "dataset: no option sise; there are: size"),
        ("eval estimator._target_=fmtorch.estimators.Magic", "estimator: _target_=fmtorch.estimators.Magic cannot be"),
        ("eval pipeline=sift_magic", "no preset 'sift_magic' in pipeline; there are: sift_"),
        ("eval estimator=[]", "estimator=[]; it must be one preset, such as ransac"),
        ("eval features=null", "features=null; it must be one preset, such as sift"),
        ("eval pruner.threshold=2", "no option pruner.threshold; there are: ratio.threshold, ratio"),
        ("eval pruner=[ratio,gmss]", "no preset 'gmss' in pruner; there are: gms"),
        ("eval estimator.treshold=2", "no option estimator.treshold; there are: threshold"),
        ("eval limitt=2", "no option limitt; there are: limit"),
        ("eval --limit 5", "--limit: options have no dashes: limit=5"),
        ("eval -s 5", "-s: options have no dashes: s=5"),
        ("eval --config-name x", "--config-name: each command has its own config"),
        ("match a.png b.png --longest-side", "--longest-side: options have no dashes: longest_side=VALUE"),
        ("match .", ". is a folder; fmtorch match images=. matches its images with one another"),
        ("eval --config-dir nowhere", "nowhere' not found"),
        ("eval limit=(1", "limit=(1 cannot be read; a value with special characters stands in quotes"),
        ("eval estimator=ransac,lmeds", "estimator=ransac,lmeds: to run with each of several values, add -m"),
        ("eval sift_gms", "sift_gms is not of the form NAME=VALUE"),
        ("match a.png", "image1 is missing; give two image files: fmtorch match a.jpg b.jpg"),
        ("match a.png b.png output=", "output is empty; give a path, or leave it out"),
        ("match a.png b.png c.png", "c.png: only image0, image1 may stand without NAME="),
        ("match /dev/zero /dev/zero", "/dev/zero: no regular file; it must be an image file"),  # nor read for ever
        ("report nowhere", "nowhere holds no run"),
        ("verify", "database is missing; give the database of a COLMAP project: fmtorch verify database.db"),
        ("verify no.db", "there is no file no.db; give the database of a COLMAP project"),
        ("verify no.db more.db", "more.db: only database may stand without NAME="),
        ("train pruner=lc trainer.devices={}", "trainer.devices={}; it must be"),
    ],
)
def test_a_mistake_is_reported_in_one_line_and_nothing_written(words, message, tmp_path, monkeypatch, capfd):
    if words.startswith("train"):
        pytest.importorskip("lightning", reason="training needs the extra `train`")
    line = ended(monkeypatch, tmp_path, *words.split())
    assert line.startswith("error: ")
    assert message in line
    assert len(line) < 300
    assert "\n" not in line
    assert [path.name for path in tmp_path.rglob("*")] == ["cache", "kernels"]  # put there by `own_cache`
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("names", [("a photo (1).png", "b=2,[x].png"), ("it's {a}.png", "c#d%.png"), ("null.png", "3")])
@pytest.mark.parametrize("form", ["image0={} image1={}", "{} {}"])
def test_any_file_name_is_a_photograph(names, form, tmp_path, monkeypatch):
    """Both are read: the command ends at the second, which is no image, and names it."""
    draw(tmp_path / "a.png", seed=0, shift=0)
    (tmp_path / "a.png").rename(tmp_path / names[0])
    (tmp_path / names[1]).write_text("no image")
    line = ended(monkeypatch, tmp_path, "match", *(f.format(n) for f, n in zip(form.split(), names, strict=True)))
    assert line.startswith(f"error: {names[1]}: ")


@pytest.mark.parametrize("name", ["My set (2024), part [1]", "a=b"])
def test_any_folder_name_is_a_data_set(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / name).mkdir()
    line = ended(monkeypatch, tmp_path, "eval", "dataset=fmbench", f"dataset.root={name}")
    assert line.startswith(f"error: {tmp_path / name}: neither pairs_with_gt.txt")


def test_flags_and_sweeps_stay_what_they_are() -> None:
    paths, positional = ["image0", "output"], ["image0", "image1"]
    words = ["a b.png", "seed=1,2", "-m", "--config-dir", "my conf", "it's.png", "~cache", "output=null", "x=[1, 2]"]
    assert hydra_arguments(words, paths, positional) == [
        "-m", "--config-dir", "my conf", "image0='a b.png'", r"image1='it\'s.png'", "seed=1,2", "~cache",
        "output=null", "x=[1, 2]",
    ]  # fmt: skip
    assert hydra_arguments(["-m", "output=a,b"], paths, []) == ["-m", "output=a,b"]
    assert hydra_arguments(["output=a,b"], paths, []) == ["output='a,b'"]
    assert hydra_arguments(["output='a,b'", "++cache=1"], paths, []) == ["output='a,b'", "++cache=1"]
    assert hydra_arguments(["runs/a (1)", "b"], [], ["runs..."]) == ["runs=['runs/a (1)','b']"]


def test_an_interrupted_command_says_what_is_kept_and_a_warning_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    with exits_with_message():
        warnings.warn("nothing is cached", stacklevel=1)
    with pytest.raises(SystemExit) as end, exits_with_message("interrupted; the same command continues"):
        raise KeyboardInterrupt("3 of 8 pairs are kept in runs/a")
    assert end.value.code == 130
    lines = ["warning: nothing is cached", "interrupted; the same command continues; 3 of 8 pairs are kept in runs/a"]
    assert capsys.readouterr().err.splitlines() == lines


def test_without_a_terminal_progress_is_a_line_now_and_then(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "LINE_SECONDS", 0.0)
    with terminal.progress_bars() as progress:
        bar = progress.add_task("sift_gms", total=1200)
        progress.update(bar, completed=1100)
        progress.advance(bar, 4)
    lines = {f"sift_gms: {done} of 1,200 after 0 min" for done in ("1,100", "1,104")}
    assert lines <= set(capsys.readouterr().err.splitlines())


@pytest.fixture
def data_set(tmp_path: Path) -> Path:
    return draw_set(tmp_path / "Set", images=3).parent


def test_a_sweep_runs_all_jobs_and_tells_the_first_mistake(data_set, monkeypatch, capfd):
    words = ["-m", *SMALL, "limit=0,1", "output=out"]
    assert ended(monkeypatch, data_set, "eval", *words) == f"error: limit=0; {COUNT} or null"
    assert (data_set / "out" / "summary.md").is_file()
    assert "Traceback" not in capfd.readouterr().err
    monkeypatch.setattr(sys, "argv", ["eval", *SMALL[:2]])  # two pairs, of which the sweep has one
    importlib.import_module("fmtorch.commands.eval").main()
    pipelines = ["sift_ratio", "paper/sift_ratio"]
    monkeypatch.setattr(sys, "argv", ["eval", "-m", *SMALL[:2], "limit=1", f"pipeline={','.join(pipelines)}"])
    importlib.import_module("fmtorch.commands.eval").main()
    words = [line.split() for line in capfd.readouterr().out.partition("2 runs on ")[2].splitlines()]
    assert [row[:2] for row in words if row and row[0] in pipelines][:2] == [[name, "1"] for name in pipelines]
    folders = sorted(path.parent.name.rpartition("-")[0] for path in data_set.glob("runs/*/*/run.json"))
    assert folders == ["paper-sift_ratio", "sift_ratio"]


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_a_sweep_runs_in_processes_of_a_launcher(launcher, data_set, monkeypatch, capfd):
    """Two jobs in processes of their own; one is a user's mistake, which this one tells."""
    plugin = {"joblib": "hydra_joblib_launcher", "submitit_local": "hydra_submitit_launcher"}[launcher]
    pytest.importorskip(f"hydra_plugins.{plugin}", reason=f"needs {plugin}")
    monkeypatch.setenv("PYTHONPATH", str(CHECKOUT))
    jobs = ["hydra.launcher.n_jobs=2"] if launcher == "joblib" else []
    words = ["-m", *SMALL, f"hydra/launcher={launcher}", *jobs, "limit=1,0", "output=out"]
    assert ended(monkeypatch, data_set, "eval", *words) == f"error: limit=0; {COUNT} or null", capfd.readouterr().err
    assert (data_set / "out" / "summary.md").is_file()
    printed = capfd.readouterr()
    assert "Traceback" not in printed.err
    if launcher == "submitit_local":  # whose jobs print into files
        assert ".submitit/JOB/JOB_0_log.out" in printed.out
        logs = list((data_set / "runs" / ".submitit").glob("*/*_log.out"))
        assert any("summary.md" in log.read_text(encoding="utf-8") for log in logs)


@pytest.mark.parametrize("command", ["eval", "match", "pairs", "report", "train", "verify"])
def test_help_is_ours_and_fits_a_page(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A command's own options with a line each come first; Hydra's page is at --hydra-help."""
    fmtorch.__main__.main([command, "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"usage: fmtorch {command}")
    assert len(lines) < 60
    listed = {line.split("=")[0].strip().removesuffix(".NAME") for line in lines if "=" in line}
    assert listed >= set(COMMANDS[command].names)
    if command == "match":
        runs = [line.strip() for line in lines if line.strip().startswith(("features=", "pruner="))]
        assert runs == ["features=hesaffnet_fast", "pruner=[ratio, one_to_one, frame_consistency]"]
    fmtorch.__main__.main([command, "--version"])
    assert capsys.readouterr().out.strip() == fmtorch.__version__


def test_warm_up_compiles_what_is_registered(tmp_path, monkeypatch, capsys):
    compiled: list[str] = []
    compile_together = "fmtorch.commands.warm_up.compile_together"
    monkeypatch.setattr(compile_together, lambda kernels: compiled.extend(kernel.__module__ for kernel in kernels))
    fmtorch.__main__.main(["warm-up"])
    assert f"{len(compiled)} kernels for " in capsys.readouterr().out
    rooms = {name.split(".")[1] for name in compiled}
    assert {"estimators", "geometry", "pruning", "scenes"} <= rooms
    monkeypatch.setenv("FMTORCH_KERNELS", "off")
    with pytest.raises(SystemExit, match="kernels are switched off"):
        fmtorch.__main__.main(["warm-up"])


def test_list_names_every_preset_with_what_it_is(monkeypatch, capsys):
    fmtorch.__main__.main(["list", "estimator", "pruner"])
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]
    names = [line.split()[0] for line in lines if not line.endswith("as in FM-Bench's paper:")]
    assert names == [*available("estimator"), *available("pruner")]
    assert all(len(line.split()) > 2 for line in lines)
    with pytest.raises(SystemExit, match="error: no group 'estimators'; there are: estimator"):
        fmtorch.__main__.main(["list", "estimators"])
