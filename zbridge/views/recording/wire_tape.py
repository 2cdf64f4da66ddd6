"""The raw frames of one link of a recorded robot, as its conversations: what it sent, and what it was sent. Sans-IO.

Theory of operation. A conversation begins with the first frame after the robot's status showed the link as no longer
offline. (``status`` overtakes frames: the last frames of a conversation may come after it.) At its begin the two sides
answer each other: for :data:`HANDSHAKE_S` a frame of the robot's waits for what the gateway had said before it. From
then on only the time counts. A recording that began later has the handshake, too, all at one time.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator

import msgspec

from zbridge.errors import PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Status
from zbridge.fleet.topics import KeySpace
from zbridge.views.recording.reader import RecordedMessage

HANDSHAKE_S = 5.0
"""For so long the begin of a conversation lasts."""


class WireStep(msgspec.Struct, frozen=True):
    """A frame of the robot's. at_s: since its conversation began. received: bytes that the gateway had sent before.

    number: of its conversation, from 1. answers: whether it must wait for what the gateway had sent before.
    """

    number: int
    at_s: float
    frame: bytes
    datagram: bool
    received: int
    answers: bool


def wire_links(keys: KeySpace, topics_seen: Iterable[str]) -> list[str]:
    """Return the names of the links whose frames were recorded."""
    prefix = keys.key("@wire/")
    return sorted({topic[len(prefix) :].partition("/")[0] for topic in topics_seen if topic.startswith(prefix)})


def steps(messages: Iterable[RecordedMessage], keys: KeySpace, link: str) -> Iterator[WireStep]:
    """Yield what one link of the robot sent."""
    incoming, outgoing = keys.key(f"@wire/{link}/in"), keys.key(f"@wire/{link}/out")
    status = keys.key(topics.STATUS.path)
    number, began_ns, received, fresh, offline = 0, 0, 0, True, False
    for message in messages:
        topic = message.channel.topic
        if topic == status:
            state = _state(message.data, link)
            fresh = fresh or (offline and state != "offline")
            offline = state == "offline"
        elif topic in (incoming, outgoing):
            if fresh:
                number, began_ns, received, fresh = number + 1, message.log_ns, 0, False
            at_s = max(0.0, (message.log_ns - began_ns) / 1e9)
            if topic == outgoing:
                received += len(message.data)
            else:
                yield WireStep(number, at_s, message.data, message.channel.datagram, received, at_s < HANDSHAKE_S)


def _state(payload: bytes, link: str) -> str | None:
    with contextlib.suppress(PayloadError):
        return next((entry.state for entry in payloads.decode(Status, payload).links if entry.name == link), None)
    return None
