"""Graphs: written as DOT, laid out by Graphviz, and framed as all diagrams are. Knows no zbridge."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence

from docs.diagrams.svg import Kind, svg

PADDING = 16
_HEAD = """\
digraph {
  graph [bgcolor=transparent, compound=true, fontname="Helvetica,Arial,sans-serif", fontsize=13, labeljust=l]
  node [shape=box, style=rounded, fontname="Helvetica,Arial,sans-serif", fontsize=13, margin="0.16,0.09"]
  edge [fontname="Helvetica,Arial,sans-serif", fontsize=11.5, arrowsize=0.7]
"""
_DROPPED = r'<!--.*?-->\n?|<title>.*?</title>\n?|<polygon fill="transparent"[^>]*/>\n| (?:fill|stroke|font-\w+)="[^"]*"'
"""Of what dot writes: comments, tool tips, the background, and looks that the style sheet gives."""


class Graph:
    """A directed graph. attributes: of the graph, for dot."""

    def __init__(self, title: str, description: str, attributes: str) -> None:
        self.title, self.description = title, description
        self.texts: list[str] = []
        """The lines of text that the diagram shows."""
        self._lines = [f"  graph [{attributes}]"]

    def node(self, name: str, lines: Sequence[str], kind: Kind, *, first: bool = False) -> None:
        """Add a node with centred lines. first: everything begins there."""
        self._lines.append(f'  "{name}" [class={kind}, penwidth={2.5 if first else 1}, label={self._label(lines)}]')

    def cluster(self, label: str, members: Sequence[str], *, below: bool) -> None:
        """Put nodes into a frame. below: the label is at the bottom."""
        look = f"class=frame; style=rounded; labelloc={'b' if below else 't'}; label={self._label([label])}"
        nodes = " ".join(f'"{member}";' for member in members)
        self._lines.append(f'  subgraph "cluster {label}" {{ {look}; {nodes} }}')

    def edge(self, tail: str, head: str, lines: Sequence[str], frame: str = "", *, orders: bool = True) -> None:
        """Add an edge. frame: the label of the one around the tail that it begins at. orders: it affects the ranks."""
        more = (f', ltail="cluster {frame}"' if frame else "") + ("" if orders else ", constraint=false")
        self._lines.append(f'  "{tail}" -> "{head}" [label={self._label(lines)}{more}]')

    @property
    def source(self) -> str:
        """The DOT text."""
        return _HEAD + "\n".join(self._lines) + "\n}\n"

    def svg(self) -> str:
        """Lay the graph out, and return the file; needs ``dot``."""
        drawn = subprocess.run(["dot", "-Tsvg"], input=self.source, capture_output=True, text=True, check=True).stdout
        width, height = (float(size) + 2 * PADDING for size in re.findall(r'(?:width|height)="([\d.]+)pt"', drawn)[:2])
        body = re.sub(_DROPPED, "", drawn[drawn.index("<g ") : drawn.index("</svg>")], flags=re.DOTALL)
        edges = re.compile(r'<g id="edge.*?</g>', re.DOTALL)
        body = edges.sub(lambda edge: edge[0].replace("<text", '<text class="small"'), body)
        body = f'<g transform="translate({PADDING} {PADDING})">\n{body}</g>\n'
        return svg(self.title, self.description, self.source, width, height, body)

    def _label(self, lines: Sequence[str]) -> str:
        """Return a label; the spaces keep arrows away from its words."""
        self.texts += lines
        return '"' + "\\n".join(f" {line} " for line in lines) + '"'
