"""Every command and listing that a page tells to type is run, and every output that it shows is compared.

The runs take minutes, and have a command of their own: ``pytest -m pages``.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.docs.pages import LISTED, PAGES, ROOT, SHOWN, TYPED, Block, blocks, difference, exchanges
from tests.e2e.rigs.processes import NotHereError, apart

GUIDE = ROOT / "docs" / "how-to" / "add-a-protocol.md"  # tests/docs/test_add_a_protocol.py runs its listings
RUN = [
    page
    for page in PAGES
    if page != GUIDE and any(block.language not in SHOWN and not block.not_here for block in blocks(page.read_text()))
]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
NOT_PROGRAMS = ("sudo", "export", "cd", "echo", "git")
NOT_ON_TEST_MACHINES = {"apt", "ros2", "ros2bag", "rviz2"}
"""Programs of ROS and of its installation; every other command is run somewhere."""
PAGE_S = 240


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.e2e
@pytest.mark.pages
@pytest.mark.parametrize("page", RUN, ids=name)
def test_what_a_page_tells_to_type_works_from_top_to_bottom(page: Path) -> None:
    try:
        prefix = apart()
    except NotHereError as error:
        pytest.skip(f"network namespaces: {error}")
    ran = subprocess.run(
        [*prefix, "--mount", "--uts", sys.executable, "-m", "tests.docs.run_page", name(page)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=PAGE_S,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_block_says_what_it_is(page: Path) -> None:
    fences = re.findall(r"^ *```\w*", page.read_text(), re.MULTILINE)
    found = list(blocks(page.read_text()))
    assert len(fences) == 2 * len(found)
    for block in found:
        assert block.language in (*TYPED, *LISTED, *SHOWN), f"line {block.line}"
        if block.language not in (*SHOWN, *TYPED, "python", "toml"):
            assert block.title is not None or block.not_here, f"line {block.line}: nobody reads it"
        unknown = {word for word, _ in block.how} - {"background", "setup", "keys", "elsewhere", "nowhere"}
        assert not unknown, f"line {block.line}: {unknown}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_no_command_hides_in_an_indented_block(page: Path) -> None:
    indented = r"^(?:    |\t)(?:zbridge|pip|python|sudo|bash) .*$"
    inside = "".join(block.text for block in blocks(page.read_text()))
    assert [line for line in re.findall(indented, page.read_text(), re.MULTILINE) if line.strip() not in inside] == []


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_what_is_run_elsewhere_is_named_there(page: Path) -> None:
    for block in blocks(page.read_text()):
        told = block.says("elsewhere")
        if told is None:
            continue
        path, _, reason = told.partition(": ")
        assert reason, f"line {block.line}: no reason"
        assert (ROOT / path).exists(), f"line {block.line}: {path}"
        text = "\n".join(file.read_text() for file in files(ROOT / path))
        for program in programs(block) | scripts(block):
            assert re.search(rf"\b{re.escape(program)}\b", text), f"line {block.line}: {path} runs no {program}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_what_is_run_nowhere_is_of_programs_that_no_test_machine_has(page: Path) -> None:
    for block in blocks(page.read_text()):
        if block.says("nowhere") is not None:
            assert programs(block) <= NOT_ON_TEST_MACHINES, f"line {block.line}"


def files(path: Path) -> list[Path]:
    return [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]


def scripts(block: Block) -> set[str]:
    """Give the scripts of the project that a block names."""
    return {Path(word).name for word in block.text.split() if re.fullmatch(r"deploy/[\w/]+\.sh", word)}


def programs(block: Block) -> set[str]:
    if block.language not in TYPED:
        return set()
    commands = (
        [command for command, _ in exchanges(block.text)]
        if block.language == "console"
        else block.text.replace("\\\n", " ").splitlines()
    )
    words = [command.split() for line in commands for command in line.split(" && ")]
    return {word[1] if word[0] == "sudo" else word[0] for word in words if word and not word[0].startswith("#")} - {
        *NOT_PROGRAMS
    }


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_extra_that_a_page_names_exists_and_is_installed_from_the_checkout(page: Path) -> None:
    text = page.read_text()
    assert "install 'zbridge[" not in text
    for extras in re.findall(r"'[^' ]*\.\[([a-z0-9,]+)\]'", text):
        assert set(extras.split(",")) <= set(EXTRAS), extras


# The judge itself


def test_numbers_ids_and_times_may_differ_and_words_may_not() -> None:
    shown = "r1  established  up 3.2 h, process 12, id 0123456789abcdef"
    assert difference(shown, "r1   established up 7.0 h, process 4711, id fedcba9876543210\n") is None
    assert difference(shown, shown.replace("established", "offline")) is not None


def test_dots_stand_for_any_lines_and_not_for_a_missing_one() -> None:
    assert difference("one\n...\nfour", "one\ntwo\nthree\nfour") is None
    assert difference("one\n...\nfour", "one\nfour") is None
    assert difference("one\n...\nfour", "one\ntwo") is not None


def test_a_block_is_read_with_what_stands_above_it() -> None:
    text = '<!-- run: background until listening -->\n```sh\nsleep 1\n```\n\n```toml title="a.toml"\na = 1\n```\n'
    first, second = blocks(text)
    assert first == Block(2, "sh", None, "sleep 1\n", (("background", "until listening"),))
    assert (second.title, second.text) == ("a.toml", "a = 1\n")
    assert list(exchanges("$ a \\\n> b\nout\n$ c\n")) == [("a \\\nb", "out"), ("c", "")]
