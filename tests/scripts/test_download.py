"""scripts/download.py: what is fetched is whole and verified, or is not kept; data sets resume and unpack safely."""

import hashlib
import http.server
import io
import random
import re
import runpy
import tarfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest
from omegaconf import OmegaConf

SCRIPT = runpy.run_path(str(Path(__file__).resolve().parents[2] / "scripts" / "download.py"))
CONTENT = b"weights" * 1000
DIGEST = hashlib.sha256(CONTENT).hexdigest()


class Ranges(http.server.BaseHTTPRequestHandler):
    """Serves bytes from where they are asked for, and breaks off after `limit` of them; nothing else than them."""

    content, limit, ranges = b"", 0, True
    asked: ClassVar[list[str | None]] = []

    def do_GET(self) -> None:
        if "absent" in self.path:
            self.send_error(404)
            return
        wanted = self.headers.get("Range") if self.ranges else None
        self.asked.append(self.headers.get("Range"))
        begin = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted else 0
        rest = self.content[begin:]
        self.send_response(206 if wanted else 200)
        self.send_header("Content-Length", str(len(rest)))
        self.end_headers()
        self.wfile.write(rest[: self.limit])

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[tuple[type[Ranges], str]]:
    handler = type("Handler", (Ranges,), {"content": CONTENT, "limit": len(CONTENT), "asked": []})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as httpd:
        threading.Thread(target=httpd.serve_forever, args=(0.01,), daemon=True).start()  # ends soon
        yield handler, f"http://127.0.0.1:{httpd.server_address[1]}"
        httpd.shutdown()


def config(**values: Any) -> Any:
    return OmegaConf.merge(OmegaConf.create(SCRIPT["DEFAULTS"]), OmegaConf.create(values))


def test_a_verified_file_is_kept_and_another_is_not(server: tuple[type[Ranges], str], tmp_path: Path) -> None:
    folder = tmp_path / "weights"
    own = {"weights": "affnet", "url": f"{server[1]}/AffNet.pth", "folder": str(folder)}
    path = SCRIPT["fetch"](config(**own, sha256=DIGEST.upper()))
    assert (path, path.read_bytes()) == (folder / "AffNet.pth", CONTENT)
    path.unlink()
    with pytest.raises(ValueError, match=f"has SHA-256 {DIGEST}, not 65c8bb2c"):
        SCRIPT["fetch"](config(**own))
    assert list(folder.iterdir()) == []


def test_a_failed_fetch_leaves_no_file(server: tuple[type[Ranges], str], tmp_path: Path) -> None:
    handler, here = server
    handler.limit -= 5
    for address in (f"{here}/absent.pth", f"{here}/short.pth", "http://127.0.0.1:9/x.pth"):
        with pytest.raises(ConnectionError, match=re.escape(address)):
            SCRIPT["resume"](address, tmp_path / "w.pth", timeout=5)
    assert [p.name for p in tmp_path.iterdir()] == ["w.pth.part"]


def test_a_file_without_a_pinned_hash_needs_a_word(server: tuple[type[Ranges], str], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"SHA-256 of HardNet\+\+\.pth is not pinned: give sha256="):
        SCRIPT["fetch"](config(weights="hardnet++"))
    with pytest.raises(ValueError, match="sha256=abc is no SHA-256"):
        SCRIPT["fetch"](config(weights="hardnet++", sha256="abc"))
    own = {"sha256": "any", "url": f"{server[1]}/AffNet.pth", "folder": str(tmp_path / "w")}
    path = SCRIPT["fetch"](config(weights="hardnet++", **own))
    assert path.name == "HardNet++.pth"


def archive(path: Path, members: dict[str, bytes], link: str | None = None) -> bytes:
    """A gzipped tar of these files; link: a symbolic link to write besides."""
    with tarfile.open(path, "w:gz") as tar:
        for name, content in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
        if link is not None:
            member = tarfile.TarInfo("rgbd_dataset_x/link")
            member.type, member.linkname = tarfile.SYMTYPE, link
            tar.addfile(member)
    return path.read_bytes()


@pytest.fixture
def ranges(server: tuple[type[Ranges], str], tmp_path: Path) -> tuple[type[Ranges], str]:
    noise = random.Random(0).randbytes(50_000)
    content = archive(tmp_path / "source.tgz", {"rgbd_dataset_x/rgb.txt": b"# list", "rgbd_dataset_x/rgb/1.png": noise})
    handler, address = server
    handler.content, handler.limit = content, len(content)
    return handler, f"{address}/{{camera}}/{{file}}.tgz"


@pytest.mark.parametrize("continues", [True, False])
def test_a_data_set_that_broke_off_is_continued(continues, ranges, tmp_path):
    handler, url = ranges
    handler.ranges, handler.limit = continues, 20_000
    asked = config(dataset="tum", files=["x_y"], url=url, folder=str(tmp_path / "TUM"), timeout=5)
    with pytest.raises(ConnectionError, match="broke off"):
        SCRIPT["fetch_dataset"](asked)
    assert [path.name for path in (tmp_path / "TUM").iterdir()] == [".x_y.archive.part"]
    handler.limit = len(handler.content)
    folders = SCRIPT["fetch_dataset"](asked)
    assert handler.asked == [None, "bytes=20000-"]
    assert folders == [tmp_path / "TUM/rgbd_dataset_x"]
    assert (folders[0] / "rgb.txt").read_bytes() == b"# list"
    assert len((folders[0] / "rgb/1.png").read_bytes()) == 50_000
    assert sorted(path.name for path in (tmp_path / "TUM").iterdir()) == [".x_y.complete", "rgbd_dataset_x"]
    assert SCRIPT["fetch_dataset"](asked) == []  # it is there
    assert len(handler.asked) == 2


@pytest.fixture(params=[True, False], ids=["new", "3.11.2"])
def python(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """This Python, and one whose tarfile cannot check what it unpacks, as that of Debian 12."""
    if not request.param:
        monkeypatch.delattr(tarfile, "data_filter", raising=False)


EVIL = [{"../outside.txt": b"x"}, {"a/../../outside.txt": b"x"}, {"/outside.txt": b"x"}, {"C:outside.txt": b"x"}, {}]


@pytest.mark.usefixtures("python")
@pytest.mark.parametrize("members", EVIL)
def test_archives_cannot_write_elsewhere(members: dict[str, bytes], tmp_path: Path) -> None:
    path = tmp_path / "evil.tgz"
    archive(path, members, link=None if members else "/etc/passwd")
    (tmp_path / "in/side").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"evil\.tgz: cannot be unpacked"):
        SCRIPT["unpack"](path, tmp_path / "in/side")
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["evil.tgz", "in", "side"]


def test_damaged_archives_and_folders_that_are_there_are_reported(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.tgz", tmp_path / "folder"
    content = archive(path, {"one/a": b"1" * 5000, "two/b": b"2"})
    (folder / "two").mkdir(parents=True)
    with pytest.raises(ValueError, match="two is there already; name another folder or remove it"):
        SCRIPT["unpack"](path, folder)
    assert [p.name for p in folder.iterdir()] == ["two"]
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"a\.tgz: cannot be unpacked .*; delete it and fetch it again"):
        SCRIPT["unpack"](path, folder)
    assert [p.name for p in folder.iterdir()] == ["two"]


def test_sets_behind_a_form_say_what_to_do() -> None:
    for name in ("kitti", "tanks_and_temples", "fmbench"):
        with pytest.raises(ValueError, match=f"{name} cannot be fetched from here: .*https://"):
            SCRIPT["fetch_dataset"](config(dataset=name))
    with pytest.raises(ValueError, match="dataset=imagenet; there are: tum, 1dsfm, kitti"):
        SCRIPT["fetch_dataset"](config(dataset="imagenet"))
    for source in SCRIPT["DATASETS"].values():
        assert source.licence
        assert source.citation
        assert bool(source.by_hand) != bool(source.url and source.files)
