"""The blocks of a page: what it tells to type, the files it shows, and what a run of it must know.

A comment between the block before and this one says how it is run:

``<!-- run: background -->``, ``background until TEXT``: its last command runs until the page ends; it is ready when
TEXT is in its output. ``setup COMMAND``, ``setup COMMAND until TEXT``: a hidden command in the background before it.
``keys w w space x``: on a terminal, with these keys. ``elsewhere PATH: reason``: by another file of the project.
``nowhere REASON``: it needs programs that no test machine has.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    page
    for pattern in ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "deploy/**/*.md")
    for page in ROOT.glob(pattern)
)
TYPED = ("sh", "console")
LISTED = ("toml", "python", "yaml", "ini", "json5", "json")
SHOWN = ("text",)

_BLOCK = re.compile(
    r"^(?P<indent> *)```(?P<language>\w*)(?P<info>[^\n`]*)\n(?P<text>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)
_RUN = re.compile(r"<!-- run: (\w+)(?: (.*?))? ?-->")
_TITLE = re.compile(r'title="([^"]+)"')


@dataclass(frozen=True)
class Block:
    """One fenced block. line: of its fence. how: what stands above it, ``(word, argument)``."""

    line: int
    language: str
    title: str | None
    text: str
    how: tuple[tuple[str, str], ...] = ()

    def says(self, word: str) -> str | None:
        """Return the argument of a word above the block; None if the word is not there."""
        return dict(self.how).get(word)

    @property
    def not_here(self) -> bool:
        """Whether a run of the page leaves it out."""
        return self.says("elsewhere") is not None or self.says("nowhere") is not None


def blocks(page: str) -> Iterator[Block]:
    """Give the blocks of a page in their order."""
    end = 0
    for match in _BLOCK.finditer(page):
        above, end = page[end : match.start()], match.end()
        title = _TITLE.search(match["info"])
        indent = match["indent"]
        text = "".join(line.removeprefix(indent) for line in match["text"].splitlines(keepends=True))
        how = tuple((word, argument or "") for word, argument in _RUN.findall(above))
        line = page.count("\n", 0, match.start("language")) + 1
        yield Block(line, match["language"], title[1] if title else None, text, how)


def exchanges(console: str) -> Iterator[tuple[str, str]]:
    """Give each command of a ``console`` block with the output below it. A command goes on behind a backslash."""
    command: list[str] = []
    output: list[str] = []
    for line in console.splitlines():
        if line.startswith("$ "):
            if command:
                yield "\n".join(command), "\n".join(output)
            command, output = [line[2:]], []
        elif command and command[-1].endswith("\\") and not output:
            command.append(line.removeprefix("> "))
        else:
            output.append(line)
    if command:
        yield "\n".join(command), "\n".join(output)


# What differs from one run to the next

_MASKS = (
    (r"\b\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d)?(\.\d+)?)?( ?UTC|Z)?", "DATE"),
    (r"\b\d{8}T\d{6}Z", "DATE"),  # in the name of an incident
    (r"\b\d\d:\d\d(:\d\d)?(\.\d+)?\b", "TIME"),
    (r"\b[0-9a-f]{8,}\b|\b\d{10,}\b", "ID"),
    (r"\b(process|pid|PID) \d+", r"\1 N"),
    (r"(?<![\w.])-?\d+(\.\d+)? ?(ns|us|ms|s|min|h|days?|kB|MB|GB|M|%|Hz|/s)(?!\w)", "N"),
    (r"(?<![\w.])-?\d+\.\d+(e-?\d+)?(?![\w.])", "N"),
    (r"(?<=:)[1-9]\d{4}\b(?<!:1100\d)(?<!:1101\d)", "PORT"),
    (r"(?<=  )\d+(?=\s|$)", "N"),  # a cell of a table
    (r"\s+", " "),
)


def masked(text: str) -> str:
    """Write a line without what differs from one run to the next: times, sizes, fractions, ids, ephemeral ports."""
    for pattern, name in _MASKS:
        text = re.sub(pattern, name, text)
    return text.strip()


def difference(shown: str, came: str) -> str | None:
    """Tell how the output that a page shows differs from what came; None if it does not. ``...`` is any lines."""
    parts = [r"(?:.*\n)*?" if line == "..." else re.escape(masked(line)) + r"\n" for line in shown.strip().splitlines()]
    lines = "".join(f"{masked(line)}\n" for line in came.strip().splitlines())
    if re.fullmatch("".join(parts), lines):
        return None
    return f"-- the page shows:\n{shown.strip()}\n-- came:\n{came.strip()}"
