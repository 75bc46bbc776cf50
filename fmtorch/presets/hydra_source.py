"""Presets of pruners need no `# @package` line: several are chosen at once, and each goes under its own name.

Hydra puts a file of the group `pruner` at ``config.pruner``, where a second one would mix with it; the project's own
presets therefore begin with ``# @package pruner.<name>``. A file without the line, or with one that names the group
alone, is read as if it had it.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from hydra._internal.core_plugins import file_config_source
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult

from fmtorch.presets.files import naming_file

SEVERAL = ("pruner",)  # groups of which several presets are chosen at once


class FileConfigSource(file_config_source.FileConfigSource):
    """Hydra's reader of config folders, which gives presets of such groups the package of their name.

    It has the name of the reader that it replaces: a launcher's processes register Hydra's own once more, which Hydra
    skips where one of the same name is there and refuses where it is of another.
    """

    def load_config(self, config_path: str) -> ConfigResult:
        """A file and its header."""
        with naming_file(Path(self.path) / self._normalize_file_name(config_path)):
            result = super().load_config(config_path)
        path = PurePosixPath(config_path)
        group = str(path.parent)
        if group in SEVERAL and result.header.get("package") in (None, "_group_", group):
            result.header["package"] = f"{group}.{path.name.removesuffix('.yaml')}"
        return result


def register() -> None:
    """Have Hydra read folders by this reader; once is enough for a process."""
    Plugins.instance()  # registers Hydra's own readers, of which this replaces one
    SourcesRegistry.instance().types[FileConfigSource.scheme()] = FileConfigSource
