"""Fetches networks and data sets published by their authors, verified where their SHA-256 is known.

python scripts/download.py                                        lists what there is
python scripts/download.py dataset=tum folder=TUM                 the paper's test sequences, unpacked; can be continued
python scripts/download.py dataset=tum files=[freiburg1_xyz]      others; docs/guides/data.md says what each set is
python scripts/download.py weights=affnet                         -> weights/AffNet.pth
python scripts/download.py weights=hardnet++ sha256=HEX           for a file whose SHA-256 is not pinned here, or any

L2-Net's authors publish MATLAB files only and no stable address of a port is known; a port that you have is converted
by scripts.patch_networks.export architecture=l2net.
"""

import hashlib
import http.client
import os
import re
import shutil
import tarfile
import tempfile
import urllib.error
import urllib.request
import zlib
from pathlib import Path, PurePosixPath, PureWindowsPath

from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from fmtorch.core.terminal import console, exits_with_message

DEFAULTS = dict.fromkeys(("weights", "dataset", "files", "sha256", "folder", "url")) | {"timeout": 60}
KNOWN = OmegaConf.load(Path(__file__).with_suffix(".yaml"))
WEIGHTS, DATASETS = KNOWN.weights, KNOWN.datasets


def resume(url: str, path: Path, timeout: float | int = 60) -> None:
    """Fetch `url` into `path`, beside which an unfinished part is kept, and continued where the server can.
    Raises ConnectionError where it cannot be fetched whole; the same call then goes on."""
    if path.is_file():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    begin = part.stat().st_size if part.is_file() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={begin}-"} if begin else {})
    try:
        with urllib.request.urlopen(request, timeout=timeout) as response:
            begin = begin if response.status == 206 else 0  # else the server sends it from the beginning
            with part.open("ab" if begin else "wb") as file:
                while chunk := response.read(1 << 20):
                    file.write(chunk)
                length = response.headers.get("Content-Length")
                if length is not None and file.tell() != begin + int(length):
                    raise ConnectionError(f"{url} broke off after {file.tell()} of {begin + int(length)} bytes")
    except urllib.error.HTTPError as error:
        if error.code != 416:  # nothing is left to send
            raise ConnectionError(f"{url} cannot be fetched ({error.code} {error.reason})") from error
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError) as error:
        raise ConnectionError(f"{url} broke off or cannot be fetched ({error}); the same command goes on") from error
    os.replace(part, path)


def expect_digest(url: str, path: Path, sha256: str | None) -> str:
    """The file's SHA-256. Raises ValueError, and drops the file, where it is another one; None accepts any."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if sha256 is not None and digest != sha256.lower():
        path.unlink()
        raise ValueError(f"{url} has SHA-256 {digest}, not {sha256}: it was not kept")
    return digest


def unpack(archive: Path, folder: Path) -> list[Path]:
    """Unpack a tar archive; its files and folders appear in `folder` when all are there. Returns them.
    Raises ValueError for a damaged archive, for members that would leave the folder, and for links and devices."""
    with tempfile.TemporaryDirectory(dir=folder, prefix=".unpacking") as temporary:
        try:
            with tarfile.open(archive) as tar:
                for member in tar:
                    _extract(tar, member, Path(temporary))
        except (tarfile.TarError, EOFError, zlib.error, OSError) as error:
            raise ValueError(f"{archive}: cannot be unpacked ({error}); delete it and fetch it again") from error
        unpacked = sorted(Path(temporary).iterdir())
        for path in unpacked:
            if (folder / path.name).exists():
                raise ValueError(f"{folder / path.name} is there already; name another folder or remove it")
        return [path.replace(folder / path.name) for path in unpacked]


def _extract(tar: tarfile.TarFile, member: tarfile.TarInfo, folder: Path) -> None:
    """Write a file or make a folder below `folder`: what `filter="data"` allows, which Python 3.11.2 has not.
    Raises TarError for anything else, and for a name that leads elsewhere."""
    name = PurePosixPath(member.name)
    if name.is_absolute() or ".." in name.parts or PureWindowsPath(member.name).drive or "\\" in member.name:
        raise tarfile.TarError(f"{member.name!r} would be outside the folder")
    path = folder / name
    if member.isdir():
        path.mkdir(parents=True, exist_ok=True)
        return
    content = tar.extractfile(member) if member.isfile() else None
    if content is None:
        raise tarfile.TarError(f"{member.name!r} is neither a file nor a folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    with content, path.open("wb") as file:
        shutil.copyfileobj(content, file)


def fetch_dataset(config: DictConfig) -> list[Path]:
    """Fetch and unpack a data set's archives; those whose folders are there are skipped."""
    if config.dataset not in DATASETS:
        raise ValueError(f"dataset={config.dataset}; there are: {', '.join(DATASETS)}")
    source = DATASETS[config.dataset]
    console.print(f"licence: {source.licence}\ncite: {source.citation}", highlight=False, markup=False)
    if source.by_hand:
        raise ValueError(f"{config.dataset} cannot be fetched from here: {source.by_hand}")
    folder, unpacked = Path(config.folder or config.dataset), []
    for file in config.files or source.files:
        address = config.url or source.url
        url = address.format(file=file, camera=file.partition("_")[0])
        target = folder / f".{file}.archive"
        if (folder / f".{file}.complete").is_file():
            console.print(f"{file} is there", highlight=False)
            continue
        resume(url, target, config.timeout)
        expect_digest(url, target, None if config.sha256 == "any" else config.sha256)
        unpacked += unpack(target, folder)
        (folder / f".{file}.complete").touch()
        target.unlink()
    for path in unpacked:
        console.print(str(path), highlight=False, markup=False)
    return unpacked


def fetch(config: DictConfig) -> Path:
    if config.weights not in WEIGHTS:
        raise ValueError(f"weights={config.weights}; there are: {', '.join(WEIGHTS)}")
    entry = WEIGHTS[config.weights]
    name, expected = entry.url.rpartition("/")[2], config.sha256 or entry.sha256
    if expected is None:
        as_stated = "give sha256=HEX as its publisher states it, or sha256=any to accept what comes"
        raise ValueError(f"the SHA-256 of {name} is not pinned: {as_stated}")
    if expected != "any" and not re.fullmatch(r"[0-9a-fA-F]{64}", expected):
        raise ValueError(f"sha256={expected} is no SHA-256: 64 hexadecimal digits, or any")
    path = Path(config.folder or "weights") / name
    resume(config.url or entry.url, path, config.timeout)
    digest = expect_digest(config.url or entry.url, path, None if expected == "any" else expected)
    state = "not verified" if expected == "any" else "verified"
    console.print(f"{path}  SHA-256 {digest} ({state})  licence: MIT  architecture={entry.architecture}")
    return path


def main() -> None:
    with exits_with_message():
        config = OmegaConf.merge(OmegaConf.create(DEFAULTS), OmegaConf.from_cli())
        assert isinstance(config, DictConfig)
        if config.dataset is not None:
            fetch_dataset(config)
        elif config.weights is None:
            table = Table("weights", "architecture", "licence", "SHA-256", "URL")
            for name, entry in WEIGHTS.items():
                table.add_row(name, entry.architecture, "MIT", entry.sha256 or "not known", entry.url)
            sets = Table("dataset", "files", "licence", "citation")
            for name, source in DATASETS.items():
                sets.add_row(name, ", ".join(source.files) or "by hand", source.licence, source.citation)
            console.print(table, sets)
        else:
            fetch(config)


if __name__ == "__main__":
    main()
