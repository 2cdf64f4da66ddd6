"""Joins the bus, retrying until that succeeds, and leaves a session that has become useless.

Zenoh's session would retry with an expired certificate every 4 s forever, and each attempt blocks the router for 0.1 s.
So a gateway whose certificate has expired leaves, and retries rarely, with the file as it is then.

After a cut of the network a session of Zenoh 1.10 may never connect again (eclipse-zenoh/zenoh#1876). A gateway that
has had no connection for long therefore opens a second session, and leaves the first one if only the second connects.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import random
from collections.abc import Awaitable, Callable
from datetime import datetime

from zbridge.app.config import GatewayPlan
from zbridge.bus import OPEN_S, Bus, open_bus
from zbridge.bus.tls.certificate import Certificate
from zbridge.bus.tls.files import ends_soon, utc_now
from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.errors import BusError, BusRefused
from zbridge.fleet import topics
from zbridge.log import Log
from zbridge.metrics import Metrics

log = Log("zbridge.app.gateway")

RETRY_S = 1.0
"""Seconds between attempts to open the bus, while no router is there."""
OPEN_MOST_S = 4.0
"""Time limit of an attempt; a process that ends waits for the attempt."""
EXPLAIN_FROM, EXPLAIN_EVERY = 2, 10
"""The third attempt that fails, and every tenth after it, asks the router why: a thousand that ask would keep it from
accepting any."""
RARELY_S = 60.0
"""Longest time between two attempts after refusals: each blocks the router for 0.1 s."""
CHECK_S = 3600.0
"""Seconds between checks of the certificate's end."""
LOG_S = 86_400.0
"""Seconds between log lines about the certificate's end."""
ENDED_S = 5.0
"""Seconds between checks after the certificate's end: at the next one without a bus the gateway leaves."""
STUCK_S = 15.0
"""Seconds without a connection after which a second session is tried, every time; Zenoh itself tries every 4 s."""
RECONNECTS_S = 10.0
"""Seconds within which a session connects, once another one can."""


class SessionUseless(BusError):
    """This session does not reconnect: leave it, and join the bus with a new one."""


class CertificateEnded(SessionUseless):
    """The certificate has expired and the bus is lost."""


class Pauses:
    """The pauses between attempts: constant while the router is away, growing with refusals.

    chance: between 0 and 1; it keeps gateways that were refused together from coming back together.
    """

    def __init__(self, chance: Callable[[], float] = random.random) -> None:
        self._chance = chance
        self._refused = 0

    def __repr__(self) -> str:
        return f"<Pauses after {self._refused} refusals>"

    @property
    def refused(self) -> bool:
        """Whether the last error was a refusal."""
        return self._refused > 0

    def after(self, error: BusError) -> float:
        """Return the seconds to wait after this error."""
        if not isinstance(error, BusRefused):
            self._refused = 0
            return RETRY_S * (0.5 + self._chance())
        self._refused = min(self._refused + 1, 16)
        longest = min(2.0 * RETRY_S * 2.0**self._refused, RARELY_S)
        return longest * (0.5 + 0.5 * self._chance())


async def join_bus(plan: GatewayPlan, metrics: Metrics) -> Bus:
    """Open the bus, retrying until that succeeds; rarely if the router refuses.

    A thousand others may wait for the same router: attempts are given more time, and come at other times than theirs.
    """
    robot, pauses, within_s = plan.config.robot, Pauses(), OPEN_S
    for failures in itertools.count():
        try:
            return await open_bus(
                plan.config.bus,
                metrics,
                bounds=topics.size_bounds(),
                within_s=within_s,
                realm=robot.realm,
                robot=robot.name,
                explain=pauses.refused or failures % EXPLAIN_EVERY == EXPLAIN_FROM,
            )
        except BusError as error:
            within_s = min(2 * within_s, OPEN_MOST_S)
            pause = pauses.after(error)
            log.warning("no_bus", "no bus: {error}; next attempt in {delay_s:.2g} s", error=error, delay_s=pause)
            await asyncio.sleep(pause)
    raise AssertionError("the session retries forever")


async def can_connect(plan: GatewayPlan) -> bool:
    """Return whether a new session connects to the bus; close it again."""
    try:
        bus = await open_bus(plan.config.bus, Metrics(), within_s=OPEN_S, explain=False)
    except BusError:
        return False
    await bus.close()
    return True


async def watch_session(plan: GatewayPlan, bus: Bus, can_connect: Callable[[GatewayPlan], Awaitable[bool]]) -> None:
    """Raise SessionUseless if a client's session does not reconnect while a new one connects."""
    changed, here = asyncio.Event(), False

    def connected(is_here: bool) -> None:
        nonlocal here
        here = is_here
        changed.set()

    async def returns(within_s: float) -> bool:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while not here:
                    changed.clear()
                    await changed.wait()
        return here

    bus.watch_connected(connected)
    while True:
        while here:
            changed.clear()
            await changed.wait()
        if not await returns(STUCK_S) and await can_connect(plan) and not await returns(RECONNECTS_S):
            raise SessionUseless("Zenoh's session does not reconnect, but a new one connects: joining the bus anew")


async def watch_certificate(
    certificate: Certificate, bus: Bus, open_faults: OpenFaults, now: Callable[[], datetime] = utc_now
) -> None:
    """Warn on ``status`` and in the log from 30 days before a certificate ends.

    Raises CertificateEnded when it has ended and there is no connection to the bus.
    """
    loop = asyncio.get_running_loop()
    logged, logged_at, here = None, 0.0, True

    def connected(is_here: bool) -> None:
        nonlocal here
        here = is_here

    bus.watch_connected(connected)
    while True:
        text = ends_soon(certificate, now())
        open_faults.set(FaultCode.CERTIFICATE, text)
        if text is not None and (text != logged or loop.time() - logged_at >= LOG_S):
            logged, logged_at = text, loop.time()
            log.warning("certificate_ends", "{reason}", reason=text)
        left_s = (certificate.ends - now()).total_seconds()
        if left_s <= 0 and not here:
            raise CertificateEnded(f"{text}; the bus is left")
        await asyncio.sleep(min(max(left_s, 0.0) + ENDED_S, CHECK_S))
