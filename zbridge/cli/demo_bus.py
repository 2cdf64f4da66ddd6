"""The processes of ``zbridge demo``, and the bus of ``zbridge demo --secure``: a router, and temporary certificates.

A viewer's session watches, an operator's drives, and each gateway answers for its robot only. The members' folders
exist as long as the demo runs, for commands in another terminal.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import socket
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import IO

import msgspec

from zbridge.bus import Bus, open_bus
from zbridge.bus.tls.files import folder_settings
from zbridge.cli.certs import now, opened
from zbridge.client import Fleet
from zbridge.errors import BusError
from zbridge.metrics import Metrics
from zbridge.security.roles import Member

END_S = 3.0
"""Longest wait for processes to end by themselves, seconds."""


def free_port() -> int:
    """Return a port that is free for TCP and UDP, outside the range from which the system assigns ports."""
    while True:
        port = random.randrange(20_000, 32_000)
        with contextlib.suppress(OSError), socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind(("127.0.0.1", port))
            udp.bind(("127.0.0.1", port))
            return port


@contextlib.asynccontextmanager
async def process(
    log: IO[bytes], *arguments: str, read: bool = False, state: Path | None = None
) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a command of ``zbridge`` while the context lasts.

    read: its standard output is a pipe. state: a folder for what it keeps over a restart.
    """
    own = {"STATE_DIRECTORY": str(state)} if state is not None else {}
    started = await asyncio.create_subprocess_exec(
        sys.executable,
        *("-m", "zbridge", *arguments),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE if read else asyncio.subprocess.DEVNULL,
        stderr=log,
        env={**os.environ, "PYTHONUNBUFFERED": "1", **own},
    )
    try:
        yield started
    finally:
        await end((started,))


async def end(processes: Sequence[asyncio.subprocess.Process]) -> None:
    """End processes together; kill those that still run after :data:`END_S`."""
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
    ended = asyncio.gather(*(process.wait() for process in processes))
    try:
        async with asyncio.timeout(END_S):
            await asyncio.shield(ended)
    except TimeoutError:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
        await ended


REALM = "fleet"
START_S = 20.0
"""Longest time a process may take to start."""
DAYS = 60
"""How long the certificates are valid: no warning of their end is shown."""
_ROUTER, _VIEWER, _OPERATOR, _READER = "hub", "screen", "demo", "you"


class DemoBus(msgspec.Struct, frozen=True):
    """How the parts of a demo use its bus.

    viewer: the session of the table. operator: the robots as the program that drives them sees them. table: the
    ``[bus]`` table of a robot's gateway. commands: what to try in another terminal. joins: the options by which the
    console joins it.
    """

    endpoint: str
    viewer: Bus
    operator: Fleet
    table: Callable[[str], str]
    commands: tuple[str, ...]
    joins: tuple[str, ...]


@contextlib.asynccontextmanager
async def secure_bus(folder: Path, log: IO[bytes], robots: list[str]) -> AsyncIterator[DemoBus]:
    """Run a router with roles, and join it as a viewer and as an operator; raise ConfigError, BusError."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    gateways = {robot: f"g{number}" for number, robot in enumerate(robots, 1)}
    roles = make_members(folder, endpoint, gateways)
    async with contextlib.AsyncExitStack() as stack:
        listening = ("--listen", endpoint, "--tls", str(folder / _ROUTER), "--roles", str(roles))
        await stack.enter_async_context(process(log, "router", *listening))
        viewer = await stack.enter_async_context(_joined(folder / _VIEWER))
        operator = await stack.enter_async_context(_joined(folder / _OPERATOR))
        commands = (
            f"zbridge ls --sessions --tls {folder / _VIEWER}     # a viewer: may watch and stop, not drive",
            f"zbridge drive {robots[0]} --tls {folder / _READER}     # an operator",
        )
        fleet = Fleet(operator, REALM, _OPERATOR)
        tables = {robot: (folder / gateway / "bus.toml").read_text("utf-8") for robot, gateway in gateways.items()}
        yield DemoBus(endpoint, viewer, fleet, tables.__getitem__, commands, ("--tls", str(folder / _READER)))


def make_members(folder: Path, endpoint: str, gateways: dict[str, str]) -> Path:
    """Make an authority, and the folders of all members of the demo; return ``roles.toml``; raise ConfigError.

    gateways: the name of each robot's.
    """
    made, at = opened(folder / "certs", "zbridge demo --secure"), now()
    from zbridge.security.certs import authority
    from zbridge.security.certs.bundle import Packing, bundle

    members = {
        _ROUTER: Member("router"),
        _VIEWER: Member("viewer"),
        _OPERATOR: Member("operator"),
        _READER: Member("operator"),
        **{name: Member("gateway", (robot,), listeners=True) for robot, name in gateways.items()},
    }
    authority.init(made, at)
    for name, member in members.items():
        hosts = ("127.0.0.1",) if member.role == "router" else ()
        authority.issue(made, authority.CertificateRequest(name, member, hosts, DAYS), at)
    for name in members:
        bundle(made, name, Packing(folder / name, (endpoint,)), at)
    return folder / _ROUTER / "roles.toml"


@contextlib.asynccontextmanager
async def _joined(folder: Path) -> AsyncIterator[Bus]:
    """Join the bus with the files of a folder, as soon as the router is there; raise BusError."""
    loop = asyncio.get_running_loop()
    until = loop.time() + START_S
    while True:
        try:
            bus = await open_bus(folder_settings(folder), Metrics(), realm=REALM)
            break
        except BusError:
            if loop.time() >= until:
                raise
            await asyncio.sleep(0.1)
    try:
        yield bus
    finally:
        await bus.close()
