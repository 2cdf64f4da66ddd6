"""``python -m docs.diagrams`` writes the diagrams whose sources have changed; ``--all``: every one.

To be run in the root of a checkout. Graphs need Graphviz (``dot``). ``tests/docs/test_diagrams.py`` compares the files
with the code, and needs neither dot nor fonts.
"""

import sys
from pathlib import Path

from docs.diagrams import badges
from docs.diagrams.bus import architecture, drive, roles
from docs.diagrams.dot import Graph
from docs.diagrams.lease import lease
from docs.diagrams.machines import MACHINES, draw
from docs.diagrams.processes import crash, restart
from docs.diagrams.svg import Picture, source_in

FOLDER = Path(__file__).parents[1] / "images" / "diagrams"
GALLERY: dict[str, Graph | Picture] = {
    each.__name__: each() for each in (architecture, crash, drive, lease, restart, roles)
}
GALLERY |= {name: draw(machine) for name, machine in MACHINES.items()}
"""All diagrams, by the names of their files."""

if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    badges.FOLDER.mkdir(exist_ok=True)
    for name, text in badges.badges().items():
        (badges.FOLDER / f"{name}.svg").write_text(text)
    for name, drawing in GALLERY.items():
        path = FOLDER / f"{name}.svg"
        if "--all" in sys.argv or not path.exists() or source_in(path.read_text()) != drawing.source:
            path.write_text(drawing.svg())
