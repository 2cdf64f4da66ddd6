"""Badges of the README, from what ``pyproject.toml`` declares: true for this checkout, and fetched from nowhere."""

from __future__ import annotations

import tomllib
from pathlib import Path
from xml.sax.saxutils import escape

FOLDER = Path(__file__).parents[1] / "images" / "badges"
PROJECT = Path(__file__).parents[2] / "pyproject.toml"
LETTER, HEIGHT = 6.6, 20


def badge(label: str, value: str) -> str:
    """Return the file of one badge: a label, and its value on blue."""
    left, right = (round(len(text) * LETTER + 14) for text in (label, value))
    title = f"{escape(label)}: {escape(value)}"
    texts = "".join(
        f'<text x="{x}" y="14" textLength="{round(len(text) * LETTER)}">{escape(text)}</text>'
        for x, text in ((7, label), (left + 7, value))
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{left + right}" height="{HEIGHT}" role="img">'
        f"<title>{title}</title>"
        f'<rect width="{left + right}" height="{HEIGHT}" rx="3" fill="#424a53"/>'
        f'<path d="M{left} 0h{right - 3}a3 3 0 0 1 3 3v{HEIGHT - 6}a3 3 0 0 1-3 3H{left}z" fill="#1f5fa8"/>'
        f'<g fill="#fff" font-family="DejaVu Sans, Verdana, sans-serif" font-size="11">{texts}</g></svg>\n'
    )


def badges() -> dict[str, str]:
    """Return every badge by the name of its file."""
    project = tomllib.loads(PROJECT.read_text())["project"]
    prefix = "Programming Language :: Python :: 3."
    pythons = [f"3.{each.removeprefix(prefix)}" for each in project["classifiers"] if each.startswith(prefix)]
    return {
        "version": badge("version", project["version"]),
        "python": badge("Python", " | ".join(pythons)),
        "licence": badge("licence", project["license"]),
    }
