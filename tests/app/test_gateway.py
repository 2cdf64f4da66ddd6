"""What a gateway process makes of its configuration, and how it ends: a signal cancels the work once."""

import asyncio
import contextlib
import itertools
import json
import os
import signal
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgpack
import pytest

from tests.certificates import Authority
from tests.clock import jumping
from tests.fake_bus import FakeBus
from tests.proofs import Holder
from zbridge.app.config import plan
from zbridge.app.gateway import Gateway
from zbridge.app.handover.channel import VERSION, HandoverState
from zbridge.app.joining import RETRY_S, join_bus
from zbridge.bus import Bus, Handle
from zbridge.control.latch_store import LatchStore
from zbridge.errors import BusError, ConfigError
from zbridge.fleet.topics import KeySpace
from zbridge.hq import RobotSubscription
from zbridge.metrics import Metrics
from zbridge.tasks import until_signal

SOON_S = 5.0
NOWHERE = {"protocol": "tcpudp", "connect": ["tcp://127.0.0.1:1"]}


def configured(**control: Any) -> Gateway:
    return Gateway(plan({"robot": {"name": "r1"}, "device": NOWHERE, "control": control}))


@contextlib.asynccontextmanager
async def serving(gateway: Gateway, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[FakeBus]:
    """Run a gateway on a fake bus; its robot is not there."""
    bus = FakeBus("1")

    async def open_bus(*_: object, **__: object) -> Bus:
        return bus

    monkeypatch.setattr("zbridge.app.joining.open_bus", open_bus)
    running = asyncio.create_task(gateway.run())
    await asyncio.sleep(1.0)
    try:
        yield bus.join("2")
    finally:
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running


async def acquired(bus: FakeBus, who: str = "hq") -> dict[str, Any]:
    """Acquire the lease and give it back; return the answer that granted it."""

    async def asked(path: str, payload: bytes) -> dict[str, Any]:
        (reply,) = await bus.ask(f"fleet/r1/@rpc/control/{path}", payload)
        assert reply.error is None
        answer: dict[str, Any] = msgpack.unpackb(reply.payload)
        return answer

    lease = await asked(f"acquire/{who}", msgpack.packb({"who": who}))
    await asked("release", Holder.of(lease).question("release"))
    return lease


def claiming(bus: FakeBus, held_s: float, **more: Any) -> Handle:
    """Play another gateway that serves the robot for so long."""
    payload = msgpack.packb({"held_s": held_s, **more})
    return bus.join("beef").answer("fleet/r1/@rpc/claim/gateway", lambda question: question.answer(payload))


def last(bus: FakeBus, path: str) -> dict[str, Any]:
    fields: dict[str, Any] = msgpack.unpackb(bus.values(f"fleet/r1/{path}")[-1])
    return fields


@jumping
async def test_the_configuration_caps_a_lease_and_every_lease_has_an_id_and_a_token_of_its_own(monkeypatch) -> None:
    async with serving(configured(lease_s=1.5), monkeypatch) as bus:
        leases = [await acquired(bus) for _ in range(20)]
        assert {lease["expires_in_s"] for lease in leases} == {1.5}
        tokens, ids = ({lease[name] for lease in leases} for name in ("token", "lease"))
        assert ({len(token) for token in tokens}, {len(each) for each in ids}) == ({32}, {8})
        assert len(tokens) == len(ids) == 20
        assert len({byte for token in tokens for byte in token}) > 100, "nothing that could be guessed"


@jumping
@pytest.mark.parametrize("name", [None, "h1"])
async def test_a_process_with_listeners_only_answers_for_its_sessions_under_its_own_name(
    name: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    listener = {"protocol": "tcpudp", "listen": "tcp://127.0.0.1:0", "name": "desk"}
    raw: dict[str, Any] = {"robot": {"name": "r1"}, "hq": [listener]}
    if name is not None:
        folder = Authority(tmp_path).issue(f"hq.{name}")
        files = {"ca": "ca", "certificate": str(folder / "certificate.pem"), "key": str(folder / "key.pem")}
        raw["bus"] = {"connect": ["tls/localhost:1"], "multicast": False, "tls": files}
    gateway = Gateway(plan(raw))
    async with serving(gateway, monkeypatch) as bus:
        (answer,) = await bus.ask("fleet/r1/@rpc/sessions/*")
        assert answer.key == f"fleet/r1/@rpc/sessions/hq.{name or 'desk'}.1"


async def test_the_successor_of_a_gateway_that_died_binds_listeners_of_its_own() -> None:
    listener = {"protocol": "tcpudp", "listen": "tcp://127.0.0.1:0", "name": "desk"}
    near, far = socket.socketpair()
    with near, far:
        gateway = Gateway(plan({"robot": {"name": "r1"}, "device": NOWHERE, "hq": [listener]}), predecessor=far)
        gateway._incoming.state = HandoverState(VERSION, {}, 0, claim={"since": 1.0}, device={"links": []})
        bus = FakeBus("1")
        (made,) = gateway._listeners(bus, RobotSubscription(bus, KeySpace("fleet", "r1"), Metrics()))
        running = asyncio.create_task(made.run(gateway._incoming.part_restored))
        async with asyncio.timeout(SOON_S):
            await made.ready.wait()  # HQ programs are accepted: there is nothing to be taken over
        running.cancel()
        await asyncio.wait([running])


@jumping
async def test_the_audit_log_is_a_file_rotated_as_configured_that_has_what_was_only_counted_too(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for days in (0, 1):
        audit = {"audit": str(tmp_path / str(days) / "r1.jsonl"), "audit_bytes": 1000, "audit_files": 2}
        async with serving(configured(**audit, audit_days=days), monkeypatch) as bus:
            for number in range(50):
                await acquired(bus, f"hq{number}")
            for _ in range(10):
                await acquired(bus, "hq")
    sizes = {file.name: file.stat().st_size for file in (tmp_path / "0").iterdir()}
    assert sorted(sizes) == ["r1.jsonl", "r1.jsonl.1", "r1.jsonl.2"]
    assert max(sizes.values()) <= 1000
    young = [json.loads(line) for file in (tmp_path / "1").iterdir() for line in file.read_text().splitlines()]
    assert {line["robot"] for line in young} == {"r1"}
    assert {line["who"] for line in young} == {"hq", *(f"hq{number}" for number in range(50))}
    assert sum(line.get("count", 1) for line in young if (line["who"], line["event"]) == ("hq", "acquired")) == 10


@jumping
async def test_an_audit_log_that_cannot_be_written_keeps_the_gateway_from_starting(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(ConfigError, match=r"control\.audit = '.*/file/r1\.jsonl': "):
        await configured(audit=str(file / "r1.jsonl")).run()


@jumping
async def test_another_gateway_is_told_on_status_and_control_and_once_in_the_log(monkeypatch, caplog) -> None:
    text = "another gateway serves this robot too: beef"
    async with serving(configured(), monkeypatch) as bus:
        forged = claiming(bus, 1e-3)
        await asyncio.sleep(20.0)
        assert last(bus, "status")["reason"].endswith(f"; {text}")
        (refused,) = last(bus, "control")["refusals"]
        assert (refused["who"], refused["command"], refused["code"]) == ("beef", "claim", "held")
        assert (refused["reason"], refused["count"]) == ("this gateway serves the robot", 1)
        forged.close()
        await asyncio.sleep(10.0)
        assert text not in last(bus, "status")["reason"]
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [f"r1: {text}"]


@jumping
async def test_a_gateway_that_has_yielded_is_no_rival_and_must_not_be_ended(monkeypatch, caplog) -> None:
    text = "a second connection is open; ending that gateway makes the robot deaf"
    async with serving(configured(), monkeypatch) as bus:
        claiming(bus, 3600.0, yielded=True, connected_s=3600.0)
        await asyncio.sleep(20.0)
        assert last(bus, "status")["reason"].endswith(f"; {text}")
        assert last(bus, "control")["refusals"] == []
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [f"r1: {text}"]


@jumping
async def test_latched_stops_of_another_gateway_of_the_robot_come_into_force(monkeypatch) -> None:
    monkeypatch.setattr(LatchStore, "save", lambda store, latches: None)  # no threads in this loop
    latch = {"id": b"\x07" * 16, "who": "ann", "reason": "wet floor", "fleet": False}
    async with serving(configured(), monkeypatch) as bus:
        claiming(bus, 1e-3, yielded=True, latches=[latch])
        await asyncio.sleep(7.0)
        assert last(bus, "control")["state"] == "latched"
        assert last(bus, "control")["latches"] == [latch]


@jumping
async def test_a_robot_that_was_never_reached_is_left_to_a_gateway_that_has_it(monkeypatch, caplog) -> None:
    async with serving(configured(), monkeypatch) as bus:
        claiming(bus, 1e-3, healthy=True, connected_s=1e-3)
        bus.join("beef").announce("fleet/r1/@alive/gateway")
        await asyncio.sleep(10.0)
        shown = len(bus.values("fleet/r1/status"))
        await asyncio.sleep(10.0)
        assert len(bus.values("fleet/r1/status")) == shown, "nothing more is said of the robot"
        assert last(bus, "status")["state"] == "offline"
    assert "another gateway serves r1: leaving it alone" in caplog.text


async def received(number: signal.Signals) -> None:
    """Send this process a signal, and wait until the event loop has handled it."""
    handled = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, handled.set)
    os.kill(os.getpid(), number)
    os.kill(os.getpid(), signal.SIGUSR1)  # handled after it
    await handled.wait()


@pytest.mark.parametrize("first", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("again", [(), (signal.SIGTERM, signal.SIGINT)])
async def test_a_signal_ends_the_work_and_a_second_one_does_not_cut_its_tidying_up_short(first, again) -> None:
    started, tidying, go_on, tidy = (asyncio.Event() for _ in range(4))

    async def work() -> None:
        started.set()
        try:
            await asyncio.Event().wait()
        finally:
            tidying.set()
            await go_on.wait()
            tidy.set()

    async with asyncio.timeout(SOON_S):
        ending = asyncio.ensure_future(until_signal(work()))
        await started.wait()
        await received(first)
        await tidying.wait()
        for number in again:
            await received(number)
        assert not ending.done()
        go_on.set()
        await ending
    assert tidy.is_set()


async def test_work_that_ends_by_itself_is_not_waited_for_any_longer_and_work_that_fails_shows_why() -> None:
    async def work(error: Exception | None = None) -> None:
        if error is not None:
            raise error

    async with asyncio.timeout(SOON_S):
        await until_signal(work())
    with pytest.raises(OSError, match="no bus"):
        await until_signal(work(OSError("no bus")))


@jumping
async def test_a_bus_that_does_not_open_is_tried_again_at_other_times_and_with_more_time(monkeypatch) -> None:
    tried: list[tuple[float, float]] = []
    loop, bus = asyncio.get_running_loop(), FakeBus("1")

    async def open_bus(*_: object, within_s: float, **__: object) -> Bus:
        tried.append((loop.time(), within_s))
        if len(tried) < 30:
            raise BusError("Timeout!")
        return bus

    monkeypatch.setattr("zbridge.app.joining.open_bus", open_bus)
    assert await join_bus(plan({"robot": {"name": "r1"}, "device": NOWHERE}), Metrics()) is bus
    assert [within_s for _, within_s in tried[:4]] == [1.0, 2.0, 4.0, 4.0]
    pauses = [after - before for (before, _), (after, _) in itertools.pairwise(tried)]
    assert 0.5 * RETRY_S <= min(pauses) < 0.9 * RETRY_S
    assert 1.1 * RETRY_S < max(pauses) <= 1.5 * RETRY_S


@pytest.mark.parametrize(
    ("bus", "reasons"),
    [
        ({}, ()),
        ({"multicast": False, "listen": ["tcp/127.0.0.1:0"]}, ()),
        ({"mode": "router", "listen": ["tcp/127.0.0.1:0"]}, ()),
        ({"mode": "client"}, ("no bus",)),
        ({"connect": ["tcp/127.0.0.1:1"]}, ("no bus",)),
        ({"mode": "peer", "connect": ["tcp/127.0.0.1:1"]}, ("no bus",)),
        ({"connect": ["tls/127.0.0.1:1"], "tls": {"ca": "ca.pem"}}, ("no bus",)),
    ],
    ids=str,
)
def test_a_peer_that_is_told_of_nobody_is_ready_alone_and_a_client_without_its_router_is_not(
    bus: dict[str, Any], reasons: tuple[str, ...]
) -> None:
    listener = {"protocol": "tcpudp", "listen": "tcp://127.0.0.1:11002"}
    assert Gateway(plan({"robot": {"name": "r1"}, "hq": [listener], "bus": bus})).missing() == reasons
