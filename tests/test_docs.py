"""What the pages name exists: links, files, modules, commands with their options."""

import contextlib
import pkgutil
import re
from functools import cache
from pathlib import Path

import pytest
import typer.main
from typer.core import TyperGroup

from docs.generate.events import log_calls
from zbridge.cli.app import app

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    page
    for pattern in ("*.md", "docs/**/*.md", "deploy/**/*.md")
    for page in ROOT.glob(pattern)
    if not {"node_modules", ".venv"} & set(page.parts)
)
HISTORY = ROOT / "CHANGELOG.md"  # names what is gone
PRESENT = [page for page in PAGES if page != HISTORY]

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
FILE = re.compile(r"(?<![\w/.-])(?:zbridge|gateways|tests|docs|deploy|\.ci)/[\w./<>*@-]*")
BARE_FILE = re.compile(r"(?<![\w/.*-])\w+\.(?:py|toml|md|hex)\b(?!\()")
MODULE = re.compile(r"(?<![\w./:@\"-])(?:zbridge|gateways|tests)(?:\.[A-Za-z_]\w*)+")
COMMAND = re.compile(r"(?:^|&& )zbridge ([a-z][a-z0-9-]*)(.*)", re.MULTILINE)
SPAN = re.compile(r"`([^`\n]+)`")
BLOCK = re.compile(r"^```\w*[^\n`]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TITLE = re.compile(r'^```\w* title="([^"]+)"', re.MULTILINE)

GROUPS = ("zbridge.protocols", "zbridge.service")
"""Dotted names that are no modules: the entry-point group, the unit of systemd."""
THEIRS = (
    *("users.toml", "hq.toml", "r1.toml", "r2.toml", "e1.toml", "host.toml", "router.toml", "roles.toml", "bus.toml"),
    *("pyproject.toml", "README.md", "CHANGELOG.md"),
)
"""Files that a reader writes, or that stand at the root of every package."""


@cache
def loggers() -> set[str]:
    return {call.logger for call in log_calls()}


def on_every_page(pages: list[Path]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("page", pages, ids=lambda page: str(page.relative_to(ROOT)))


def anchors(page: Path) -> set[str]:
    """Give the anchors of a page's headings, as they are made where the pages are shown."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).strip().replace(" ", "-") for title in titles}


@on_every_page(PAGES)
def test_every_link_leads_somewhere(page: Path) -> None:
    for target in LINK.findall(page.read_text()):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), target
        assert not anchor or anchor in anchors(there), target


@on_every_page(PRESENT)
def test_every_file_that_is_named_exists(page: Path) -> None:
    text = page.read_text()
    for name in FILE.findall(text):
        path = re.sub(r"<\w+>", "*", name).rstrip(".")
        assert any((*ROOT.glob(path), *ROOT.glob(f"docs/examples/*/{path}"))), name
    for name in BARE_FILE.findall("\n".join(SPAN.findall(BLOCK.sub("", text)))):
        found = (
            path for top in ("zbridge", "gateways", "tests", "docs", "deploy") for path in (ROOT / top).rglob(name)
        )
        assert name in (*THEIRS, *TITLE.findall(text)) or next(found, None), name


def test_the_page_of_the_architecture_names_every_room() -> None:
    rooms = {f"`{path.parent.relative_to(ROOT)}/`" for path in ROOT.glob("zbridge/*/__init__.py")}
    named = set(
        re.findall(
            r"^\| (`zbridge/\w+/`) \|", (ROOT / "docs" / "explanation" / "architecture.md").read_text(), re.MULTILINE
        )
    )
    assert named == rooms


@on_every_page(PRESENT)
def test_every_module_that_is_named_exists(page: Path) -> None:
    for name in MODULE.findall(page.read_text()):
        assert name in GROUPS or name in loggers() or is_there(name), name


def is_there(name: str) -> bool:
    """Tell whether a dotted name is a module, or something in one."""
    with contextlib.suppress(ImportError, AttributeError):
        return pkgutil.resolve_name(name) is not None
    return False


@on_every_page(PRESENT)
def test_every_command_that_is_named_exists_with_its_options(page: Path) -> None:
    commands = typer.main.get_group(app).commands
    text = page.read_text()
    for name, rest in COMMAND.findall("\n".join([*BLOCK.findall(text), *SPAN.findall(BLOCK.sub("", text))])):
        assert name in commands, f"zbridge {name}"
        command = commands[name]
        while isinstance(command, TyperGroup) and (sub := re.match(r" ([a-z]+)", rest)):
            assert sub[1] in command.commands, f"zbridge {name} {sub[1]}"
            command, rest = command.commands[sub[1]], rest[sub.end() :]
        known = {option for parameter in command.params for option in parameter.opts}
        unknown = set(re.findall(r"--[a-z-]+", rest.partition("#")[0].partition("&&")[0].partition("|")[0])) - known
        assert not unknown, f"zbridge {name} {rest}"
