"""Files from the network, whole and verified or not there at all; archives unpacked safely."""

from __future__ import annotations

import hashlib
import http.client
import os
import tarfile
import tempfile
import urllib.error
import urllib.request
import zlib
from pathlib import Path


def expect_digest(url: str, path: Path, sha256: str) -> None:
    """Raises ValueError, and drops the file, where it is another one."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != sha256.lower():
        path.unlink()
        raise ValueError(f"{url} has SHA-256 {digest}, not {sha256}: it was not kept")


def resume(url: str, path: Path, timeout: float | int = 60) -> None:
    """Fetch `url` into `path`, beside which an unfinished part is kept, and continued where the server can.

    Raises ConnectionError where it cannot be fetched whole; the same call then goes on.
    """
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


def unpack(archive: Path, folder: Path) -> list[Path]:
    """Unpack a tar archive; its files and folders appear in `folder` when all are there. Returns them.

    Raises ValueError for a damaged archive, for members that would leave the folder, and for links and devices.
    """
    if not hasattr(tarfile, "data_filter"):
        raise ValueError("unpacking safely needs Python 3.11.4 or newer")
    with tempfile.TemporaryDirectory(dir=folder, prefix=".unpacking") as temporary:
        try:
            with tarfile.open(archive) as tar:
                tar.extractall(temporary, filter="data")
        except (tarfile.TarError, EOFError, zlib.error, OSError) as error:
            raise ValueError(f"{archive}: cannot be unpacked ({error}); delete it and fetch it again") from error
        unpacked = []
        for path in sorted(Path(temporary).iterdir()):
            if (folder / path.name).exists():
                raise ValueError(f"{folder / path.name} is there already; name another folder or remove it")
        for path in sorted(Path(temporary).iterdir()):
            os.replace(path, folder / path.name)
            unpacked.append(folder / path.name)
    return unpacked


def download(url: str, path: Path, sha256: str | None, timeout: float | int = 60) -> str:
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
        actual = digest.hexdigest()
        if sha256 is not None and actual != sha256.lower():
            raise ValueError(f"{url} has SHA-256 {actual}, not {sha256}: it was not kept")
        os.replace(unfinished, path)
    except urllib.error.URLError as error:
        raise ConnectionError(
            f"{url} cannot be fetched ({error.reason}). Fetch it elsewhere and give the file to scripts/export_onnx.py"
        ) from error
    finally:
        Path(unfinished).unlink(missing_ok=True)
    return actual
