"""Fetches networks published by their authors, verified where their SHA-256 is known.

python scripts/download.py                                        lists what there is
python scripts/download.py weights=affnet                         -> weights/AffNet.pth
python scripts/download.py weights=hardnet++ sha256=HEX           for a file whose SHA-256 is not pinned here
python scripts/download.py weights=hardnet++ sha256=any           accepts what comes, and prints its SHA-256

L2-Net's authors publish MATLAB files only and no stable address of a port is known; a port that you have is converted
by scripts/export_onnx.py architecture=l2net.

Then: python scripts/export_onnx.py checkpoint=weights/AffNet.pth architecture=affnet licence=MIT
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import re
import tempfile
import urllib.error
import urllib.request
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from fmtorch.terminal import console, exits_with_message

DEFAULTS = {"weights": None, "sha256": None, "folder": "weights", "url": None, "timeout": 60}
AFFNET = "https://raw.githubusercontent.com/ducha-aiki/affnet/da7cf51ba09cb92e3cf0f46c12a89881f79e5051"
HARDNET = "https://github.com/DagnyT/hardnet/raw/master/pretrained"


@dataclasses.dataclass(frozen=True)
class Weights:
    """A published file: where it is, for which architecture, under which licence; sha256 is None where not known."""

    url: str
    architecture: str
    licence: str
    sha256: str | None = None

    @property
    def file(self) -> str:
        return self.url.rsplit("/", 1)[-1]


TABLE = {
    "affnet": Weights(
        f"{AFFNET}/pretrained/AffNet.pth", "affnet", "MIT",
        "65c8bb2cf71e913818522d09dcc4262bcbcef5d756baa86a41f28526c2d61160",
    ),
    "orinet": Weights(
        f"{AFFNET}/pretrained/OriNet.pth", "orinet", "MIT",
        "030e7964ae3e136d00431c7e11c6b67df40ad299f02ac384fee0f1c3fd1dcb30",
    ),
    "affnet_jit": Weights(
        f"{AFFNET}/convertJIT/AffNetJIT.pt", "affnet", "MIT",
        "ab06ef8747ed1871415d34dc65308314f3b56521b3c6ff6a03005c996e9c32c7",
    ),
    "orinet_jit": Weights(
        f"{AFFNET}/convertJIT/OriNetJIT.pt", "orinet", "MIT",
        "984077b99385bf25083cafeff30be7a0f7fa2334d73015fbbea42b92b888a75a",
    ),
    "hardnet++": Weights(f"{HARDNET}/pretrained_all_datasets/HardNet++.pth", "hardnet", "MIT"),
    "hardnet_liberty": Weights(f"{HARDNET}/train_liberty_with_aug/checkpoint_liberty_with_aug.pth", "hardnet", "MIT"),
}  # fmt: skip


def download(url: str, path: Path, sha256: str | None, timeout: float = 60) -> str:
    """Fetch `url` into `path`, which appears only when the file is complete and verified; returns its SHA-256.

    sha256: what it must be; None accepts what comes. Raises ConnectionError where the file cannot be fetched,
    ValueError where it is another one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, unfinished = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".tmp")
    try:
        digest = hashlib.sha256()
        with os.fdopen(handle, "wb") as file, urllib.request.urlopen(url, timeout=timeout) as response:
            while part := response.read(1 << 20):
                digest.update(part)
                file.write(part)
            expected = response.headers.get("Content-Length")
            if expected is not None and file.tell() != int(expected):
                raise ConnectionError(f"{url} broke off after {file.tell()} of {expected} bytes")
        found = digest.hexdigest()
        if sha256 is not None and found != sha256.lower():
            raise ValueError(f"{url} has SHA-256 {found}, not {sha256}: it was not kept")
        os.replace(unfinished, path)
    except urllib.error.URLError as error:
        raise ConnectionError(
            f"{url} cannot be fetched ({error.reason}). Fetch it elsewhere and give the file to scripts/export_onnx.py"
        ) from error
    finally:
        Path(unfinished).unlink(missing_ok=True)
    return found


def fetch(config: DictConfig) -> Path:
    """The file that a config asks for."""
    if config.weights not in TABLE:
        raise ValueError(f"weights={config.weights}; there are: {', '.join(TABLE)}")
    entry = TABLE[config.weights]
    expected = config.sha256 or entry.sha256
    if expected is None:
        raise ValueError(
            f"the SHA-256 of {entry.file} is not pinned: give sha256=HEX as its publisher states it, "
            "or sha256=any to accept what comes"
        )
    if expected != "any" and not re.fullmatch(r"[0-9a-fA-F]{64}", expected):
        raise ValueError(f"sha256={expected} is no SHA-256: 64 hexadecimal digits, or any")
    path = Path(config.folder) / entry.file
    found = download(config.url or entry.url, path, None if expected == "any" else expected, config.timeout)
    state = "not verified" if expected == "any" else "verified"
    console.print(f"{path}  SHA-256 {found} ({state})  licence: {entry.licence}  architecture={entry.architecture}")
    return path


def main() -> None:
    with exits_with_message():
        config = OmegaConf.merge(OmegaConf.create(DEFAULTS), OmegaConf.from_cli())
        assert isinstance(config, DictConfig)
        if config.weights is None:
            table = Table("weights", "architecture", "licence", "SHA-256", "URL")
            for name, entry in TABLE.items():
                table.add_row(name, entry.architecture, entry.licence, entry.sha256 or "not known", entry.url)
            console.print(table)
        else:
            fetch(config)


if __name__ == "__main__":
    main()
