"""Raw frames of a recording as conversations."""

from __future__ import annotations

from pathlib import Path

from tests.views.recording import files
from zbridge.fleet.topics import KeySpace
from zbridge.views.recording.reader import RecordingReader
from zbridge.views.recording.wire_tape import HANDSHAKE_S, steps, wire_links

KEYS = KeySpace("fleet", "r1")
IN, OUT, STATUS = "fleet/r1/@wire/robot/in", "fleet/r1/@wire/robot/out", "fleet/r1/status"


def state(name: str) -> bytes:
    return files.packed(state=name, links=[{"name": "robot", "state": name, "peer": "p"}])


def test_a_frame_knows_when_it_went_and_what_the_gateway_had_said(tmp_path: Path) -> None:
    late = HANDSHAKE_S + 1
    messages = [
        (IN, 0.0, b"a"),
        (OUT, 0.1, b"123"),
        (IN + "#datagram", 0.2, b"b"),
        ("fleet/r2/@wire/robot/in", 0.3, b"z"),
        (IN, late, b"c"),
    ]
    with files.written(tmp_path / "a.mcap", messages).open("rb") as file:
        read = list(steps(RecordingReader(file).messages(), KEYS, "robot"))
    assert [(step.frame, round(step.at_s, 3), step.received, step.datagram, step.answers) for step in read] == [
        (b"a", 0.0, 0, False, True),
        (b"b", 0.2, 3, True, True),
        (b"c", late, 3, False, False),
    ]


def test_a_conversation_ends_where_the_link_is_no_longer_offline(tmp_path: Path) -> None:
    messages = [
        (STATUS, 0.0, state("offline")),
        (STATUS, 0.1, state("connecting")),
        (OUT, 0.2, b"12"),
        (IN, 0.3, b"a"),
        (STATUS, 0.4, state("established")),
        (IN, 0.5, b"b"),
        (STATUS, 0.6, state("offline")),
        (IN, 0.7, b"c"),  # states overtake frames
        (STATUS, 1.0, state("handshaking")),
        (IN, 1.5, b"d"),
    ]
    with files.written(tmp_path / "a.mcap", messages).open("rb") as file:
        read = list(steps(RecordingReader(file).messages(), KEYS, "robot"))
    assert [(step.number, step.frame, step.received) for step in read] == [
        (1, b"a", 2),
        (1, b"b", 2),
        (1, b"c", 2),
        (2, b"d", 0),
    ]


def test_the_links_of_a_robot_are_named_by_their_frames() -> None:
    keys = [IN, OUT, "fleet/r1/@wire/laser/in", "fleet/r2/@wire/other/in", "fleet/r1/pose"]
    assert wire_links(KEYS, keys) == ["laser", "robot"]
