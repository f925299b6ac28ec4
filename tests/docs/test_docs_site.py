"""The site: it builds without a warning, and its pages load nothing from another host."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml
from pages import DOCS, ROOT

import daedalus

LOADING = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src", "video": "src"}


class LoadedAddresses(HTMLParser):
    """The addresses that a browser requests when it opens a page."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        address = dict(attrs).get(LOADING.get(tag, ""))
        if address:
            self.found.append(address)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; a broken link or anchor fails the build."""
    target = tmp_path_factory.mktemp("site")
    build = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(target)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert build.returncode == 0, build.stdout + build.stderr
    return target


def test_every_page_is_built_and_in_the_navigation(site: Path) -> None:
    built = {page.relative_to(site).with_suffix(".md").as_posix() for page in site.rglob("*.html")} - {"404.md"}
    written = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    assert built == written
    text = (ROOT / "mkdocs.yml").read_text()
    named = set(re.findall(r": ([\w/]+\.md)$", text, re.MULTILINE))
    assert named == written
    assert yaml.safe_load(text)["theme"]["font"] is False


def test_no_page_loads_anything_from_another_host(site: Path) -> None:
    loaded = [(page.name, address) for page in site.rglob("*.html") for address in LoadedAddresses(page).found]
    assert len(loaded) > 50
    assert [entry for entry in loaded if re.match(r"(\w+:)?//", entry[1])] == []


def test_no_style_loads_anything_from_another_host(site: Path) -> None:
    styles = list(site.rglob("*.css"))
    assert styles
    for style in styles:
        assert not re.search(r"(url\(|@import)\s*[\"']?(https?:)?//", style.read_text("utf-8")), style


def test_no_page_has_a_diagram_that_needs_a_script_of_another_host(site: Path) -> None:
    """The theme loads mermaid from a CDN where a page has such a block."""
    assert not [page for page in site.rglob("*.html") if 'class="mermaid"' in page.read_text("utf-8")]


def test_pictures_are_on_the_site(site: Path) -> None:
    for page in set(site.rglob("*.html")) - {site / "404.html"}:  # that one is for any depth of the path
        for address in LoadedAddresses(page).found:
            assert (page.parent / address.partition("?")[0].partition("#")[0]).exists(), (page, address)


def test_the_python_api_is_on_its_page(site: Path) -> None:
    page = (site / "reference" / "python.html").read_text("utf-8")
    headings = re.findall(r"<h[34] id=[^>]*>([\w.]+)<", page)
    assert {f"daedalus.{name}" for name in daedalus.__all__} - {"daedalus.__version__"} <= set(headings)
    assert {"Client.act", "Policy.act", "Transport.query", "MetricsWriter.write"} <= set(headings)
