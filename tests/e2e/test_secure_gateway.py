"""A real gateway with a listener behind the access rules: who may look looks, who may drive drives, and nobody else."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

import zbridge
from tests.access import LAB
from tests.e2e.conftest import HOST, WAIT_S, Bench, Gateway, device, listener, until
from tests.e2e.rigs.hq_programs import tcpudp_by_tcp
from tests.e2e.rigs.secure import SecureBus
from tests.ports import free_port
from zbridge.bus import BusSettings
from zbridge.bus.tls.files import folder_tls
from zbridge.cli.gateway_commands import restart
from zbridge.client import Fleet
from zbridge.errors import BusRefused, Malformed
from zbridge.security.roles import Member, Roles

ROLES = Roles({**LAB.names, "op2": Member("operator")})
DENIED_S = 0.7
"""How long the forbidden is tried."""


def settings(bus: SecureBus, name: str) -> BusSettings:
    return BusSettings(mode="client", connect=(bus.endpoint,), multicast=False, tls=folder_tls(bus.folders[name]))


@contextlib.asynccontextmanager
async def member(bus: SecureBus, name: str) -> AsyncIterator[Fleet]:
    async with zbridge.connect(settings=settings(bus, name)) as fleet:
        yield fleet


async def established(fleet: Fleet) -> None:
    async for status in fleet["r1"].status:
        if status.state == "established":
            return


async def refused(fleet: Fleet, who: str, name: str, may_not: str, *, takeover: bool = False) -> None:
    with pytest.raises(BusRefused, match=f"r1: {may_not}"):
        async with fleet["r1"].control(who, name=name, takeover=takeover, wait_s=DENIED_S):
            raise AssertionError(f"{who} drives")


def tls(bus: SecureBus, name: str) -> str:
    """Write ``[bus.tls]``; the last part of a configuration."""
    files = folder_tls(bus.folders[name])
    return f'[bus.tls]\nca = "{files.ca}"\ncertificate = "{files.certificate}"\nkey = "{files.key}"\n'


async def test_each_role_does_what_it_may_with_a_real_robot_and_no_more(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bus = SecureBus(tmp_path / "bus", ROLES)
    bench.stack.callback(bus.stop)
    port = free_port()
    parts = (device(bench.simulator()), listener("g2", "tcpudp", port), tls(bus, "g2"))
    gateway = Gateway(bench.stack, tmp_path / "gateway.toml", bus.endpoint, *parts)
    async with member(bus, "v1") as viewer, member(bus, "op1") as operator, member(bus, "op2") as another:
        await established(viewer)
        assert set(await viewer.robots()) == {"r1"}
        assert set(await viewer.sessions()) == {("r1", "gateway")}
        await refused(viewer, "v1", "v1", "viewer.v1 may not drive it: that takes the role operator or")
        async with operator["r1"].control("op1.laptop", name="op1") as drive:
            await drive.during(0.3, forward=0.3)
            await operator["r1"].ask_pose()
            with pytest.raises(Malformed, match="the certificate of this program says 'op2'"):
                await another["r1"].control("op1.laptop", name="op1").__aenter__()
            await refused(another, "op2", "op2", "operator.op2 may not take it over: that takes", takeover=True)
            await drive(forward=0.1)
            assert drive.loss is None
            async with member(bus, "sup1") as supervisor, supervisor["r1"].control("sup1", takeover=True) as taken:
                await taken.during(0.2, forward=0.2)
            assert drive.loss is not None
        assert not await restart(settings(bus, "op1"), "fleet", "r1")
        assert capsys.readouterr().err == (
            "r1: operator.op1 may not restart its gateway: that takes the role supervisor in roles.toml of the router\n"
        )
        await viewer["r1"].stop()
        with socket.create_connection((HOST, port)) as tcp:
            move = await asyncio.to_thread(tcpudp_by_tcp, tcp)
            async with asyncio.timeout(WAIT_S):
                async for control in viewer["r1"].control:
                    if (control.holder or "").startswith("hq.g2."):
                        break
                    move(0)  # neutral first, after the stop
                    await asyncio.sleep(0.2)
                    move(1)
    gateway.end()


async def test_a_process_with_listeners_only_drives_lives_and_answers_under_the_name_in_its_certificate(
    bench: Bench, tmp_path: Path
) -> None:
    bus = SecureBus(tmp_path / "bus", ROLES)
    bench.stack.callback(bus.stop)
    port = free_port()
    gateway = Gateway(bench.stack, tmp_path / "r1.toml", bus.endpoint, device(bench.simulator()), tls(bus, "g1"))
    listeners = Gateway(
        bench.stack, tmp_path / "hq.toml", bus.endpoint, listener("desk", "tcpudp", port), tls(bus, "h1")
    )
    async with member(bus, "v1") as viewer:
        await established(viewer)
        await asyncio.to_thread(until, lambda: listeners.listens(1))
        async with asyncio.timeout(WAIT_S):  # a busy machine answers late
            while not (others := {who for _, who in await viewer.sessions()} - {"gateway"}):  # noqa: ASYNC110
                await asyncio.sleep(0.2)
        (own,) = others
        assert own.startswith("hq.h1.")
        with socket.create_connection((HOST, port)) as tcp:
            move = await asyncio.to_thread(tcpudp_by_tcp, tcp)
            for _ in range(10):  # motion without neutral first is refused, and its report gets through
                move(1)
            async with asyncio.timeout(WAIT_S):
                async for control in viewer["r1"].control:
                    if any(each.by == "hq.h1.desk" and each.code == "neutral_first" for each in control.refusals):
                        break
                async for control in viewer["r1"].control:
                    if (control.holder or "").startswith("hq.h1.desk."):
                        break
                    move(0)
                    await asyncio.sleep(0.2)
                    move(1)
        async with asyncio.timeout(WAIT_S):
            async for control in viewer["r1"].control:
                if control.holder is None:
                    break
    for process in (listeners, gateway):
        process.end()
