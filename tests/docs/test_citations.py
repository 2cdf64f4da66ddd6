"""The sections that docstrings and comments cite are headings of the pages."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TOPS = ("zbridge", "gateways", "tests")
PROTOCOLS = {page.stem for page in (ROOT / "docs/reference/protocols").glob("*.md")}
OWN = ""
"""The page of the protocol in whose folder the citation stands."""

TITLE = r'"([A-Z][^"]*)"'
PAGE = r"in ``([\w-]+\.md)``|(of the (?:protocol )?page\b|;)"
SOURCE = re.compile(r"\bSource: (.*?)(?:\.\s|\.?\Z)", re.DOTALL)
IN_BRACKETS = re.compile(rf"\(({TITLE}[^()]*)\)")
NAMED = re.compile(r'("[^.]*?(?:in ``[\w-]+\.md``|of the (?:protocol )?page\b))', re.DOTALL)
BEHIND = re.compile(rf"the protocol page, ({TITLE})")
PART = re.compile(rf"{TITLE}|{PAGE}")


def remarks(source: str) -> Iterator[str]:
    """Give the docstrings of a program and its comments; a comment of several lines is one."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value.value
    comment, last = "", 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            if token.start[0] != last + 1:
                yield comment
                comment = ""
            comment, last = f"{comment} {token.string.lstrip('# ')}", token.start[0]
    yield comment


def citations(remark: str) -> Iterator[tuple[str, str]]:
    """Give each title that a remark cites, and the name of its page or OWN."""
    for form in (SOURCE, IN_BRACKETS, NAMED, BEHIND):
        for passage in form.finditer(remark):
            titles: list[str] = []
            for title, page, _ in PART.findall(passage[1]):
                if title:
                    titles.append(" ".join(title.split()))
                else:
                    yield from ((each, page) for each in titles)
                    titles = []
            yield from ((each, OWN) for each in titles)
        remark = form.sub("", remark)


@cache
def headings(pages: str) -> set[str]:
    """Give the headings of the pages that a pattern below ``docs`` finds."""
    return {title for page in (ROOT / "docs").glob(pages) for title in re.findall("^#+ (.+)$", page.read_text(), re.M)}


def protocol_of(path: Path) -> str:
    """Give the protocol in whose folder a file is, nothing of others."""
    parts = path.relative_to(ROOT).parts
    folder = parts[parts.index("gateways") + 1] if "gateways" in parts[:-1] else ""
    return folder if folder in PROTOCOLS else ""


@cache
def cited() -> list[tuple[str, str, str]]:
    """Give each citation of a page: the file, the title, the pattern of the page."""
    found = []
    for path in sorted(each for top in TOPS for each in (ROOT / top).rglob("*.py") if each != Path(__file__)):
        protocol, text = protocol_of(path), path.read_text()
        if not protocol and ".md``" not in text:
            continue
        for title, page in (each for remark in remarks(text) for each in citations(remark)):
            if page or protocol:
                name = f"**/{page}" if page else f"reference/protocols/{protocol}.md"
                found.append((path.relative_to(ROOT).as_posix(), title, name))
    return found


@pytest.mark.parametrize(
    ("remark", "found"),
    [
        ('Sessions.\n\nSource: "A" and "B\nc" of the protocol page. "D" is none.', [("A", OWN), ("B c", OWN)]),
        ('Source: "A" (61) of the protocol page, "B" and "C" in ``b.md``.', [("A", OWN), ("B", "b.md"), ("C", "b.md")]),
        ('Source: "A".', [("A", OWN)]),
        ('Send it ("A", 3). Judge it ("B": it dies; "C").', [("A", OWN), ("B", OWN), ("C", OWN)]),
        ('# for good ("A"; "B" in ``b.md``)', [("A", OWN), ("B", "b.md")]),
        ('Written by hand after "A" and "B" of the page.', [("A", OWN), ("B", OWN)]),
        ('Bytes: "A" in ``b.md``. By hand from the protocol page, "C".', [("A", "b.md"), ("C", OWN)]),
        ('Robots of "1.4", and "D".', []),
    ],
)
def test_a_citation_is_recognised(remark: str, found: list[tuple[str, str]]) -> None:
    assert list(citations(remark)) == found


def test_every_section_that_is_cited_is_a_heading_of_its_page() -> None:
    assert {found for found in cited() if found[1] not in headings(found[2])} == set()


def test_the_gateways_of_the_documents_cite_their_pages() -> None:
    assert {"alf", "tcpudp", "wc2ec"} <= {page.split("/")[-1].removesuffix(".md") for _, _, page in cited()}
