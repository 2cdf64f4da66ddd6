"""A link without a socket, for tests: keeps what was written, and the test plays the peer."""

from __future__ import annotations

from collections.abc import Callable

from zbridge.protocol.kept import Exported
from zbridge.transport.transferable import Parcel


class FakeLink:
    """A link without a socket: keeps what was written, and the test plays the peer."""

    def __init__(self, peer: str = "tcp://robot.test:1") -> None:
        self.peer = peer
        self.reads: Callable[[], object] = lambda: None
        self.descriptors: tuple[int, ...] = ()
        self.ready = True
        self.silent_s = 0.0
        self.unacknowledged_s = 0.0
        self.written: list[bytes] = []
        self.datagrams: list[bytes] = []
        self.sources_dropped = 0
        self.paused = False
        self.suspended = False
        self.closed = False

    def write(self, data: bytes) -> None:
        """Keep ``data``."""
        self.written.append(data)

    def write_datagram(self, data: bytes) -> None:
        """Keep ``data``."""
        self.datagrams.append(data)

    def drop_source(self) -> None:
        """Note the call."""
        self.sources_dropped += 1

    def pause_reading(self) -> None:
        """Note the call."""
        self.paused = True

    def resume_reading(self) -> None:
        """Note the call."""
        self.paused = False

    blocker: str | None = None

    def suspend(self) -> None:
        """Note the call."""
        self.suspended = True

    def resume(self) -> None:
        """Note the call."""
        self.suspended = False

    def export(self, parcel: Parcel) -> Exported:
        """Have nothing to hand over."""
        return {}

    def detach(self) -> None:
        """Note the call."""
        self.closed = True

    def close(self) -> None:
        """Note the call."""
        self.closed = True

    def abort(self) -> None:
        """Note the call."""
        self.closed = True

    async def ended(self) -> None:
        """Return at once."""
