"""scripts/download.py: what is fetched is whole and verified, or is not kept."""

from __future__ import annotations

import functools
import hashlib
import http.server
import re
import runpy
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

SCRIPT = runpy.run_path(str(Path(__file__).resolve().parents[1] / "scripts" / "download.py"))
CONTENT = b"weights" * 1000
DIGEST = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """The address of a server on this machine with one file, and one that breaks off."""
    (tmp_path / "served").mkdir()
    (tmp_path / "served" / "AffNet.pth").write_bytes(CONTENT)

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path != "/short.pth":
                super().do_GET()
                return
            self.send_response(200)
            self.send_header("Content-Length", str(len(CONTENT) + 5))
            self.end_headers()
            self.wfile.write(CONTENT)

        def log_message(self, *args: object) -> None:
            pass

    handler = functools.partial(Handler, directory=str(tmp_path / "served"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as httpd:
        threading.Thread(target=httpd.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{httpd.server_address[1]}"
        httpd.shutdown()


def config(**values: Any) -> Any:
    return OmegaConf.merge(OmegaConf.create(SCRIPT["DEFAULTS"]), OmegaConf.create(values))


def test_a_verified_file_is_kept(server: str, tmp_path: Path) -> None:
    folder = tmp_path / "weights"
    path = SCRIPT["fetch"](
        config(weights="affnet", url=f"{server}/AffNet.pth", sha256=DIGEST.upper(), folder=str(folder))
    )
    assert path == folder / "AffNet.pth"
    assert path.read_bytes() == CONTENT
    assert [p.name for p in folder.iterdir()] == ["AffNet.pth"]


def test_another_file_than_the_pinned_one_is_not_kept(server: str, tmp_path: Path) -> None:
    folder = tmp_path / "weights"
    with pytest.raises(ValueError, match=f"has SHA-256 {DIGEST}, not 65c8bb2c"):
        SCRIPT["fetch"](config(weights="affnet", url=f"{server}/AffNet.pth", folder=str(folder)))
    assert list(folder.iterdir()) == []


def test_a_failed_fetch_leaves_what_was_there(server: str, tmp_path: Path) -> None:
    path = tmp_path / "w.pth"
    path.write_bytes(b"old")
    for address in (f"{server}/absent.pth", f"{server}/short.pth", "http://127.0.0.1:9/x.pth"):
        with pytest.raises(ConnectionError, match=re.escape(address)):
            SCRIPT["download"](address, path, None, timeout=5)
    assert path.read_bytes() == b"old"
    assert {p.name for p in tmp_path.iterdir()} == {"w.pth", "served"}


def test_a_file_without_a_pinned_hash_needs_a_word(server: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"SHA-256 of HardNet\+\+\.pth is not pinned: give sha256="):
        SCRIPT["fetch"](config(weights="hardnet++"))
    with pytest.raises(ValueError, match="sha256=abc is no SHA-256"):
        SCRIPT["fetch"](config(weights="hardnet++", sha256="abc"))
    path = SCRIPT["fetch"](
        config(weights="hardnet++", sha256="any", url=f"{server}/AffNet.pth", folder=str(tmp_path / "w"))
    )
    assert path.name == "HardNet++.pth"


def test_unknown_weights_are_answered_with_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"there are: affnet, orinet, .*hardnet\+\+"):
        SCRIPT["fetch"](config(weights="superpoint"))
    for entry in SCRIPT["TABLE"].values():
        assert entry.url.startswith("https://")
        assert entry.sha256 is None or re.fullmatch("[0-9a-f]{64}", entry.sha256)
