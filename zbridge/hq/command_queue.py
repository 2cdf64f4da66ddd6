"""Commands of one HQ program that need the lease, on their way to the bus: in order, bounded, never too late."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from zbridge.errors import BusError, Code, NotReady
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motor
from zbridge.fleet.topics import Topic
from zbridge.hq.context import Bridge
from zbridge.lease.lease_client import LeaseClient
from zbridge.log import Log

log = Log("zbridge.hq")

WAITING = 64
"""Commands of one client that may wait for the bus besides motion; one more is refused."""


class _Waiting(msgspec.Struct, frozen=True):
    """A command that waits, and the raw clock when its program gave it, ms."""

    topic: Topic
    message: FleetMessage
    given_ms: float


class CommandQueue:
    """Puts commands on the bus, dated. Each is numbered when it is put, so none may overtake another.

    See :class:`~zbridge.lease.commands.CommandPublishers`. What waits longer than its sender means it is dropped. late:
    called when the queue resumes; returns whether motion must not be sent any more.
    """

    def __init__(self, bridge: Bridge, lease: LeaseClient, *, who: str, late: Callable[[], bool]) -> None:
        self._bridge = bridge
        self._lease = lease
        self._who = who
        self._late = late
        self._waiting: list[_Waiting] = []
        self._writing = False
        self._light = False

    def __repr__(self) -> str:
        return f"<CommandQueue of {self._who}, {len(self._waiting)} waiting>"

    def send(self, topic: Topic, message: FleetMessage) -> None:
        """Put a command on the bus after those before it; raise NotReady if too many wait."""
        self._send(_Waiting(topic, message, self._lease.clock_ms()))

    def put(self, topic: Topic, message: FleetMessage) -> None:
        """Put a command on the bus now."""
        self._put(_Waiting(topic, message, self._lease.clock_ms()))

    def _send(self, command: _Waiting) -> None:
        if self._writing or not self._lease.held:
            self._keep(command)
        else:
            self._put(command)

    def _put(self, command: _Waiting) -> None:
        topic, message = command.topic, command.message
        if isinstance(message, Drive):
            message = self._lit(message)
        if self._bridge.put(topic, message, self._lease, command.given_ms):
            self._writing = True
            self._bridge.spawn(self._written())

    def wait(self, topic: Topic, message: FleetMessage) -> None:
        """Keep a command for later, of motion only the newest of each key; raise NotReady if too many wait."""
        self._keep(_Waiting(topic, message, self._lease.clock_ms()))

    def _keep(self, command: _Waiting) -> None:
        if isinstance(command.message, Drive | Motor):
            self._waiting = [entry for entry in self._waiting if entry.topic.path != command.topic.path]
        elif len(self._waiting) >= WAITING:
            raise NotReady(f"{WAITING} commands wait for the bus", Code.BUSY)
        self._waiting.append(command)

    def begin(self) -> list[_Waiting]:
        """Start a new lease: the light is unknown; return what waited for it."""
        self._light = False
        waiting, self._waiting = self._waiting, []
        return waiting

    def resume(self, waiting: list[_Waiting]) -> None:
        """Send what waited for the lease and is not late."""
        for command in waiting:
            if not self._overdue(command.message):
                self._send(command)

    def clear(self) -> None:
        """Drop what waits."""
        self._waiting.clear()

    async def _written(self) -> None:
        try:
            await self._bridge.bus.flush()
        except BusError as error:
            log.warning("commands_not_flushed", "{session}: {error}", session=self._who, error=error)
        self._writing = False
        while self._waiting and not self._writing and self._lease.held:
            command = self._waiting.pop(0)
            if not self._overdue(command.message):
                self._send(command)

    def _overdue(self, message: FleetMessage) -> bool:
        """Return whether this is motion that waited until neutral had to come first."""
        neutral = isinstance(message, Drive | Motor) and not message.moving
        return self._late() and not neutral and not isinstance(message, Mode)

    def _lit(self, message: Drive) -> Drive:
        """Leave the light out unless it changes: programs repeat it with every command."""
        if message.light is None:
            return message
        if message.light == self._light:
            return msgspec.structs.replace(message, light=None)
        self._light = message.light
        return message
