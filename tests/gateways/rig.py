"""A listener of HQ programs without its sockets, two sessions without theirs, and a plan without its file."""

import random
from typing import Any

from zbridge.app import config
from zbridge.fleet.view import RobotView
from zbridge.protocol.plugin import Telemetry
from zbridge.protocol.session import Limits

LIMITS = Limits(frame_bytes=65536, handshake_s=5.0)


def drained(session: Any, now: float = 0.0) -> list[bytes]:
    """What a session may write now."""
    frames = []
    while (frame := session.outgoing(now)) is not None:
        frames.append(frame)
        assert len(frames) < 1000
    return frames


def exchange(sender: Any, receiver: Any, now: float, rng: random.Random) -> list[Any]:
    """Carry what one session may write now to another, cut anywhere."""
    data, messages = b"".join(drained(sender, now)), []
    while data:
        size = rng.choice((1, 1, 1, 2, 8, 30, 100, len(data)))
        messages += receiver.receive(data[:size], now)
        data = data[size:]
    return messages


class HqScene:
    """The HQ side of a protocol, what is known of its robot, and its clients."""

    def __init__(self, side: Any, view: RobotView) -> None:
        self.side, self.view = side, view
        self.clients: list[Any] = []

    def connect(self) -> Any:
        client = self.side.session(len(self.clients) + 1, LIMITS)
        client.open(0.0)
        self.side.begin(client, 0.0)
        self.clients.append(client)
        return client

    def send(self, send: Any) -> None:
        """Let the side send what it has for all clients, if anything."""
        for client in self.clients:
            if send is not None and not client.over:
                send(client, 0.0)

    def says(self, data: bytes, client: int = 0, now: float = 0.0) -> list[Telemetry]:
        """What comes of bytes of a client at once."""
        session = self.clients[client]
        return [told for message in session.receive(data, now) for told in self.side.take(session, message)]


def planned(protocol: str, links: int = 1, **options: Any) -> config.DevicePlan:
    addresses = [f"tcp://127.0.0.1:{27015 + number}" for number in range(links)]
    device = {"protocol": protocol, "connect": addresses, "options": options}
    plan = config.plan({"robot": {"name": "r1"}, "device": device})
    assert plan.device is not None
    return plan.device
