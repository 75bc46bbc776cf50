"""The page in a browser: no errors and no requests, light and dark, wide and narrow, with and without its script."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from fmtorch.evaluation.page import Picture, Section, Shown, ShownPair, render
from fmtorch.runs import PairRow, to_table
from tests.evaluation.browser import Page, find_chromium

CHROMIUM = find_chromium()
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the path or in $CHROMIUM")
NAMES = ["sift_ratio", "sift_gms threshold=0.9", 'a long name of a run with <b>many</b> "words" & options=0.123']
NAMES += [f"run {i}" for i in range(6)]
WIDTHS = (390, 1280)
VISIBLE = "[...document.querySelectorAll('tbody tr, .key li')].filter(e => e.offsetParent !== null).length"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with Page(CHROMIUM, tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(0)
    runs = {}
    for k, name in enumerate(NAMES):
        nsgd = np.clip(rng.gamma(1, 0.02 + 0.01 * k, 24), 0, 1)
        runs[name] = to_table(
            [
                PairRow(f"p{i}", i, f"family {i % 4}", f"s{i % 8}", True, nsgd=float(v), F=[1.0] + [0.0] * 8,
                        seconds_features=0.1, seconds_matching=0.2, seconds_estimation=0.01 * (k + 1))
                for i, v in enumerate(nsgd)
            ]
        )  # fmt: skip
    image = np.full((300, 900, 3), 128, np.uint8)
    seen = [Shown(name, 0.01, "", [Picture(image, "grey", "a picture")]) for name in NAMES[:3]]
    pairs = [ShownPair("p0", [*seen, Shown(NAMES[3], None, "no keypoints in image 1")], ["a note"])]
    rows = [[name, "a set", "0123abcd", "0.1.0", "0", f"runs/{i}"] for i, name in enumerate(NAMES)]
    file = tmp_path_factory.mktemp("report") / "report.html"
    sections = [Section("a set", runs, pairs), Section("another", {NAMES[0]: runs[NAMES[0]]}, [], ["No pictures: x"])]
    file.write_text(render("Runs <script>alert(1)</script>", sections, rows, [("seed", "0")]), encoding="utf-8")
    return file


def pixels(png: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_no_complaints_and_nothing_wider_than_the_window(page: Page, report: Path, width: int, dark: bool) -> None:
    page.open(report, width, dark=dark)
    assert page.run("document.title") == "Runs <script>alert(1)</script>"
    assert page.run("document.documentElement.scrollWidth") <= width  # what is wider scrolls within its own frame
    # Letters of the plots are no smaller than ten pixels.
    assert (
        page.run("Math.min(...[...document.querySelectorAll('.plot text')].map(t => t.getBoundingClientRect().height))")
        > 10
    )
    assert page.run("[...document.images].every(i => i.getBoundingClientRect().right <= innerWidth)")
    # Curves are seen on their ground: at least 3 to 1 in contrast (WCAG 1.4.11).
    contrasts = page.run(
        """(() => {
        const light = (text) => { const c = text.match(/[\\d.]+/g).map(Number).slice(0, 3).map(v => v / 255)
          .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
          return 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2] + 0.05; };
        const paper = light(getComputedStyle(document.body).backgroundColor);
        return [...document.querySelectorAll(".curve")].map(e => light(getComputedStyle(e).stroke))
          .map(c => Math.max(c, paper) / Math.min(c, paper)); })()"""
    )
    assert min(contrasts) >= 3
    ground = pixels(page.picture(full_page=False))[5, 5]
    assert (ground < 60).all() if dark else (ground > 200).all()
    assert page.complaints == []


def test_tables_sort_by_figures_and_by_names(page: Page, report: Path) -> None:
    page.open(report)
    head = "document.querySelector('table.sortable thead th:nth-child({}) button')"
    column = "[...document.querySelector('table.sortable').tBodies[0].rows].map(r => r.cells[{}].textContent)"
    page.run(f"{head.format(4)}.click()")
    falling = [float(text) for text in page.run(column.format(3))]
    assert falling == sorted(falling, reverse=True)
    assert len(set(falling)) > 3
    page.run(f"{head.format(4)}.click()")
    assert [float(text) for text in page.run(column.format(3))] == falling[::-1]
    assert page.run("document.querySelector('table.sortable th[aria-sort]').textContent") == "AUC@0.05"
    page.run(f"{head.format(1)}.click()")
    names = page.run(column.format(0))
    assert names == page.run(f"{column.format(0)}.sort((a, b) => a.localeCompare(b))")
    assert sorted(names) == sorted(NAMES)
    assert page.complaints == []


def test_the_filter_hides_other_runs_everywhere(page: Page, report: Path) -> None:
    page.open(report)
    before = page.run(VISIBLE)

    def write(words: str) -> None:
        page.run(f"document.querySelector('#filter input').value = {words!r}")
        page.run("document.querySelector('#filter input').dispatchEvent(new Event('input'))")

    write("GMS 0.9")
    shown = page.run(
        "[...new Set([...document.querySelectorAll('[data-run]')].filter(e => e.getClientRects().length)"
        ".map(e => e.dataset.run))]"
    )
    assert shown == ["sift_gms threshold=0.9"]
    assert page.run("document.querySelector('#filter span').textContent") == f"1 of {len(NAMES)} runs"
    write("")
    assert page.run(VISIBLE) == before
    assert page.complaints == []


def test_a_curve_is_brought_out_and_a_picture_enlarged(page: Page, report: Path) -> None:
    page.open(report)
    page.run("document.querySelectorAll('.key li')[1].focus()")
    opacity = "[...document.querySelectorAll('#s1 .curve')].map(e => [e.dataset.run, getComputedStyle(e).opacity])"
    assert dict(page.run(opacity))[NAMES[1]] == "1"
    assert {value for name, value in page.run(opacity) if name != NAMES[1]} == {"0.15"}
    page.run("document.querySelector('figure img').click()")
    assert page.run("document.querySelector('dialog').open")
    assert page.run("document.querySelector('dialog img').decode().then(() => 1)") == 1
    page.run("document.querySelector('dialog').click()")
    assert not page.run("document.querySelector('dialog').open")
    assert page.complaints == []


def test_all_can_be_read_without_the_script(page: Page, report: Path) -> None:
    page.open(report)
    with_script = page.run(VISIBLE)
    page.open(report, script=False)
    assert page.run(VISIBLE) == with_script
    assert page.run("document.querySelector('#filter').offsetParent === null")  # nothing that would not work
    assert page.run("document.querySelectorAll('button').length") == 0
    assert page.complaints == []


def test_complaints_are_heard(page: Page, tmp_path: Path) -> None:
    """What the other tests rely on: errors, exceptions and requests of a page do not pass unnoticed."""
    file = tmp_path / "bad.html"
    file.write_text(
        "<script>console.error('one'); setTimeout(() => { throw new Error('two') })</script>"
        "<img src='http://127.0.0.1:9/three.png'>"
    )
    page.open(file)
    page.run("new Promise(done => setTimeout(done, 200))")
    heard = " ".join(page.complaints)
    page.complaints.clear()
    assert all(word in heard for word in ("one", "two", "three"))
