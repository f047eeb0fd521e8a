"""The documentation as a site: built strictly, read in a real browser, without a network."""

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.full

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `make docs` builds; a warning fails it."""
    folder = tmp_path_factory.mktemp("docs") / "site"
    result = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )
    assert result.returncode == 0, result.stderr
    return folder


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None: ...


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    """The site on a local server."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(site))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_nothing_on_any_page_comes_from_a_network(site: Path) -> None:
    pages, styles = list(site.rglob("*.html")), list(site.rglob("*.css"))
    assert len(pages) > len(list((REPOSITORY / "docs").glob("*.md"))) and styles
    for file in [*pages, *styles]:
        loaded = re.findall(
            r"<(?:script|img|link|iframe|source)\b[^>]*?(?:src|href)=[\"']?([^\"' >]+)", file.read_text()
        )
        assert loaded or file in styles, file.name
        loaded += re.findall(r"(?:url\(|@import )[\"']?([^\"')]+)", file.read_text())
        assert not [url for url in loaded if url.startswith(("http", "//"))], file.name


def test_every_page_is_in_the_navigation(site: Path) -> None:
    listed = set(re.findall(r'href="([\w-]+)\.html"', (site / "results.html").read_text()))
    assert {page.stem for page in (REPOSITORY / "docs").glob("*.md")} <= listed | {"results"}


def watched(page: Any, own: str) -> list[str]:
    """Addresses other than its own that the page asks for from now on."""
    asked: list[str] = []
    page.on("request", lambda r: None if r.url.startswith((own, "data:", "blob:")) else asked.append(r.url))
    return asked


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pages_are_shown_as_the_reader_likes_it(page: Any, address: str, scheme: str) -> None:
    asked = watched(page, address)
    page.emulate_media(color_scheme=scheme)
    for name in ("index", "capture-guide", "configuration"):
        page.goto(f"{address}/{name}.html", wait_until="networkidle")
        shade = page.evaluate("getComputedStyle(document.body).backgroundColor")
        levels = [int(level) for level in re.findall(r"\d+", shade)[:3]]
        assert (min(levels) > 200) if scheme == "light" else (max(levels) < 80), shade
        broken = "[...document.images].filter(i => i.loading != 'lazy' && !i.naturalWidth).map(i => i.src)"
        assert page.evaluate(broken) == []
    assert asked == []


@pytest.mark.parametrize("place", ["server", "disk"])
def test_the_search_finds_without_a_network(page: Any, site: Path, address: str, place: str) -> None:
    start = address if place == "server" else site.as_uri()
    asked = watched(page, start)
    page.goto(f"{start}/index.html", wait_until="networkidle")
    page.get_by_role("textbox", name="Search").wait_for(state="attached")
    page.keyboard.press("/")
    page.keyboard.type("aniposelib")
    found = page.locator(".md-search-result__list")  # what the first letters find is shown before
    found.get_by_text("Formats").first.wait_for()
    assert asked == []


def test_a_phone_shows_a_page_without_scrolling_sideways(browser: Any, address: str) -> None:
    phone = browser.new_page(viewport={"width": 390, "height": 844})
    for name in ("index", "capture-guide", "checklist"):
        phone.goto(f"{address}/{name}.html")
        assert phone.evaluate("document.documentElement.scrollWidth") <= 390, name
    phone.close()


def test_the_checklist_prints_on_one_page(page: Any, address: str) -> None:
    page.goto(f"{address}/checklist.html", wait_until="networkidle")
    pdf = page.pdf(format="A4")
    assert len(re.findall(rb"/Type\s*/Page\b", pdf)) == 1
