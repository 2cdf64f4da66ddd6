"""Raw frames for those who listen: from the first frame on, in order, also where the listener came late."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from zbridge.protocol.session import State
from zbridge.robot import wire_tap
from zbridge.robot.wire_tap import FIRST, KEPT, SETTLE_S, WireTap


class Session:
    """A session as far as a tap sees it."""

    def __init__(self, state: State = State.HANDSHAKING) -> None:
        self.state = state
        self.tap: Any = None


class Scene:
    def __init__(self, state: State = State.HANDSHAKING) -> None:
        self.tap = WireTap("r1 robot")
        self.session: Any = Session(state)
        self.tap.begin(self.session)
        self.seen: list[tuple[str, bytes]] = []

    def says(self, *frames: bytes) -> None:
        for frame in frames:
            if self.session.tap is not None:
                self.session.tap("out" if frame.isupper() else "in", frame)

    async def listen(self, *directions: str) -> None:
        for direction in directions:
            self.tap.watch(direction, lambda frame, direction=direction: self.seen.append((direction, frame)))
        await asyncio.sleep(2 * SETTLE_S)

    @property
    def frames(self) -> list[bytes]:
        return [frame for _, frame in self.seen]


@pytest.mark.jumping
async def test_a_late_listener_is_shown_the_handshake_first_and_then_what_comes() -> None:
    scene = Scene()
    scene.says(b"a", b"B", b"c")
    listening = asyncio.ensure_future(scene.listen("in", "out"))
    await asyncio.sleep(SETTLE_S / 2)
    scene.says(b"D")
    await listening
    scene.says(b"e")
    assert scene.seen == [("in", b"a"), ("out", b"B"), ("in", b"c"), ("out", b"D"), ("in", b"e")]


@pytest.mark.jumping
async def test_a_direction_whose_listener_is_heard_of_much_later_misses_nothing_and_repeats_nothing() -> None:
    scene = Scene()
    scene.says(b"a", b"B", b"c")
    await scene.listen("out")
    scene.says(b"D", b"e")
    await scene.listen("in")
    scene.says(b"F", b"g")
    assert scene.frames == [b"B", b"D", b"a", b"c", b"e", b"F", b"g"]


@pytest.mark.jumping
async def test_of_a_conversation_without_a_handshake_the_first_frames_are_kept() -> None:
    scene = Scene(State.ESTABLISHED)
    frames = [b"%d" % number for number in range(FIRST + 5)]
    scene.says(*frames)
    await scene.listen("in")
    assert scene.frames == frames[:FIRST]


@pytest.mark.jumping
async def test_what_is_kept_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    scene.says(*[b"x"] * 1000)
    await scene.listen("in")
    assert len(scene.frames) == KEPT
    monkeypatch.setattr(wire_tap, "KEPT_BYTES", 100)
    scene = Scene()
    scene.says(*[bytes(60)] * 10)
    await scene.listen("in")
    assert len(scene.frames) == 2


@pytest.mark.jumping
async def test_nobody_is_called_while_nobody_listens() -> None:
    scene = Scene(State.ESTABLISHED)
    scene.says(*[b"x"] * (FIRST + 1))
    assert scene.session.tap is None
    await scene.listen("in")
    scene.tap.watch("in", None)
    scene.says(b"y", b"z")
    assert scene.session.tap is None
    assert b"y" not in scene.frames


@pytest.mark.jumping
async def test_a_new_conversation_begins_anew() -> None:
    scene = Scene()
    scene.says(b"old")
    scene.session = Session()
    scene.tap.begin(scene.session)
    scene.says(b"new")
    await scene.listen("in")
    assert scene.frames == [b"new"]
