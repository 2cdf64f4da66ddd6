"""A recorded robot on the bus under another name. It is seen as a robot, and says that it is a recording.

Theory of operation. ``status`` has the protocol ``replay``; whatever wants to move it, or asks for its lease, is
refused with ``unsupported`` and shown on ``control``. Streams and states are published as they were, with new stamps;
``status`` and ``control`` are repeated once a second where the recording does not. Messages come from the player's
thread, everything else runs on the event loop. A query for map or pose is answered with the last one played.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from typing import Any

import msgspec

from zbridge.bus import Bus, Handle, IncomingQuery, PriorityClass, Publisher, ReadPayload, Sample
from zbridge.control.latch import STOPS, read_stop
from zbridge.control.requests import RefusalCounts
from zbridge.errors import NotReady, PayloadError, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, Query, Status
from zbridge.fleet.payload import with_stamp
from zbridge.fleet.topics import Delivery, KeySpace, Topic
from zbridge.protocol.rate_limit import RateLimit
from zbridge.views.recording.reader import RecordedMessage

PROTOCOL = "replay"
"""What ``status`` shows in place of the robot's protocol."""
REPEAT_S = 1.0
"""Seconds after which ``status`` and ``control`` are repeated."""
REFUSALS_HZ = 100.0
"""Commands a second that are refused with a word; those above are only counted."""
KEYS = 4096
"""Most keys that a replayed robot publishes."""
_CONTROL_S = 0.05
_REFUSED = Unsupported("a recording")
_LEASE = ("acquire/*", "takeover/*", "renew", "release", "unlatch/*", "unlatch_fleet/*")


class ReplayedRobot:
    """Publishes what a recording has of one robot. reason: shown by ``status``; status: shown until one is played."""

    def __init__(self, bus: Bus, keys: KeySpace, reason: str, status: Status | None = None) -> None:
        self.recorded_protocol: str | None = None
        """The robot's own protocol, as its last status said."""
        self._bus = bus
        self._keys = keys
        self._reason = reason
        self._publishers: dict[str, Publisher] = {}
        self._topics: dict[str, Topic | None] = {}
        self._last: dict[str, bytes] = {}
        """The last map and pose."""
        self._status = Status(state="established", protocol=PROTOCOL, reason=reason)
        self._control = Control(state="free")
        self._published_at: dict[str, float] = {}
        self._refusals = RefusalCounts()
        self._stops: deque[bytes] = deque(maxlen=STOPS)
        self._rate = RateLimit(REFUSALS_HZ)
        self._handles: list[Handle] = []
        self._repeating: asyncio.Task[None] | None = None
        self._control_due: asyncio.TimerHandle | None = None
        if status is not None:
            self._note_status(status)

    def __repr__(self) -> str:
        return f"<ReplayedRobot {self._keys.robot}>"

    def open(self) -> None:
        """Appear on the bus, and refuse commands from now on."""
        bus, key = self._bus, self._keys.key
        self._handles = [
            bus.subscribe(key("@cmd/**"), self._on_command, priority=self._admit),
            *(bus.answer(key(f"@rpc/control/{name}"), self._on_lease) for name in _LEASE),
            bus.answer(key("@rpc/control/refused/*"), lambda query: query.answer(payloads.encode(Query()))),
            *(bus.answer(key(topic.path), self._on_question) for topic in (topics.RPC_MAP, topics.RPC_POSE)),
        ]
        self._publish_status()
        self._publish_control()
        self._repeating = asyncio.get_running_loop().create_task(self._repeat())

    def close(self) -> None:
        """Leave the bus; idempotent."""
        if self._control_due is not None:
            self._control_due.cancel()
        if self._repeating is not None:
            self._repeating.cancel()
        handles, self._handles = self._handles, []
        publishers, self._publishers = self._publishers, {}
        for each in (*handles, *publishers.values()):
            each.close()

    # On the player's thread

    def play(self, path: str, message: RecordedMessage) -> bool:
        """Publish a message of the recording, whose key ends with ``path``; False: it is not published again."""
        topic = self._topic(path)
        if topic is None:
            return False
        now_ns = time.time_ns()
        payload = with_stamp(message.data, now_ns - max(0, message.log_ns - message.publish_ns))
        if topic is topics.STATUS or topic is topics.CONTROL:
            return self._play_state(topic, payload)
        if topic is topics.MAP or topic is topics.POSE:
            self._last[path] = payload
        self._put(topic, payload)
        return True

    def _play_state(self, topic: Topic, payload: bytes) -> bool:
        try:
            if topic is topics.STATUS:
                self._note_status(payloads.decode(Status, payload))
                self._publish_status()
            else:
                self._control = payloads.decode(Control, payload)
                self._publish_control()
        except PayloadError:
            return False
        return True

    def _note_status(self, status: Status) -> None:
        if status.protocol not in (None, PROTOCOL):
            self.recorded_protocol = status.protocol
        reason = f"{self._reason}; {status.reason}" if status.reason else self._reason
        self._status = msgspec.structs.replace(status, protocol=PROTOCOL, reason=reason)

    def _topic(self, path: str) -> Topic | None:
        """Return the topic of what is published of a path; None for commands, queries and what is not known."""
        if path not in self._topics and len(self._topics) < KEYS:
            topic = None if path.startswith("@") else topics.find(path)
            published = topic is not None and topic.delivery in (Delivery.STREAM, Delivery.STATE)
            self._topics[path] = topic if published else None
        return self._topics.get(path)

    def _put(self, topic: Topic, payload: bytes) -> None:
        publisher = self._publishers.get(topic.path)
        if publisher is None:
            publisher = self._publishers[topic.path] = self._bus.publisher(self._keys.key(topic.path), topic)
        if topic.delivery is Delivery.STREAM:
            self._bus.put_all([(publisher, [payload])])
        else:
            publisher.put(payload)

    # On the event loop, or the player's thread

    def _publish_status(self) -> None:
        self._publish(topics.STATUS, msgspec.structs.replace(self._status, stamp_ns=time.time_ns()))

    def _publish_control(self, **shown: Any) -> None:
        refusals = (*self._control.refusals, *self._refusals.shown())
        own = {"stamp_ns": time.time_ns(), "lease": None, "refusals": refusals, "stops": tuple(self._stops)}
        self._publish(topics.CONTROL, msgspec.structs.replace(self._control, **(own | shown)))

    def _publish(self, topic: Topic, message: FleetMessage) -> None:
        self._published_at[topic.path] = time.monotonic()
        self._put(topic, payloads.encode(message))

    async def _repeat(self) -> None:
        while True:
            await asyncio.sleep(REPEAT_S / 4)
            now = time.monotonic()
            for topic, publish in ((topics.STATUS, self._publish_status), (topics.CONTROL, self._publish_control)):
                if now - self._published_at[topic.path] > REPEAT_S * 1.2:
                    publish()

    # On the event loop

    def _admit(self, key: str, attachment: bytes | None, size: int, read_payload: ReadPayload) -> PriorityClass | None:
        return PriorityClass.OTHER if self._rate.take(time.monotonic()) else None

    def _on_command(self, sample: Sample) -> None:
        command = sample.key.rpartition("@cmd/")[2]
        if command == "stop" and isinstance(stop_id := read_stop(sample.payload).id, bytes):
            self._stops.append(stop_id)
        self._refuse(command)

    def _on_lease(self, query: IncomingQuery) -> None:
        query.refuse(_REFUSED)
        self._refuse(query.asked.rpartition("@rpc/control/")[2].partition("/")[0])

    def _on_question(self, query: IncomingQuery) -> None:
        payload = self._last.get(query.key.rpartition("@rpc/")[2])
        if payload is None:
            query.refuse(NotReady("a recording, which has shown none yet"))
        else:
            query.answer(payload)

    def _refuse(self, command: str) -> None:
        """Count a refusal, and show it soon. A refused stop is shown as such at once: a recording is stopped."""
        self._refusals.add(command, _REFUSED, None, None, 1)
        if command == "stop":
            self._publish_control(state="stopped", refusals=self._refusals.shown())
        if self._control_due is None:
            self._control_due = asyncio.get_running_loop().call_later(_CONTROL_S, self._show_refusals)

    def _show_refusals(self) -> None:
        self._control_due = None
        self._publish_control()
