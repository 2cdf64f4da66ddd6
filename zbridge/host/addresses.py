"""Which gateway of this machine serves which robot address: a second robot name with the same address is refused.

Theory of operation. A gateway binds a Unix socket in Linux's abstract namespace, whose name has the resolved address
and the robot (:class:`AddressLock`). Nobody talks to it: names are read from ``/proc/self/net/unix``. The kernel takes
the name back with the process, however it ends, and two network namespaces, in which one address means two robots, do
not see each other's names. Two gateways of one robot name may hold an address: an owner and its standby, or a gateway
and its successor. Two robot names may where both set ``allow_shared_address``.

Not locked: routers to which many robots are connected, and port 0. Not seen: other machines, a serial line that is used
from two network namespaces, one robot by two of its addresses. Any user of the machine can bind such a name.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import os
import secrets
import socket
import sys
import threading
import time
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import assert_never

import msgspec

from zbridge.app.config import GatewayPlan
from zbridge.errors import ConfigError
from zbridge.protocol.address import Address, DatagramAddress, DeviceAddress, SerialAddress, ZenohAddress
from zbridge.robot.settings import DevicePlan

RESOLVE_S = 2.0
"""Longest wait for the addresses of host names; a name that is not resolved by then stands for itself."""
NAMES = 64
"""Most host names that are resolved at a time."""
LEAVE_S = 3.0
"""Longest wait for a gateway that is just leaving the address."""
SHARING = "Where the robot accepts several clients: device.allow_shared_address = true in both"
"""What to do about an address that two robots name."""
_LOOK_S = 0.1
_GUARD_S = 1.0
"""Longest wait for another process that takes a lock at the same time."""
_PREFIX = "zbridge/1/"
_GUARD = "\0zbridge/lock"
_NAME_BYTES = 107
"""Bytes of a name in the abstract namespace, with its leading zero."""
_ANY = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""What the kernel makes of an address that means none."""


class AddressHolder(msgspec.Struct, frozen=True):
    """A gateway that holds an address. robot: ``<realm>/<name>``, shortened where it is very long."""

    robot: str
    pid: int
    shares: bool


def resolve(addresses: Iterable[DeviceAddress], within_s: float = RESOLVE_S) -> dict[DeviceAddress, frozenset[str]]:
    """Resolve each address to all its forms on this machine; to none if it is not locked. May block."""
    addresses = list(addresses)
    hosts = {address.host for address in addresses if isinstance(address, Address) and address.port}
    ips = _resolved(hosts, within_s)
    return {address: _lockable_forms(address, ips) for address in addresses}


def _lockable_forms(address: DeviceAddress, ips: Mapping[str, frozenset[str]]) -> frozenset[str]:
    match address:
        case SerialAddress():
            return frozenset({f"serial {os.path.realpath(address.path)}"})
        case ZenohAddress():  # a router, to which many robots are connected
            return frozenset()
        case Address(port=0):  # any port
            return frozenset()
        case DatagramAddress():
            kind = "udp-in" if address.waits else "udp"
            return frozenset(f"{kind} {ip} {address.port}" for ip in ips[address.host])
        case Address():
            return frozenset(f"tcp {ip} {address.port}" for ip in ips[address.host])
    assert_never(address)


def _resolved(hosts: Iterable[str], within_s: float) -> dict[str, frozenset[str]]:
    """Resolve host names together: one that is slow delays none of the others, and none for longer than within_s."""
    found = {host: frozenset({_plain(host)}) for host in hosts}
    names = [host for host in found if _ip(host) is None][:NAMES]

    def look_up(host: str) -> None:
        with contextlib.suppress(OSError, UnicodeError):
            answers = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
            found[host] = frozenset(_plain(str(answer[4][0])) for answer in answers)

    threads = [threading.Thread(target=look_up, args=(host,), daemon=True) for host in names]
    until = time.monotonic() + within_s
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, until - time.monotonic()))
    return dict(found)


def _ip(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _plain(host: str) -> str:
    """Write an IP address in its one form; a name in lower case."""
    if (ip := _ip(host)) is None:
        return host.lower()
    mapped = ip.ipv4_mapped if isinstance(ip, ipaddress.IPv6Address) else None
    return _ANY.get(str(ip), str(mapped or ip))


# Locks


class Addresses:
    """The robot addresses of several files, each of one robot unless all that name it share it."""

    def __init__(self) -> None:
        self._taken: dict[str, tuple[Path, bool]] = {}

    def add(self, path: Path, forms: Iterable[str], shares: bool) -> None:
        """Enter the addresses of a file; raise ConfigError if another file has one of them."""
        forms = list(forms)
        for form in forms:
            other, both = self._taken.get(form, (path, True))
            if other != path and not (shares and both):
                raise ConfigError(f"{path}: device.connect: expected another address than that of {other}. {SHARING}")
        self.note(path, forms, shares)

    def note(self, path: Path, forms: Iterable[str], shares: bool) -> None:
        """Enter the addresses of a file that runs, whoever else has them."""
        self._taken.update((form, (path, shares)) for form in forms)


@contextlib.asynccontextmanager
async def hold_addresses(plan: GatewayPlan) -> AsyncIterator[None]:
    """Hold the addresses of a plan's robot while the context lasts; raise ConfigError if another robot's gateway does.

    One that is just leaving is waited for, :data:`LEAVE_S` at most.
    """
    device, robot = plan.device, plan.config.robot
    if device is None or sys.platform != "linux":
        yield
        return
    forms = await asyncio.to_thread(forms_of, device)
    lock = AddressLock(robot.realm, robot.name, shares=device.shares)
    until = time.monotonic() + LEAVE_S
    with contextlib.closing(lock):
        while (other := await asyncio.to_thread(lock.take, forms)) is not None:
            if time.monotonic() >= until:
                raise refused(plan, other)
            await asyncio.sleep(_LOOK_S)
        yield


def require_free(plan: GatewayPlan) -> None:
    """Raise ConfigError if a gateway of this machine serves the address of a plan's robot under another name."""
    robot, device = plan.config.robot, plan.device
    if device is not None:
        other = rival(sorted(forms_of(device)), f"{robot.realm}/{robot.name}", shares=device.shares)
        if other is not None:
            raise refused(plan, other)


def serving(plan: GatewayPlan) -> AddressHolder | None:
    """Return the process of this machine that serves a plan's robot under its name; None if there is none."""
    if plan.device is None:
        return None
    mine = _shortened(f"{plan.config.robot.realm}/{plan.config.robot.name}")
    found = (holder for form in sorted(forms_of(plan.device)) for holder in holders(form))
    return next((holder for holder in found if holder.robot == mine), None)


def forms_of(device: DevicePlan) -> frozenset[str]:
    """Resolve the addresses of a robot."""
    return frozenset[str]().union(*resolve(device.addresses).values())


def refused(plan: GatewayPlan, other: AddressHolder) -> ConfigError:
    """Make the error that names who has the address."""
    connect = plan.config.device.connect if plan.config.device is not None else ()
    return ConfigError(
        f"device.connect = {list(connect)}: expected an address of its own: {other.robot} (process {other.pid}) serves"
        f" it on this machine. {SHARING}"
    )


class AddressLock:
    """A gateway's hold on the addresses of its robot, from :meth:`take` to :meth:`close`. shares: allows others."""

    def __init__(self, realm: str, robot: str, *, shares: bool = False) -> None:
        self._robot = f"{realm}/{robot}"
        self._shares = shares
        self._sockets: list[socket.socket] = []

    def __repr__(self) -> str:
        return f"<AddressLock of {self._robot}, {len(self._sockets)} addresses>"

    def take(self, forms: Iterable[str]) -> AddressHolder | None:
        """Hold these addresses, in all their forms; return who else holds one: then nothing is held."""
        with _guarded():
            wanted = list(forms)
            other = rival(wanted, self._robot, shares=self._shares)
            for form in wanted if other is None else ():
                self._sockets.append(_bound(_name(form, self._robot, shares=self._shares)))
            return other

    def close(self) -> None:
        """Give the addresses up; idempotent."""
        while self._sockets:
            self._sockets.pop().close()


def rival(forms: Iterable[str], robot: str, *, shares: bool) -> AddressHolder | None:
    """Return who holds one of these addresses for another robot; None: all are free. robot: ``<realm>/<name>``."""
    mine = _shortened(robot)
    others = (holder for form in forms for holder in holders(form) if holder.robot != mine)
    return next((holder for holder in others if not (shares and holder.shares)), None)


def holders(form: str) -> list[AddressHolder]:
    """List who holds an address; nobody where the kernel does not tell."""
    begin, found = f"@{_PREFIX}{_digest(form)}/", []
    try:
        lines = Path("/proc/self/net/unix").read_text(errors="replace").splitlines()
    except OSError:
        return []
    for line in lines:
        match line.partition(begin)[2].split("/", 3):
            case [mode, pid, _, robot] if pid.isdecimal():
                found.append(AddressHolder(robot, int(pid), mode == "s"))
    return found


def _name(form: str, robot: str, *, shares: bool) -> str:
    mode, token = "s" if shares else "x", secrets.token_hex(2)
    return f"\0{_PREFIX}{_digest(form)}/{mode}/{os.getpid()}/{token}/{_shortened(robot)}"


def _shortened(robot: str) -> str:
    """Fit a robot's name into the name of a socket; a long one ends with a digest of the whole."""
    room = _NAME_BYTES - len(f"\0{_PREFIX}{16 * 'x'}/x/{10 * '9'}/abcd/")
    return robot if len(robot) <= room else f"{robot[: room - 9]}~{blake2b(robot.encode(), digest_size=4).hexdigest()}"


def _digest(form: str) -> str:
    return blake2b(form.encode(errors="surrogateescape"), digest_size=8).hexdigest()


def _bound(name: str) -> socket.socket:
    end = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        end.bind(name)
    except OSError:
        end.close()
        raise
    return end


@contextlib.contextmanager
def _guarded() -> Iterator[None]:
    """Let one process at a time look and bind. One that is frozen meanwhile is not waited for for long."""
    guard, until = None, time.monotonic() + _GUARD_S
    while guard is None and time.monotonic() < until:
        try:
            guard = _bound(_GUARD)
        except OSError:
            time.sleep(0.005)
    try:
        yield
    finally:
        if guard is not None:
            guard.close()
