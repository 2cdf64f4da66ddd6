"""The site: built without a warning, self-contained, old paths answer. A browser searches it in ``tests/browser``."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml

from tests.docs.site import ROOT, built

FETCHING = {"script": "src", "img": "src", "source": "src", "iframe": "src", "video": "src", "object": "data"}
OLD = (
    *("add-a-protocol", "architecture", "camera", "commands", "console", "control", "deployment", "doctor", "foxglove"),
    *("glossary", "hq", "keys", "performance", "recording", "reliability", "ros2", "security", "what-happens"),
    *("protocols/alf", "protocols/ros2", "protocols/tcpudp", "protocols/wc2ec"),
)
"""Pages as they were before there was a site."""


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.getbasetemp().parent)


class Fetches(HTMLParser):
    """What a browser fetches when it shows a page: no ``<a>``."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "link" and "canonical" not in (given.get("rel") or ""):
            self.found.append(given.get("href") or "")
        self.found.append(given.get(FETCHING.get(tag, "-")) or "")


def test_no_page_fetches_from_another_host(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        fetches = Fetches()
        fetches.feed(page.read_text())
        assert fetches.found
        assert [each for each in fetches.found if re.match(r"(\w+:)?//", each)] == [], page
        if page.name != "404.html":  # its paths begin at the root
            local = (page.parent / each.partition("?")[0] for each in fetches.found if each and each[:5] != "data:")
            assert [path for path in local if not path.exists()] == [], page
    for sheet in site.rglob("*.css"):
        assert re.findall(r"(?:url\(|@import)\s*['\"]?(?:\w+:)?//", sheet.read_text()) == [], sheet


@pytest.mark.parametrize("page", OLD)
def test_an_old_path_leads_to_the_page_that_replaced_it(site: Path, page: str) -> None:
    stub = site / page / "index.html"
    (target,) = re.findall(r'http-equiv="refresh" content="0; url=([^"#]+)', stub.read_text())
    assert (stub.parent / target / "index.html").resolve().is_relative_to(site)
    assert (stub.parent / target / "index.html").exists()


def test_every_page_stands_in_the_navigation_once() -> None:
    text = re.sub(r"!!python\S*", "", (ROOT / "mkdocs.yml").read_text())
    listed = re.findall(r"[\w/-]+\.md", yaml.dump(yaml.safe_load(text)["nav"]))
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(listed) == sorted(page for page in pages if not page.startswith("examples/"))


def test_no_link_leads_out_of_the_documentation_or_into_its_examples() -> None:
    for page in (ROOT / "docs").rglob("*.md"):
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
            if not re.match(r"\w+:|#", target):
                path = (page.parent / target.partition("#")[0]).resolve()
                assert path.is_relative_to(ROOT / "docs"), f"{page}: {target}"
                assert not path.is_relative_to(ROOT / "docs" / "examples"), f"{page}: {target}"
