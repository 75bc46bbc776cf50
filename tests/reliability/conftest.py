"""What the trials share: the process that starts commands, a data set, the runs that nothing disturbs."""

from pathlib import Path

import pytest

from tests import processes
from tests.helpers import draw_set
from tests.processes import Starter
from tests.reliability.commands import evaluation, results

Rows = list[dict[str, object]]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The whole runs on demand only: ``-m reliability``."""
    for item in items:
        chosen = item.config.getoption("markexpr", "")
        if item.get_closest_marker("reliability") and "reliability" not in chosen:
            item.add_marker(pytest.mark.skip(reason="a whole trial: -m reliability"))


@pytest.fixture(scope="package")
def starter() -> Starter:
    """Starts commands."""
    return processes.starter()


@pytest.fixture(scope="package")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of nine pairs."""
    return draw_set(tmp_path_factory.mktemp("data") / "Set", ["scene0"], images=10)


@pytest.fixture(scope="package")
def truth(starter: Starter, root: Path, tmp_path_factory: pytest.TempPathFactory) -> Rows:
    """The rows of an evaluation that nothing disturbs."""
    folder = tmp_path_factory.mktemp("undisturbed")
    done = starter.run(folder, "eval", *evaluation(root, folder / "run"))
    assert done.status == 0, done.said()
    return results(folder / "run")
