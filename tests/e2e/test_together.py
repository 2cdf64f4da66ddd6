"""Robots that share a process, a session and a certificate: one that floods, hangs or ends costs the others nothing."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.access import LAB
from tests.benchmarks.fleet_robots import READING, REGISTERED
from tests.e2e.conftest import HOST, WAIT_S, end, start
from tests.e2e.rigs.secure import SecureBus
from tests.e2e.test_secure_gateway import member
from tests.simulated_robot import simulated
from zbridge.bus.tls.files import folder_tls
from zbridge.client import Fleet
from zbridge.protocol.plugin import find_protocol
from zbridge.security.roles import Member, Roles

ROBOTS = {"alf1": "alf", "tcp1": "tcpudp", "wc1": "wc2ec", "bad1": "wc2ec"}
NAMES = {name: LAB.names[name] for name in ("v1", "op1", "main")}
ROLES = Roles({**NAMES, "host1": Member("gateway", tuple(ROBOTS))})
DRIVEN_S = 1.5


class BadRobot:
    """Registers as a robot does, and then sends as much as is taken, reads nothing, or goes."""

    def __init__(self) -> None:
        self.mode = "quiet"
        self._links: dict[asyncio.StreamWriter, asyncio.Task[None] | None] = {}

    async def listen(self, stack: contextlib.AsyncExitStack) -> str:
        server = await asyncio.start_server(self._serve, HOST, 0)
        stack.push_async_callback(self._close)
        stack.callback(server.close)
        return f"tcp://{HOST}:{server.sockets[0].getsockname()[1]}"

    def be(self, mode: str) -> None:
        self.mode = mode
        if mode == "gone":
            for link in self._links:
                link.transport.abort()

    async def _close(self) -> None:
        self.be("gone")
        await asyncio.gather(*filter(None, self._links.values()))

    async def _serve(self, reader: asyncio.StreamReader, link: asyncio.StreamWriter) -> None:
        if self.mode == "gone":
            link.close()
            return
        self._links[link] = asyncio.current_task()
        link.write(REGISTERED)
        with contextlib.suppress(OSError):
            while not link.is_closing():
                if self.mode == "flood":
                    link.write(100 * READING)
                    await link.drain()
                elif self.mode == "quiet":
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(reader.read(4096), 0.05)
                await asyncio.sleep(0.001)
        del self._links[link]
        link.close()


async def until(condition: Callable[[dict[str, str | None]], bool], fleet: Fleet) -> None:
    """Wait until the states of all robots are as wanted."""
    states: dict[str, str | None] = {}
    try:
        async with asyncio.timeout(WAIT_S):
            while not condition(states):
                robots = await fleet.robots()
                states = {name: status.state if status is not None else None for name, status in robots.items()}
    except TimeoutError:
        raise AssertionError(f"{states}") from None


async def drives_well(fleet: Fleet, robot: str) -> None:
    """Drive a robot; what is lost on the way, or late, ends the lease or brings no motion."""
    async with fleet[robot].control("op1") as drive:
        await drive.during(DRIVEN_S, forward=0.3)
        assert drive.loss is None


@pytest.mark.long
async def test_robots_of_one_process_and_certificate_are_driven_while_one_of_them_misbehaves(tmp_path: Path) -> None:
    async with contextlib.AsyncExitStack() as stack:
        bus = await asyncio.to_thread(SecureBus, tmp_path / "bus", ROLES)
        stack.callback(bus.stop)
        files, bad, folder = folder_tls(bus.folders["host1"]), BadRobot(), tmp_path / "robots"
        folder.mkdir()
        (folder / "host.toml").write_text("[host]\ntogether = true\n")
        for name, protocol in ROBOTS.items():
            at = [await bad.listen(stack)] if name == "bad1" else await simulated(protocol, stack)
            (folder / f"{name}.toml").write_text(
                f'[robot]\nname = "{name}"\n[device]\nprotocol = "{protocol}"\nconnect = {json.dumps(at)}\n'
                + (options(protocol) if name != "bad1" else "")
                + f'[bus]\nconnect = ["{bus.endpoint}"]\nmulticast = false\n'
                f'[bus.tls]\nca = "{files.ca}"\ncertificate = "{files.certificate}"\nkey = "{files.key}"\n'
            )
        log = (tmp_path / "log").open("w")
        stack.enter_context(log)
        process = start("run", str(folder), stdout=log, stderr=log)
        stack.callback(end, process, signal.SIGKILL)
        viewer = await stack.enter_async_context(member(bus, "v1"))
        operator = await stack.enter_async_context(member(bus, "op1"))
        await until(lambda states: states == dict.fromkeys(sorted(ROBOTS), "established"), viewer)
        assert {robot for robot, who in await viewer.sessions() if who == "gateway"} == ROBOTS.keys()
        for mode in ("flood", "hang", "gone"):
            bad.be(mode)
            await asyncio.gather(*(drives_well(operator, robot) for robot in ("alf1", "tcp1", "wc1")))
        await until(lambda states: states.get("bad1") not in (None, "established"), viewer)
        bad.be("quiet")
        await until(lambda states: states == dict.fromkeys(sorted(ROBOTS), "established"), viewer)
        await asyncio.to_thread(end, process)
        said = (tmp_path / "log").read_text()
        assert process.returncode == 0, said
        assert "Traceback" not in said, said
        await until(lambda states: not states, viewer)


def options(protocol: str) -> str:
    """Write the options that a simulated robot of this protocol needs, as JSON where TOML reads the same."""
    lines = []
    for name, value in find_protocol(protocol).simulated.items():
        lines.append(f"{name} = {inline(value)}")
    return "[device.options]\n" + "".join(f"{line}\n" for line in lines)


def inline(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(name)} = {inline(item)}" for name, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(inline, value)) + "]"
    return json.dumps(value)
