"""The gateway that comes: takes everything over, reports that it is up, and begins when the other one has let go.

Until then nothing is read from a socket or written to one, whatever happens: a failure ends this process, and the other
one continues. Where the other one dies once everything was handed over, this one begins: nobody else has the sockets.
With a supervisor this one ends instead: the supervisor has the sockets too, stops the robot over them, and starts
another one.
"""

from __future__ import annotations

import asyncio
import logging
import socket

from zbridge.app.handover.channel import VERSION, EndError, Failed, Go, HandoverState, Hello, Up
from zbridge.app.handover.processes import PROCESSES, Processes
from zbridge.errors import HandoverError
from zbridge.protocol.kept import Exported
from zbridge.transport import Parcel

log = logging.getLogger("zbridge.app.handover")

STATE_S = 60.0
"""Longest wait for the state, while the other process stops its robot."""
PARCEL_S = 5.0
GO_S = 30.0
"""Longest wait for :class:`Go`; the other process needs milliseconds, or gives up."""


class Incoming:
    """What comes by the channel. ``setup``: what must be the same in both configurations, by key.

    ``supervised``: a supervisor stops the robot if the other process dies. ``processes``: of this machine, or
    simulated ones.
    """

    def __init__(
        self, end: socket.socket, setup: Exported, *, supervised: bool = False, processes: Processes = PROCESSES
    ) -> None:
        self.state: HandoverState
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

    async def receive(self) -> HandoverState:
        """Send hello, wait for the state and its descriptors; raise HandoverError."""
        await self._channel.send(Hello(VERSION, self._own_pid))
        state = await self._channel.receive(HandoverState, STATE_S)
        if state.version != VERSION:
            raise HandoverError(f"a state of version {state.version}: this zbridge takes {VERSION}")
        for key in sorted({*self._setup, *state.setup}):
            if state.setup.get(key) != self._setup.get(key):
                raise HandoverError(f"{key} was changed: that needs a stop and a start")
        self.parcel = await self._channel.receive_parcel(state.descriptors, PARCEL_S)
        self.state = state
        self._missing = (state.device is not None) + len(state.listeners)
        return state

    async def part_taken_over(self) -> None:
        """Note that one part was taken over; wait until all are, and the other process has let go."""
        self._missing -= 1
        if self._missing <= 0:
            await self.finish()
        await self.begun.wait()

    async def finish(self) -> None:
        """Report that everything is up, and wait for :class:`Go`."""
        await self._channel.send(Up())
        try:
            await self._channel.receive(Go, GO_S)
        except EndError as error:
            if self._supervised:
                raise HandoverError("the gateway before this one has died: the supervisor stops its robot") from error
            log.warning("the gateway before this one has died: continuing in its place")
        self._channel.close()
        self.begun.set()

    def fail(self, reason: str) -> None:
        """Report to the other process why this one ends."""
        self._channel.send_now(Failed(reason))
        self._channel.close()
