"""A link without a socket, for tests: keeps what was written, and the test plays the peer."""

from __future__ import annotations

from zbridge.protocol.kept import Exported
from zbridge.transport.link import Link, Receiver
from zbridge.transport.transferable import Parcel


class FakeLink(Link):
    """A link without a socket: keeps what was written, and the test plays the peer."""

    descriptors: tuple[int, ...] = ()
    ready = True
    silent_s = 0.0
    unacknowledged_s = 0.0
    blocker: str | None = None

    def __init__(self, peer: str = "tcp://robot.test:1", receiver: Receiver | None = None) -> None:
        super().__init__(receiver or Receiver())
        self.peer = peer
        self.written: list[bytes] = []
        self.datagrams: list[bytes] = []
        self.sources_dropped = 0
        self.paused = False
        self.suspended = False
        self.closed = False

    def write(self, data: bytes) -> None:
        self.written.append(data)

    def write_datagram(self, data: bytes) -> None:
        self.datagrams.append(data)

    def drop_source(self) -> None:
        self.sources_dropped += 1

    def pause_reading(self) -> None:
        self.paused = True

    def resume_reading(self) -> None:
        self.paused = False

    def suspend(self) -> None:
        self.suspended = True

    def resume(self) -> None:
        self.suspended = False

    def export(self, parcel: Parcel) -> Exported:
        return {}

    def close(self) -> None:
        self.closed = True

    def abort(self) -> None:
        self.closed = True
