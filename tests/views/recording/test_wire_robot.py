"""The robot of a recording on a real socket: its frames, and what it says of a gateway that answers or does not."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.views.recording import files
from zbridge.fleet.topics import KeySpace
from zbridge.protocol.address import Address
from zbridge.views.recording import wire_robot
from zbridge.views.recording.wire_robot import WireLink

IN, OUT = "fleet/r1/@wire/robot/in", "fleet/r1/@wire/robot/out"
MESSAGES = [(IN, 0.0, b"hello"), (OUT, 0.1, b"123"), (IN, 0.2, b"news")]


@pytest.mark.parametrize(("answer", "unanswered"), [(b"abc", 0), (b"ab", 1)])
async def test_each_frame_is_played_and_a_gateway_that_says_less_than_the_recorded_one_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: bytes, unanswered: int
) -> None:
    monkeypatch.setattr(wire_robot, "ANSWER_S", 0.2)
    monkeypatch.setattr(wire_robot, "LINGER_S", 0.05)
    reports: list[str] = []
    ready: asyncio.Future[Address] = asyncio.get_running_loop().create_future()
    recording = files.written(tmp_path / "a.mcap", MESSAGES)
    link = WireLink(recording, KeySpace("fleet", "r1"), "robot", 10.0, reports.append)
    playing = asyncio.ensure_future(link.run(Address("127.0.0.1", 0), ready.set_result))
    reader, writer = await asyncio.open_connection("127.0.0.1", (await ready).port)
    assert await reader.readexactly(5) == b"hello"
    writer.write(answer)
    assert await reader.read() == b"news"
    await playing
    writer.close()
    assert (link.frames, link.unanswered) == (2, unanswered)
    assert reports == ["robot: the gateway connected from 127.0.0.1"]
