"""A program that speaks foxglove.sdk.v1 to our server, by the plain ``websockets`` library."""

from __future__ import annotations

import contextlib
import json
import struct
from collections.abc import Callable, Iterator
from typing import Any

from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from tests.e2e.conftest import until

SUBPROTOCOL = "foxglove.sdk.v1"
READ_S = 0.05
_AT_ONCE = 50
"""Messages that are taken before the test looks at them."""
TWIST = {"schemaName": "geometry_msgs/Twist", "encoding": "json"}


class Viewer:
    """One connection: what it was told, and what it was shown by topic."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, int] = {}
        self.told: list[dict[str, Any]] = []
        """Text messages but those about channels and services."""
        self.shown: dict[str, list[tuple[int, bytes]]] = {}
        """Times and payloads."""
        self.states: list[tuple[int, int, float, bool, str]] = []
        """Of a playback: status, time, speed, whether it was sought, id of the request."""
        self.times: list[int] = []
        self.answers: dict[int, bytes] = {}
        self._subscribed: dict[int, str] = {}

    def read(self) -> None:
        """Take what has come; raise ConnectionClosed."""
        with contextlib.suppress(TimeoutError):
            for _ in range(_AT_ONCE):
                message = self.socket.recv(READ_S)
                if isinstance(message, str):
                    self._take_text(json.loads(message))
                else:
                    self._take_binary(message)

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """Read until something is so; give its value."""

        def look() -> Any:
            self.read()
            return condition()

        return until(look, what=what)

    def warned(self, part: str) -> bool:
        return any(part in message.get("message", "") for message in self.told)

    def say(self, op: str, **fields: Any) -> None:
        self.socket.send(json.dumps({"op": op, **fields}))

    def subscribe(self, *topics: str) -> None:
        """Subscribe to channels, as soon as they are there."""
        self.until(lambda: set(topics) <= set(self.channels), f"the channels {topics}")
        new = [(len(self._subscribed) + number, topic) for number, topic in enumerate(topics)]
        self._subscribed.update(new)
        wishes = [{"id": number, "channelId": self.channels[topic]["id"]} for number, topic in new]
        self.say("subscribe", subscriptions=wishes)

    def publish_on(self, number: int, topic: str, **fields: Any) -> None:
        self.say("advertise", channels=[{"id": number, "topic": topic, **TWIST, **fields}])

    def publish(self, number: int, payload: bytes) -> None:
        self.socket.send(b"\x01" + struct.pack("<I", number) + payload)

    def twist(self, number: int, forward: float = 0.0, turn: float = 0.0) -> None:
        self.publish(number, json.dumps({"linear": {"x": forward}, "angular": {"z": turn}}).encode())

    def call(self, name: str, call_id: int, **fields: Any) -> None:
        self.until(lambda: name in self.services, f"the service {name}")
        head = struct.pack("<III", self.services[name], call_id, 4)
        self.socket.send(b"\x02" + head + b"json" + json.dumps(fields).encode())

    def play(self, *, play: bool = True, speed: float = 1.0, seek_ns: int | None = None, request: str = "") -> None:
        head = struct.pack("<BfBQI", not play, speed, seek_ns is not None, seek_ns or 0, len(request))
        self.socket.send(b"\x03" + head + request.encode())

    def _take_text(self, message: dict[str, Any]) -> None:
        match message["op"]:
            case "advertise":
                self.channels.update({channel["topic"]: channel for channel in message["channels"]})
            case "unadvertise":
                gone = set(message["channelIds"])
                self.channels = {name: channel for name, channel in self.channels.items() if channel["id"] not in gone}
            case "advertiseServices":
                self.services.update({service["name"]: service["id"] for service in message["services"]})
            case "unadvertiseServices":
                self.services = {name: n for name, n in self.services.items() if n not in message["serviceIds"]}
            case _:
                self.told.append(message)

    def _take_binary(self, message: bytes) -> None:
        match message[0]:
            case 1:
                number, at_ns = struct.unpack_from("<IQ", message, 1)
                self.shown.setdefault(self._subscribed[number], []).append((at_ns, message[13:]))
            case 2:
                self.times.append(struct.unpack_from("<Q", message, 1)[0])
            case 3:
                _, call_id, length = struct.unpack_from("<III", message, 1)
                self.answers[call_id] = message[13 + length :]
            case 5:
                status, at_ns, speed, sought, length = struct.unpack_from("<BQfBI", message, 1)
                self.states.append((status, at_ns, speed, bool(sought), message[19 : 19 + length].decode()))


@contextlib.contextmanager
def viewing(port: int, path: str = "/", scheme: str = "ws", **options: Any) -> Iterator[Viewer]:
    """Connect a viewer; raise InvalidStatus where it is turned away."""
    options = {"compression": None, "max_size": None, "close_timeout": 0.2, "open_timeout": 10, **options}
    with connect(f"{scheme}://127.0.0.1:{port}{path}", subprotocols=[Subprotocol(SUBPROTOCOL)], **options) as socket:
        yield Viewer(socket)
