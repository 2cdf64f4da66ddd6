"""The gateway that comes: takes everything over, says that it is up, and begins when the other one has let go.

Until then nothing is read from a socket or written to one, whatever happens: a failure ends this process, and the other
one goes on. Where the other one dies once everything was handed over, this one begins: nobody else has the sockets.
With a supervisor this one ends instead: the supervisor has the sockets too, stops the robot over them, and starts
another one.
"""

from __future__ import annotations

import asyncio
import logging
import socket

from zbridge.app.handover.channel import VERSION, EndError, Failed, Given, Go, Hello, Up
from zbridge.app.handover.processes import PROCESSES, Processes
from zbridge.errors import HandoverError
from zbridge.protocol.kept import Exported
from zbridge.transport import Parcel

log = logging.getLogger("zbridge.app.handover")

GIVEN_S = 60.0
"""Longest wait for the state, while the other process stops its robot."""
PARCEL_S = 5.0
GO_S = 30.0
"""Longest wait for the word to go; the other process needs milliseconds, or gives up."""


class Incoming:
    """What comes by the channel. ``setup``: what must be the same in both configurations, by key.

    ``supervised``: somebody looks after the robot if the other process dies. ``processes``: of this machine, or
    simulated ones.
    """

    def __init__(
        self, end: socket.socket, setup: Exported, *, supervised: bool = False, processes: Processes = PROCESSES
    ) -> None:
        self.given: Given
        self.parcel = Parcel()
        self.begun = asyncio.Event()
        """Set when the other process has let go."""
        self._channel = processes.channel(end)
        self._own_pid = processes.own_pid
        self._setup = setup
        self._supervised = supervised
        self._missing = 0

    def __repr__(self) -> str:
        return f"<Incoming {'begun' if self.begun.is_set() else f'waits for {self._missing} parts'}>"

    async def receive(self) -> Given:
        """Say hello, wait for the state and its descriptors; raise HandoverError."""
        await self._channel.send(Hello(VERSION, self._own_pid))
        given = await self._channel.receive(Given, GIVEN_S)
        if given.version != VERSION:
            raise HandoverError(f"a state of version {given.version}: this zbridge takes {VERSION}")
        for key in sorted({*self._setup, *given.setup}):
            if given.setup.get(key) != self._setup.get(key):
                raise HandoverError(f"{key} was changed: that needs a stop and a start")
        self.parcel = await self._channel.receive_parcel(given.descriptors, PARCEL_S)
        self.given = given
        self._missing = (given.device is not None) + len(given.listeners)
        return given

    async def taken(self) -> None:
        """Tell that one part was taken over; wait until all are, and the other process has let go."""
        self._missing -= 1
        if self._missing <= 0:
            await self.finish()
        await self.begun.wait()

    async def finish(self) -> None:
        """Say that everything is up, and wait for the word to go."""
        await self._channel.send(Up())
        try:
            await self._channel.receive(Go, GO_S)
        except EndError as error:
            if self._supervised:
                raise HandoverError(
                    "the gateway before this one has died: the supervisor looks after its robot"
                ) from error
            log.warning("the gateway before this one has died: going on in its place")
        self._channel.close()
        self.begun.set()

    def fail(self, reason: str) -> None:
        """Tell the other process why this one ends."""
        self._channel.say(Failed(reason))
        self._channel.close()
