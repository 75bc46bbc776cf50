"""What the trials share: commands on a small data set, the process that starts them, the run that nothing disturbs."""

from pathlib import Path

import pytest

from fmtorch.runs import RunFolder
from tests import processes
from tests.helpers import draw_set
from tests.processes import Starter

Rows = list[dict[str, object]]
EVAL = ["features.max_features=400", "estimator=lmeds", "estimator.hypotheses=200", "batch=1", "workers=1"]


def evaluation(root: Path, run_dir: Path, *extra: str) -> list[str]:
    return ["dataset=fmbench", f"dataset.root={root}", *EVAL, f"output={run_dir}", *extra]


def results(run_dir: Path) -> Rows:
    """The rows of a run, in the order of pairs, without what depends on the time."""
    rows = RunFolder.load(run_dir).read().to_pylist()
    kept = [{k: v for k, v in row.items() if not k.startswith("seconds")} for row in rows]
    return sorted(kept, key=lambda row: str(row["pair"]))


def parts(run_dir: Path) -> int:
    return len(list((run_dir / "pairs").glob("part-*.parquet")))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The whole runs on demand only: ``-m reliability``."""
    for item in items:
        chosen = item.config.getoption("markexpr", "")
        if item.get_closest_marker("reliability") and "reliability" not in chosen:
            item.add_marker(pytest.mark.skip(reason="a whole trial: -m reliability"))


@pytest.fixture(scope="package")
def starter() -> Starter:
    return processes.starter()


@pytest.fixture(scope="package")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_set(tmp_path_factory.mktemp("data") / "Set", ["scene0"], images=10)


@pytest.fixture(scope="package")
def truth(starter: Starter, root: Path, tmp_path_factory: pytest.TempPathFactory) -> Rows:
    folder = tmp_path_factory.mktemp("undisturbed")
    done = starter.run(folder, "eval", *evaluation(root, folder / "run"))
    assert done.status == 0, done.said()
    return results(folder / "run")
