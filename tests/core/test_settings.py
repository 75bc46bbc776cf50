"""Folders that are of one settings alone."""

import json
import threading
from pathlib import Path

import pytest

from fmtorch.core.settings import claim, create


def claimed(folder: Path, settings: dict[str, object], alone: bool = True) -> None:
    claim(folder / "settings.json", settings, "sketches", "choose another output", alone)


def test_a_folder_is_made_and_found_again(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    for _ in range(2):
        claimed(folder, {"seed": 0, "network": {"blocks": 2}})
    (folder / "sketch").write_text("done")
    claimed(folder, {"network": {"blocks": 2}, "seed": 0})
    assert json.loads((folder / "settings.json").read_text()) == {"seed": 0, "network": {"blocks": 2}}


def test_other_settings_are_refused(tmp_path: Path) -> None:
    claimed(tmp_path, {"seed": 0, "network": {"blocks": 2, "size": 3}})
    message = r"holds sketches of other .*: network\.blocks: 2 -> 4; network\.size: 3 -> \(absent\)\. Choose an"
    with pytest.raises(ValueError, match=message):
        claimed(tmp_path, {"seed": 0, "network": {"blocks": 4}})


def test_anything_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"no settings\.json, so it holds no sketches \(it holds notes\.txt\); choose"):
        claimed(tmp_path, {})
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    claimed(tmp_path, {}, alone=False)
    (tmp_path / "settings.json").write_text("{")
    with pytest.raises(ValueError, match=r"settings\.json is not valid JSON"):
        claimed(tmp_path, {})
    with pytest.raises(ValueError, match=r"notes\.txt is a file; choose another output"):
        claimed(tmp_path / "notes.txt", {})


def test_what_a_killed_writer_left_is_nothing(tmp_path: Path) -> None:
    (tmp_path / "settings.json.0123.tmp").write_text("{")
    claimed(tmp_path, {"seed": 0})


def test_of_several_writers_the_first_wins(tmp_path: Path) -> None:
    threads = [threading.Thread(target=create, args=(tmp_path / "file", str(i) * 10_000)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (file,) = tmp_path.iterdir()
    assert len(set(file.read_text())) == 1
