"""Asks the other gateways of the realm which latched stops of the fleet are in force, at the start and after a cut."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import Callable

from zbridge.bus import Bus
from zbridge.control.enforcer import Enforcer
from zbridge.control.lease_server import LeaseServer
from zbridge.errors import BusError, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import FleetLatches
from zbridge.fleet.topics import KeySpace

ASK_S = 1.0
"""Longest wait for the answers; a lease is granted after it whoever answered."""
SPREAD_S = 1.0
"""After the bus has returned gateways ask within so many seconds, each at another moment."""
_WAITS = "querying the fleet's latched stops"


class FleetLatchNews:
    """What other gateways know of latched stops. No lease is granted before :meth:`run` has asked them.

    chance: between 0 and 1.
    """

    def __init__(
        self,
        bus: Bus,
        keys: KeySpace,
        enforcer: Enforcer,
        leases: LeaseServer,
        chance: Callable[[], float] = random.random,
    ) -> None:
        self._bus = bus
        self._everybody = KeySpace(keys.realm, "*").key(topics.RPC_LATCH.path)
        self._enforcer = enforcer
        self._leases = leases
        self._chance = chance
        self._asked = False
        self._returned = asyncio.Event()
        leases.wait(_WAITS)

    def __repr__(self) -> str:
        return f"<FleetLatchNews of {self._everybody}>"

    async def run(self) -> None:
        """Ask now, and each time :meth:`returned` was called, until cancelled."""
        while True:
            await self._ask()
            await self._returned.wait()
            self._returned.clear()
            await asyncio.sleep(self._chance() * SPREAD_S)

    def inherited(self) -> None:
        """Record that the gateway before handed over what it knows: leases need not wait for the first answers."""
        self._leases.wait(None)

    def returned(self) -> None:
        """Record that the bus is there, or has returned: grant no lease before the others were asked again.

        Who is asked at the start is there already.
        """
        if self._asked:
            self._leases.wait(_WAITS)
            self._returned.set()

    async def _ask(self) -> None:
        answers = list[FleetLatches]()
        try:
            for answer in await self._bus.ask(self._everybody, timeout_s=ASK_S):
                with contextlib.suppress(PayloadError):
                    if answer.error is None:
                        answers.append(payloads.decode(FleetLatches, answer.payload))
        except BusError:
            answers.clear()  # asked again when the bus returns
        self._asked = True
        self._enforcer.adopt(answers)
        if not self._returned.is_set():
            self._leases.wait(None)
