"""The guide: its listings are the files of the example, nothing is missing, and it stays short."""

import re
from pathlib import Path

import pytest

from zbridge import protocol
from zbridge.fleet import topics

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLE, SECOND = DOCS / "examples" / "khepera", DOCS / "examples" / "arcos"
GUIDE = (DOCS / "how-to" / "add-a-protocol.md").read_text()
LISTINGS = re.findall(r'^```(?:python|toml)(?: title="(\S+)")?\n(.*?)^```$', GUIDE, re.DOTALL | re.MULTILINE)
FILES = ("pyproject.toml", *(str(path.relative_to(EXAMPLE)) for path in sorted((EXAMPLE / "khepera").glob("*.py"))))
SHOWN = ("arcos/messages.py", "arcos/session.py")
"""Files of the second example of which the guide shows parts."""
MOST_LINES, MOST_OF_SECOND = 270, 300


def lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.strip()]


@pytest.mark.parametrize("file", FILES)
def test_the_listings_of_a_file_put_together_are_the_file(file: str) -> None:
    shown = [line for name, listing in LISTINGS if name == file for line in lines(listing)]
    assert shown == lines((EXAMPLE / file).read_text())


@pytest.mark.parametrize("file", SHOWN)
def test_a_listing_of_the_second_example_is_a_part_of_its_file(file: str) -> None:
    listings = [listing for name, listing in LISTINGS if name == file]
    assert listings
    assert [listing for listing in listings if listing not in (SECOND / file).read_text()] == []


def test_every_listing_is_of_a_file_or_is_run() -> None:
    assert {name for name, _ in LISTINGS} == {*FILES, *SHOWN, ""}
    assert len(re.findall(r"^```(?:python|toml)", GUIDE, re.MULTILINE)) == len(LISTINGS)


@pytest.mark.parametrize("program", [listing for name, listing in LISTINGS if not name])
def test_a_listing_of_no_file_runs(program: str) -> None:
    exec(compile(program, "the guide", "exec", dont_inherit=True), {"__name__": "guide"})


def test_the_protocol_takes_no_more_lines_than_the_guide_says() -> None:
    for folder, most in ((EXAMPLE / "khepera", MOST_LINES), (SECOND / "arcos", MOST_OF_SECOND)):
        files = [path for path in folder.glob("*.py") if path.name != "simulator.py"]
        assert sum(len(path.read_text().splitlines()) for path in files) <= most
        assert f"{most} lines" in GUIDE


def test_every_name_that_the_guide_imports_from_the_package_for_authors_is_there() -> None:
    tools = ("ExchangeSession", "Session", "Odometry", "BearingScan", "Differential", "Factors", "DeviceClock")
    assert [name for name in tools if f"`{name}`" not in GUIDE] == []
    named = re.findall(r"protocol\.([A-Z]\w+)", GUIDE)
    assert [name for name in (*named, *tools) if not hasattr(protocol, name)] == []
    keys = re.findall(r"`(CMD_\w+|POSE|MOTION|SCAN|SENSOR|TEXT)", GUIDE)
    assert [name for name in keys if not hasattr(topics, name)] == []
