"""Latched stops of real gateways: what they survive, who learns of them, and what old programs are told."""

from __future__ import annotations

import asyncio
import os
import signal
from typing import Any

import msgpack

from gateways.tcpudp.conformance.fragile_hq import FragileTcpUdpHq
from tests.e2e.conftest import HOST, Bench, ask, device, end, listener, start, until
from tests.e2e.measured.restarts import Restarted
from tests.e2e.rigs.hq_scene import playing, soon
from tests.ports import free_port


def latch(bench: Bench, robot: str, stop_id: bytes) -> None:
    """Latch a robot, or all (``*``), until the gateways show it."""
    fields = {"latch": True, "id": stop_id, "who": "ann", "reason": "a cable is loose"}

    def shown() -> bool:
        bench.fleet.session.put(f"fleet/{robot}/@cmd/stop", msgpack.packb(fields))
        return latched(bench, "r1" if robot == "*" else robot, stop_id)

    until(shown, what=f"{robot} latched")
    if robot != "*":
        until(lambda: stop_id in bench.fleet.last(f"{robot}/control")["stops"], what="it is written down")


def latched(bench: Bench, robot: str, stop_id: bytes) -> bool:
    control = bench.fleet.last(f"{robot}/control")
    return control.get("state") == "latched" and stop_id in [each["id"] for each in control["latches"]]


def asked(bench: Bench, robot: str, how: str, **fields: Any) -> dict[str, Any]:
    """Ask the gateway of a robot, as anybody may on an open bus; ask again where none is there yet."""

    def answers() -> list[dict[str, Any]]:
        found = ask(bench.fleet.session, f"fleet/{robot}/@rpc/control/{how}/op1", msgpack.packb(fields))
        passing = ("not_ready", "closing")  # it starts, or another process takes the robot over
        return [] if found and found[0].get("code") in passing else found

    answer: dict[str, Any] = until(answers, what="an answer")[0]
    return answer


def refused(bench: Bench, robot: str) -> bool:
    answer = asked(bench, robot, "acquire", who="op1")
    assert answer.get("code") == "latched" or answer.get("ok"), answer
    return answer.get("code") == "latched"


def test_a_latched_robot_stays_so_over_a_restart_a_kill_and_a_new_start_until_its_ids_are_released(
    bench: Bench,
) -> None:
    port, one, other = bench.simulator(), os.urandom(16), os.urandom(16)
    gateway = Restarted(bench, bench.serve(port))
    latch(bench, "r1", one)
    bench.fleet.put("r1/@cmd/stop", id=os.urandom(16))  # a plain one
    assert gateway.ask() == [{}]
    assert refused(bench, "r1")
    latch(bench, "r1", other)
    os.kill(gateway.pid, signal.SIGKILL)
    bench.gateway(device(port))
    for stop_id in (one, other):
        assert refused(bench, "r1")
        until(lambda stop_id=stop_id: latched(bench, "r1", stop_id), what="the latch")
        assert asked(bench, "r1", "unlatch_fleet", id=stop_id)["code"] == "unsupported"
        assert asked(bench, "r1", "unlatch", id=stop_id) == {}
    assert not refused(bench, "r1")


def test_a_gateway_that_was_away_adopts_the_fleets_latch_and_none_that_was_released(bench: Bench) -> None:
    one, other = os.urandom(16), os.urandom(16)
    bench.serve(bench.simulator())
    latch(bench, "*", one)
    bench.serve(bench.simulator(), robot="r2")
    assert refused(bench, "r2")
    until(lambda: latched(bench, "r2", one), what="the latched stop of the fleet")
    latch(bench, "*", other)
    assert asked(bench, "r1", "unlatch_fleet", id=one) == {}
    bench.serve(bench.simulator(), robot="r3")
    assert refused(bench, "r3")
    until(lambda: latched(bench, "r3", other), what="the latched stop of the fleet")
    assert not latched(bench, "r3", one)
    assert asked(bench, "r2", "unlatch", id=one)["code"] == "unsupported"
    for robot in ("r1", "r2", "r3"):
        assert asked(bench, robot, "unlatch_fleet", id=other) == {}
    assert (refused(bench, "r1"), refused(bench, "r2"), refused(bench, "r3")) == (False, True, False)


def test_what_no_gateway_confirmed_is_said_and_a_gateway_that_was_frozen_is_latched_when_it_wakes(bench: Bench) -> None:
    bench.serve(bench.simulator())
    frozen = bench.serve(bench.simulator(), robot="r2")
    bench.fleet.hold("r2", "driver")
    frozen.signal(signal.SIGSTOP)
    stopping = start("stop", "--all", "--latch", "--connect", bench.endpoint)
    said = end(stopping, 0, within_s=20.0)
    assert said.splitlines()[-1] == "1 of 2 latched; r2 did not confirm"
    assert stopping.returncode == 1
    frozen.signal(signal.SIGCONT)
    until(lambda: bench.fleet.last("r2/control").get("state") == "latched", what="a latched robot")
    assert refused(bench, "r2")


def refused_with(program: FragileTcpUdpHq, reason: str) -> bool:
    """Let a program try to drive, neutral first: its gateway may have been frozen; whether it was told the reason."""
    program.idle()
    program.move(0.0, 1.0, 0.5)
    return any(reason in text for text in program.texts)


async def test_an_old_hq_program_is_told_who_latched_the_robot_and_drives_after_the_release(bench: Bench) -> None:
    port, stop_id = free_port(), os.urandom(16)
    gateway = bench.gateway(device(bench.simulator()), listener("tcp", "tcpudp", port))
    await soon(lambda: gateway.listens(1), "a listener")
    await soon(lambda: bench.fleet.state() == "established", "established")
    program = FragileTcpUdpHq()
    async with playing(program.run(HOST, port)):
        await soon(lambda: program.position, "a position")
        program.mode(2)
        await asyncio.to_thread(latch, bench, "r1", stop_id)
        await soon(lambda: refused_with(program, "latched by ann (a cable is loose)"), "the reason")
        assert bench.fleet.last("r1/control")["holder"] is None
        assert await asyncio.to_thread(asked, bench, "r1", "unlatch", id=stop_id) == {}
        program.idle()
        await asyncio.sleep(1.0)
        program.move(0.0, 1.0, 0.5)
        await soon(lambda: bench.fleet.last("r1/control")["holder"] == "hq.tcp.2", "the lease")
        program.idle()
