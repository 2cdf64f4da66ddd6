"""Writes SVG: the frame that all diagrams share, and pictures whose layout is given. Knows no zbridge.

A diagram is a card with its own background, legible on any page, and follows the reader's light or dark scheme. Its
file contains its source (of a graph the DOT text; of a picture its elements) and no path, date or version.
"""

from __future__ import annotations

from typing import Literal
from xml.etree import ElementTree
from xml.sax.saxutils import escape

Kind = Literal["plain", "robot", "gateway", "bus", "program", "stop", "neutral", "frame", "grid", ""]

Point = tuple[float, float]
NAMESPACE = "{http://www.w3.org/2000/svg}"
LINE = 16
"""Distance of two lines of text."""
_COLOURS = {
    "plain": ("#f6f8fa", "#6e7781", "#21262d", "#8b949e"),
    "robot": ("#e3f4e8", "#2d7d46", "#16331f", "#57ab72"),
    "gateway": ("#e2eefc", "#2563b0", "#15294a", "#6aa5ea"),
    "bus": ("#efe7fb", "#7548b8", "#2c1d4a", "#a98ae0"),
    "program": ("#fdf1d8", "#96690b", "#3a2c0c", "#d0a03c"),
    "stop": ("#fde8e6", "#c0352b", "#471a17", "#f0776c"),
    "neutral": ("#e9ebee", "#8c959f", "#30363d", "#8b949e"),
    "frame": ("none", "#8c959f", "none", "#8b949e"),
    "grid": ("none", "#d0d7de", "none", "#30363d"),
}
"""Of each kind: fill and stroke in the light scheme, fill and stroke in the dark one."""
_PAPER, _INK, _SMALL = ("#ffffff", "#0d1117"), ("#1f2328", "#e6edf3"), ("#59636e", "#9da7b3")
"""Background, text, and small text and lines, light and dark."""


def svg(title: str, description: str, source: str, width: float, height: float, body: str) -> str:
    """Return the file of a diagram. source: of a graph; empty where the body is the source."""
    size = f'width="{width:g}" height="{height:g}" viewBox="0 0 {width:g} {height:g}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-labelledby="title desc">\n'
        f'<title id="title">{escape(title)}</title>\n<desc id="desc">{escape(description)}</desc>\n'
        + (f"<metadata>{escape(source)}</metadata>\n" if source else "")
        + "<style>\ntext{font-family:Helvetica,Arial,'Liberation Sans',sans-serif;font-size:13px}\n"
        + f".small{{font-size:11.5px}}.bold{{font-weight:bold}}\n{_rules(body, 0)}"
        + f"@media (prefers-color-scheme:dark){{\n{_rules(body, 1)}}}\n</style>\n"
        f'<rect class="card" x="0.5" y="0.5" width="{width - 1:g}" height="{height - 1:g}" rx="8"/>\n{body}</svg>\n'
    )


def source_in(file: str) -> str:
    """Return the source of a diagram from its file: of a graph its DOT text, else the file itself."""
    return ElementTree.fromstring(file).findtext(f"{NAMESPACE}metadata") or file


def texts_in(file: str) -> list[str]:
    """Return the lines of text that a diagram shows."""
    return ["".join(text.itertext()).strip() for text in ElementTree.fromstring(file).iter(f"{NAMESPACE}text")]


def _rules(body: str, dark: int) -> str:
    """Return the rules of one scheme, for the kinds that occur."""
    small = _SMALL[dark]
    rules = [
        f".card{{fill:{_PAPER[dark]};stroke:{_COLOURS['grid'][2 * dark + 1]}}}",
        f"text{{fill:{_INK[dark]}}}.small{{fill:{small}}}.edge path,.line{{fill:none;stroke:{small}}}",
        f".edge polygon,.head{{fill:{small};stroke:{small}}}",
    ]
    for kind in (kind for kind in _COLOURS if f' {kind}"' in body):
        fill, stroke = _COLOURS[kind][2 * dark : 2 * dark + 2]
        rules.append(f".box.{kind},.node.{kind} path,.cluster.{kind} path{{fill:{fill};stroke:{stroke}}}")
        rules.append(f".line.{kind}{{stroke:{stroke}}}.head.{kind}{{fill:{stroke};stroke:{stroke}}}")
    return "".join(f"{rule}\n" for rule in rules)


class Picture:
    """A diagram whose author gives the layout, in pixels."""

    def __init__(self, title: str, description: str, width: float, height: float) -> None:
        self.title, self.description, self.width, self.height = title, description, width, height
        self.parts: list[str] = []
        """Elements; later ones are drawn over earlier ones."""

    @property
    def source(self) -> str:
        """What must be in the file: all of it."""
        return self.svg()

    def svg(self) -> str:
        """Return the file."""
        return svg(self.title, self.description, "", self.width, self.height, "".join(self.parts))

    def box(self, at: Point, size: Point, kind: Kind, *lines: str, first: str = "bold") -> None:
        """Draw a box with centred lines: the first one in the style ``first``, the others small."""
        (x, y), (width, height) = at, size
        place = f'x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="4"'
        self.parts.append(f'<rect class="box {kind}" {place}/>\n')
        top = y + height / 2 - (len(lines) - 1) * LINE / 2 + 4.5
        for number, line in enumerate(lines):
            self.text(x + width / 2, top + number * LINE, line, "small" if number else first, "middle")

    def text(self, x: float, y: float, text: str, style: str = "", anchor: str = "start") -> None:
        """Write one line. style: ``small``, ``bold`` or none."""
        look = f' class="{style}"' if style else ""
        self.parts.append(f'<text{look} x="{x:g}" y="{y:g}" text-anchor="{anchor}">{escape(text)}</text>\n')

    def line(self, start: Point, end: Point, kind: Kind = "", heads: int = 0, width: float = 1.4) -> None:
        """Draw a horizontal or vertical line. heads: 1: an arrow head at the end; 2: at both ends."""
        place = f'x1="{start[0]:g}" y1="{start[1]:g}" x2="{end[0]:g}" y2="{end[1]:g}"'
        self.parts.append(f'<line class="line {kind}" stroke-width="{width:g}" {place}/>\n')
        for (x, y), (from_x, from_y) in ((end, start), (start, end))[:heads]:
            dx, dy = (x > from_x) - (x < from_x), (y > from_y) - (y < from_y)
            sides = ((x - 8 * dx - 4 * dy * side, y - 8 * dy - 4 * dx * side) for side in (1, -1))
            points = " ".join(f"{px:g},{py:g}" for px, py in ((x, y), *sides))
            self.parts.append(f'<polygon class="head {kind}" points="{points}"/>\n')
