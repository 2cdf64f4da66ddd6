"""The right to drive one robot, held by this program: keeps the lease, numbers the commands, tells of its loss."""

from __future__ import annotations

import asyncio
import contextlib
import getpass
import socket
from typing import Any

from zbridge.bus import Answer, Bus, Publisher, Sample
from zbridge.control.proof import Signer
from zbridge.control.wishes import NAMED
from zbridge.errors import BusError, Code, Held, LeaseLost, NotReady, PayloadError, Refused, TooFast
from zbridge.errors import refusal as refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Acquire, Control, Drive, FleetMessage, Lease, Mode, Motor, Raw
from zbridge.fleet.topics import KeySpace, Topic

RETRY_S = 0.1
"""Seconds between two questions to a gateway that does not answer."""
ASK_S = 1.0
"""Longest time one question waits for its answer."""
LEASE_S = 3.0
"""Seconds a lease is taken to last that does not say."""
REPEAT_S = 0.05
"""Seconds between the commands of :meth:`Driver.during`."""

_MOVING = ("drive", "mode", "motor/", "raw/")
_PASSING = (*NotReady.codes, *TooFast.codes)
"""What is no word about whose the lease is."""


def default_who() -> str:
    """Name this program as ``user@host``."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user id without a name
        user = "somebody"
    return f"{user}@{socket.gethostname()}"


class Driver:
    """The lease of one robot: ``await drive(forward=0.3)``, again and again, for motion lasts ``deadman_s`` only.

    ``lost`` is set when the lease is; from then on every command raises LeaseLost, which tells why and who holds
    the robot. A command that the gateway refused is raised as Refused by the next one.
    """

    def __init__(self, bus: Bus, keys: KeySpace, who: str, lease: Lease) -> None:
        self.who = who[:NAMED]
        self.robot = keys.robot
        self.lost = asyncio.Event()
        self.loss: LeaseLost | None = None
        self._bus = bus
        self._keys = keys
        self._signer = Signer(lease)
        self._lease_s = lease.expires_in_s or LEASE_S
        self._lock = asyncio.Lock()
        self._doubted = asyncio.Event()
        self._refusal: Refused | None = None
        self._seen: dict[tuple[str, str, str], int] = {}
        self._publishers: dict[str, Publisher] = {}

    def __repr__(self) -> str:
        return f"<Driver of {self.robot} {'lost' if self.loss else 'holding'}>"

    async def __call__(
        self, forward: float = 0.0, left: float = 0.0, turn: float = 0.0, *, light: bool | None = None
    ) -> None:
        """Drive: fractions of full scale, -1 to 1, ``turn`` counter-clockwise; all zero is neutral.

        Raises ValueError where a value is outside -1..1, LeaseLost, or Refused with the gateway's reason.
        """
        for name, value in (("forward", forward), ("left", left), ("turn", turn)):
            if not -1.0 <= value <= 1.0:
                raise ValueError(f"{name} = {value!r}: expected -1 to 1")
        await self._send(topics.CMD_DRIVE, Drive(forward=forward, left=left, turn=turn, light=light))
        await asyncio.sleep(0)  # a program that drives in a loop must leave time to hear of its loss

    async def during(self, seconds: float, forward: float = 0.0, left: float = 0.0, turn: float = 0.0) -> None:
        """Drive for so many seconds, then stand."""
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        while (left_s := end - loop.time()) > 0:
            await self(forward, left, turn)
            await asyncio.sleep(min(REPEAT_S, left_s))
        await self()

    async def motor(self, name: str, value: float) -> None:
        """Move one motor: rad/s, or metres for a linear motor; to be repeated like a drive."""
        await self._send(topics.CMD_MOTOR(name), Motor(value))

    async def mode(self, mode: str) -> None:
        """Say who moves the robot: ``none``, ``manual`` or ``autonomous`` (for as long as the lease is held)."""
        if mode not in ("none", "manual", "autonomous"):
            raise ValueError(f"mode = {mode!r}: expected 'none', 'manual' or 'autonomous'")
        await self._send(topics.CMD_MODE, Mode(mode))  # type: ignore[arg-type]

    async def raw(self, protocol: str, message_id: int, body: bytes = b"") -> None:
        """Send a legacy message that no fleet message holds."""
        await self._send(topics.CMD_RAW(protocol), Raw(id=message_id, body=body))

    async def _send(self, topic: Topic, message: FleetMessage) -> None:
        async with self._lock:
            if self.loss is not None:
                loss = self.loss  # a new one each time: the traceback of a raised exception grows
                raise LeaseLost(str(loss), loss.code, holder=loss.holder)
            refusal, self._refusal = self._refusal, None
            if refusal is not None and getattr(message, "moving", True):
                raise refusal
            publisher = self._publishers.get(topic.path)
            if publisher is None:
                publisher = self._publishers[topic.path] = self._bus.publisher(self._keys.key(topic.path), topic)
            payload = payloads.encode(message)
            publisher.put(payload, self._signer.command(publisher.key, payload))
            if topic is not topics.CMD_DRIVE:  # goes by way of a thread: the next command must not overtake it
                await self._bus.flush()
            if refusal is not None:  # a neutral is sent whatever there is to tell
                raise refusal

    # Keeping the lease

    async def keep(self) -> None:
        """Renew the lease until it is lost."""
        loop = asyncio.get_running_loop()
        expires_at = loop.time() + self._lease_s
        while self.loss is None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._lease_s / 3):
                    await self._doubted.wait()
            self._doubted.clear()
            asked_at = loop.time()
            lease = await self._ask(topics.RPC_RENEW, min(ASK_S, self._lease_s / 3))
            if lease is None:
                if loop.time() >= expires_at:
                    self._lose("the gateway does not answer")
            elif lease.ok or lease.code == Code.OUT_OF_ORDER:  # somebody repeated our question, and came first with it
                expires_at = asked_at + (lease.expires_in_s or self._lease_s)
            else:
                self._lose(lease.reason or "no reason given", lease.holder)

    def look(self, sample: Sample) -> None:
        """Take news from ``control``: somebody else drives, or commands of ours were refused."""
        try:
            control = payloads.decode(Control, sample.payload)
        except PayloadError:
            return
        if control.lease != self._signer.lease:
            self._doubted.set()
        news = self._new_refusals(control)
        if news:
            self._refusal = news[-1]

    def _new_refusals(self, control: Control) -> list[Refused]:
        """List what was refused to us since we last looked."""
        news, seen = [], {}
        for refusal in control.refusals:
            key = (refusal.command, refusal.code, refusal.reason)
            if refusal.who == self.who and refusal.by is None and refusal.command.startswith(_MOVING):
                if refusal.count != self._seen.get(key, 0):
                    if refusal.code == Code.LEASE_ENDED:  # of a lease before this one, or this one's end: ask
                        self._doubted.set()
                    else:
                        text = f"{self.robot}: {refusal.command}: {refusal.reason}"
                        news.append(refused(refusal.code, text))
                seen[key] = refusal.count
        self._seen = seen
        return news

    def remember(self, control: Control | None) -> None:
        """Know what was refused to a program of our name before us."""
        if control is not None:
            self._new_refusals(control)

    async def release(self) -> None:
        """Give the lease back; a robot that moves is stopped."""
        if self.loss is None:
            self._lose("released")
            await self._ask(topics.RPC_RELEASE, ASK_S)
        for publisher in self._publishers.values():
            publisher.close()

    async def _ask(self, topic: Topic, timeout_s: float) -> Lease | None:
        """Ask about the lease; None where nobody says whose it is."""
        key = self._keys.key(topic.path)
        with contextlib.suppress(BusError, PayloadError):
            for answer in await self._bus.ask(key, self._signer.question(key), timeout_s=timeout_s):
                if answer.error is None:
                    lease = payloads.decode(Lease, answer.payload)
                    return lease if lease.ok or lease.code not in _PASSING else None
        return None

    def _lose(self, reason: str, holder: str | None = None) -> None:
        text = f"{self.robot}: {reason}" + (f"; held by {holder}" if holder else "")
        self.loss = LeaseLost(text, holder=holder)
        self.lost.set()


async def acquire(bus: Bus, keys: KeySpace, request: Acquire, name: str, *, takeover: bool, wait_s: float) -> Lease:
    """Get the lease, asking as ``name``.

    Raises Held where somebody has it, Malformed where it cannot be asked for like this; after ``wait_s`` NotReady or
    TooFast where the gateway went on saying so, BusError where none answered.
    """
    key = keys.key((topics.RPC_TAKEOVER if takeover else topics.RPC_ACQUIRE)(name).path)
    loop = asyncio.get_running_loop()
    deadline = loop.time() + wait_s
    refusal: Refused | None = None
    while True:
        left_s = max(RETRY_S, deadline - loop.time())
        for answer in await bus.ask(key, payloads.encode(request), timeout_s=min(ASK_S, left_s)):
            try:
                return _granted(keys.robot, answer)
            except (NotReady, TooFast) as later:
                refusal = later
            except BusError:
                continue
        if loop.time() >= deadline:
            break
        await asyncio.sleep(min(RETRY_S, max(0.0, deadline - loop.time())))
    raise refusal or BusError(f"{keys.robot}: no gateway answered within {wait_s:g} s")


def _granted(robot: str, answer: Answer) -> Lease:
    """Read the lease; raise Refused as the gateway did, BusError where it was not the gateway that answered."""
    if isinstance(answer.error, Refused):
        raise refused(answer.error.code, f"{robot}: {answer.error}")
    if answer.error is not None:
        raise answer.error
    lease = payloads.decode(Lease, answer.payload)
    if lease.ok:
        return lease
    reason = lease.reason or "no reason given"
    if lease.code == Code.HELD:
        expires = f", {lease.expires_in_s:.1f} s left" if lease.expires_in_s is not None else ""
        raise Held(f"{robot} is {reason}{expires}", holder=lease.holder)
    raise refused(lease.code or "", f"{robot}: {reason}")


@contextlib.asynccontextmanager
async def holding(bus: Bus, keys: KeySpace, request: Acquire, name: str, *, takeover: bool, wait_s: float) -> Any:
    """Hold the lease while the context lasts. name: which ``who`` begins with, and which it is asked for at."""
    with contextlib.ExitStack() as declared:
        if request.alive is not None:
            token = bus.announce(keys.alive(request.alive))
            declared.callback(token.close)
        known = await _control(bus, keys)
        lease = await acquire(bus, keys, request, name, takeover=takeover, wait_s=wait_s)
        driver = Driver(bus, keys, request.who, lease)
        driver.remember(known)
        watch = bus.subscribe(keys.key(topics.CONTROL.path), driver.look)
        declared.callback(watch.close)
        keeping = asyncio.create_task(driver.keep())
        try:
            yield driver
        finally:
            keeping.cancel()
            await asyncio.shield(driver.release())


async def _control(bus: Bus, keys: KeySpace) -> Control | None:
    for answer in await bus.ask(keys.key(topics.CONTROL.path), timeout_s=0.3):
        if answer.error is None:
            with contextlib.suppress(PayloadError):
                return payloads.decode(Control, answer.payload)
    return None
