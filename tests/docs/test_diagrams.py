"""The diagrams of the documentation show what the code does now. No test needs Graphviz or a font."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import pytest

from docs.diagrams.__main__ import FOLDER, GALLERY
from docs.diagrams.badges import FOLDER as BADGES
from docs.diagrams.badges import badges
from docs.diagrams.bus import RIGHTS, STEPS, may
from docs.diagrams.dot import Graph
from docs.diagrams.lease import LOST_DRIVER, SETTINGS, TAKEOVER, play
from docs.diagrams.machines import MACHINES, draw, state_lines, transitions
from docs.diagrams.svg import NAMESPACE, source_in, texts_in
from zbridge.errors import Code
from zbridge.security.access import GRANTS

ROOT = Path(__file__).parents[2]
UP_TO_DATE = "run: python -m docs.diagrams"
MOST_BYTES, MOST_WIDTH, MOST_LINES = 60_000, 900, 600
WRITERS = ("dot.py", "svg.py")
"""They know no zbridge, and draw for all."""

every_diagram = pytest.mark.parametrize("name", GALLERY)
every_machine = pytest.mark.parametrize("name", MACHINES)


def file(name: str) -> str:
    return (FOLDER / f"{name}.svg").read_text()


@every_diagram
def test_a_diagram_is_up_to_date(name: str) -> None:
    assert source_in(file(name)) == GALLERY[name].source, UP_TO_DATE


@pytest.mark.parametrize("name", badges())
def test_a_badge_says_what_the_project_declares(name: str) -> None:
    assert (BADGES / f"{name}.svg").read_text() == badges()[name], UP_TO_DATE


@every_diagram
def test_a_graph_shows_the_words_of_its_source(name: str) -> None:
    drawing = GALLERY[name]
    if isinstance(drawing, Graph):
        assert Counter(texts_in(file(name))) == Counter(drawing.texts), UP_TO_DATE


@every_diagram
def test_a_diagram_has_a_title_and_a_sentence_that_describes_it(name: str) -> None:
    root = ElementTree.fromstring(file(name))
    assert root.findtext(f"{NAMESPACE}title") == GALLERY[name].title
    assert root.findtext(f"{NAMESPACE}desc") == GALLERY[name].description
    assert GALLERY[name].description.endswith(".")


@every_diagram
def test_a_diagram_is_small_enough_for_a_page(name: str) -> None:
    root = ElementTree.fromstring(file(name))
    assert float(root.get("width", "")) <= MOST_WIDTH
    assert len(file(name)) < MOST_BYTES


@every_diagram
def test_a_diagram_fetches_nothing_and_names_no_machine(name: str) -> None:
    assert re.findall(r"href|url\(|@import|<script|<image|/tmp|/home|graphviz version", file(name)) == []


def test_there_is_no_file_without_a_source() -> None:
    assert {path.stem for path in FOLDER.glob("*.svg")} == set(GALLERY)


@every_machine
def test_every_state_of_a_table_is_in_its_diagram(name: str) -> None:
    shown = texts_in(file(name))
    assert [state for state in MACHINES[name].table if not set(state_lines(state)) <= set(shown)] == []


@every_machine
def test_every_input_that_leads_to_another_state_is_in_its_diagram(name: str) -> None:
    shown = " ".join(texts_in(file(name)))
    given = {each.value for inputs in transitions(MACHINES[name].table).values() for each in inputs}
    assert [words for words in given if words not in shown] == []


@every_machine
def test_a_changed_table_makes_its_diagram_out_of_date(name: str) -> None:
    machine = MACHINES[name]
    first, *_ = transitions(machine.table)
    fewer = {state: row if state is not first[0] else {} for state, row in machine.table.items()}
    assert draw(machine._replace(table=fewer)).source != source_in(file(name))


def test_the_codes_in_the_way_of_a_drive_are_those_that_a_drive_can_get() -> None:
    shown = {code for steps in STEPS.values() for step in steps for code in step.codes}
    assert set(Code) - shown == {Code.LATCHED, Code.BUSY}  # of an acquire, and of what is queued: no drive is


def test_the_lost_driver_is_stopped_by_the_deadman_and_the_lease_expires_later() -> None:
    holders, _, stops = play(LOST_DRIVER)
    assert stops == [(LOST_DRIVER[-1].at + SETTINGS.deadman_s, "deadman")]
    assert holders[-1] == (LOST_DRIVER[-1].at + SETTINGS.lease_s, "")


def test_a_takeover_and_a_stop_each_stop_the_robot_that_moves() -> None:
    _, _, stops = play(TAKEOVER)
    assert [reason for _, reason in stops] == ["taken over by bob", "stop"]


def test_every_role_is_shown_and_may_do_something() -> None:
    shown = texts_in(file("roles"))
    for role in GRANTS:
        assert role in shown
        assert any(all(may(role, *needed) for needed in right) for right in RIGHTS.values())


def test_the_sources_of_the_diagrams_stay_small() -> None:
    sources = [path for path in (ROOT / "docs" / "diagrams").glob("*.py") if path.name not in WRITERS]
    assert sum(len(path.read_text().splitlines()) for path in sources) < MOST_LINES
