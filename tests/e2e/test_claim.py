"""One gateway per robot, on a real bus: forged claims, two that start together, and networks that were cut in two."""

from __future__ import annotations

import contextlib
import os
import signal
import time

import msgpack
import pytest
import zenoh

from tests.e2e.conftest import WAIT_S, Bench, Fleet, Gateway, configuration, device, end, start, until
from tests.e2e.rigs.relay import Relay
from tests.e2e.rigs.robots import Robot
from tests.e2e.rigs.supervised import Supervised
from tests.machine import Patience
from tests.ports import free_port
from tests.proofs import packed
from zbridge.app.serving import SECOND_CONNECTION
from zbridge.robot.claim_bus import CLOSE_S, WATCH_S

CLAIM = "fleet/r1/@rpc/claim/gateway"
TOLD = "another gateway serves this robot too: "
LEFT = "another gateway serves r1: leaving it alone"
YIELDED = "r1: another gateway serves it: leaving the robot alone, and staying connected"
AGAIN = "r1: no other gateway has a better claim: serving it again"
LOOK_S = WAIT_S + WATCH_S


@pytest.mark.parametrize(("held_s", "plausible"), [(1e300, False), (3600.0, True)])
def test_a_forged_claim_takes_the_robot_from_nobody_and_a_plausible_one_is_told(
    bench: Bench, robot: Robot, held_s: float, plausible: bool
) -> None:
    bench.serve(robot.port)
    forged, asked = packed({"zid": "0", "held_s": held_s, "has": True}), list[zenoh.Query]()

    def answer(query: zenoh.Query) -> None:
        query.reply(CLAIM, forged)
        asked.append(query)

    with zenoh.open(configuration("client", bench.endpoint)) as forger:
        zid = str(forger.zid())
        forger.declare_queryable(CLAIM, answer)
        forger.liveliness().declare_token("fleet/r1/@alive/gateway")
        with bench.bus_away():
            pass
        until(lambda: bench.fleet.state() == "established", what="the gateway on the bus again")
        for _ in range(2):
            count = len(asked)
            until(lambda count=count: len(asked) > count, LOOK_S, what="a look at the forged claim")  # type: ignore[misc]
        assert (robot.connections, bench.fleet.state()) == (1, "established")
        if plausible:
            until(lambda: bench.fleet.reason() == TOLD + zid, what="status that names the forger")
            until(lambda: bench.fleet.refusal(who=zid, command="claim", code="held"), what="control that names it")
    until(lambda: bench.fleet.reason() == "", LOOK_S, what="status without the forger")
    bench.fleet.session.close()


def test_another_robot_name_with_the_same_address_is_refused_on_one_machine_and_a_standby_is_not(
    bench: Bench, robot: Robot
) -> None:
    bench.serve(robot.port)
    other, file = device(robot.port).replace("127.0.0.1", "localhost"), bench.folder / "r2.toml"
    file.write_text(f'[robot]\nname = "r2"\n{other}')
    whose = f"r2.toml: device.connect = ['tcp://localhost:{robot.port}']: expected an address of its own: fleet/r1"
    for command in ("check", "run"):
        process = start(command, str(file))
        said = end(process, signal.SIGCONT, 20)
        assert process.returncode == 2, said
        assert whose in said.splitlines()[-1]
        assert "allow_shared_address" in said
    (bench.folder / "two").mkdir()
    for name in ("r3", "r4"):
        (bench.folder / "two" / f"{name}.toml").write_text(f'[robot]\nname = "{name}"\n{device(1)}')
    process = start("run", str(bench.folder / "two"))
    assert "r4.toml: device.connect: expected another address than that of" in end(process, signal.SIGCONT, 20)
    assert process.returncode == 2
    standby = bench.gateway(device(robot.port), name="standby")
    until(lambda: "another gateway serves r1: waiting until it goes" in standby.log, what="a standby")
    assert robot.connections == 1


# Two networks that know nothing of each other until they are joined


def apart(bench: Bench, port: int, other_port: int) -> tuple[Gateway, Gateway, zenoh.Config]:
    """Start a gateway of the one robot on each; give them, and the configuration of what joins the networks.

    Only that of the bench need reach the robot.
    """
    other = f"tcp/127.0.0.1:{free_port()}"
    far = Fleet(bench.stack.enter_context(zenoh.open(configuration("router", other))))
    second = bench.gateway(device(other_port), name="far", endpoint=other)
    until(far.tokens, what="a gateway that serves the robot for longer")
    first = bench.serve(port)
    if port == other_port:
        until(lambda: far.state() == "established", what="both have it")
    joined = configuration("client", bench.endpoint, other)
    joined.insert_json5("mode", '"router"')
    joined.insert_json5("listen/endpoints", "[]")  # a router listens at one port for all, if it is told nothing
    return first, second, joined


def test_of_two_that_meet_the_one_that_has_the_robot_keeps_it(bench: Bench, robot: Robot) -> None:
    first, second, joined = apart(bench, robot.port, free_port())
    with zenoh.open(joined):
        until(lambda: LEFT in second.log, LOOK_S, what="the other one leaves it alone")
        until(lambda: bench.fleet.state() == "established", what="its status again")
    assert LEFT not in first.end()
    assert robot.connections == 1


def granted(bench: Bench) -> int:
    """Ask all gateways for the lease; how many grant it? It is given back by not being renewed."""
    replies = bench.fleet.session.get(
        "fleet/r1/@rpc/control/takeover/judge",
        payload=packed({"who": "judge", "lease_s": 0.1}),
        target=zenoh.QueryTarget.ALL,
        timeout=1.0,
    )
    return sum(bool(reply.ok and msgpack.unpackb(reply.ok.payload.to_bytes())["ok"]) for reply in replies)


def test_where_both_have_the_robot_one_leaves_it_alone_and_stays_connected(bench: Bench) -> None:
    port = bench.simulator()
    first, second, joined = apart(bench, port, port)
    with zenoh.open(joined):
        until(lambda: [YIELDED in each.log for each in (first, second)].count(True) == 1, LOOK_S, what="one yields")
        until(lambda: bench.fleet.reason() == SECOND_CONNECTION, what="the owner's status")
        assert granted(bench) == 1
        bench.fleet.hold(how="takeover")
        time.sleep(WATCH_S)
        assert not bench.fleet.lost()
    for gateway in (first, second):
        end(gateway.process)
        assert LEFT not in gateway.log


@pytest.mark.long
def test_a_standby_that_took_over_during_a_silent_cut_yields_within_2_s_and_steps_in_when_the_owner_goes(
    bench: Bench,
) -> None:
    port = bench.simulator()
    with contextlib.closing(Relay(int(bench.endpoint.rpartition(":")[2]))) as relay:
        first = bench.gateway(device(port), name="first", endpoint=f"tcp/127.0.0.1:{relay.port}")
        until(lambda: bench.fleet.state() == "established", what="established")
        second = bench.gateway(device(port), name="standby")
        until(lambda: "waiting until it goes" in second.log, what="a standby")
        relay.cut()
        cut_at = time.monotonic()
        until(lambda: "established" in second.log, what="the standby takes over")
        while time.monotonic() < cut_at + 8.0:
            time.sleep(0.1)
        patience = Patience(2.0)
        relay.heal()
        while not (YIELDED in second.log and granted(bench) == 1):
            assert not patience.over, "exactly one grants leases within 2 s"
            time.sleep(0.05)
        assert YIELDED not in first.log, "the older connection is kept"
        until(lambda: bench.fleet.reason() == SECOND_CONNECTION, what="the owner's status")
        bench.fleet.hold(how="takeover")
        for _ in range(30):
            bench.fleet.put("r1/@cmd/drive", forward=0.1)
            time.sleep(0.1)
        assert not bench.fleet.lost()
        assert "robot: established" in second.log
        assert "next attempt" not in second.log, "its connection is kept"
        bench.fleet.put("r1/@cmd/stop", id=b"\x07" * 16, latch=True, who="ann")
        until(lambda: bench.fleet.last("r1/control").get("state") == "latched", what="latched")
        time.sleep(2 * CLOSE_S)
        first.end()
        until(lambda: AGAIN in second.log, what="it serves the robot again")
        until(lambda: bench.fleet.reason() == "" and bench.fleet.state() == "established", what="its status")
        until(lambda: bench.fleet.last("r1/control").get("state") == "latched", what="its latched stop")
        assert [latch["who"] for latch in bench.fleet.last("r1/control")["latches"]] == ["ann"]
        assert "next attempt" not in second.log, "its connection is kept"
        second.end()


def test_a_gateway_that_stands_aside_does_so_after_a_restart_and_after_a_crash_and_keeps_its_connection(
    bench: Bench,
) -> None:
    port, other, folder = bench.simulator(), f"tcp/127.0.0.1:{free_port()}", bench.folder / "robots"
    far = Fleet(bench.stack.enter_context(zenoh.open(configuration("router", other))))
    owner = bench.gateway(device(port), name="far", endpoint=other)
    until(lambda: far.state() == "established", what="the owner has the robot")
    folder.mkdir()
    file = folder / "r1.toml"
    bus = f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n'
    file.write_text(f'[robot]\nname = "r1"\n{device(port)}{bus}')
    supervised = Supervised(bench.stack, folder)
    until(lambda: bench.fleet.state() == "established", what="the other one has it too")
    joined = configuration("client", bench.endpoint, other)
    joined.insert_json5("mode", '"router"')
    joined.insert_json5("listen/endpoints", "[]")
    with zenoh.open(joined):
        until(lambda: YIELDED in supervised.log, LOOK_S, what="it yields")
        process = supervised.gateway("r1")
        file.write_text(file.read_text() + "[control]\nlease_s = 4.0\n")
        supervised.reload()
        successor = supervised.gateway("r1", not_pid=process)
        until(lambda: "handed over" in supervised.log, what="a restart")
        assert granted(bench) == 1
        bench.simulators[port].send_signal(signal.SIGSTOP)
        time.sleep(0.5)  # nobody can take over the connection of a process that dies while it reads
        os.kill(successor, signal.SIGKILL)
        bench.simulators[port].send_signal(signal.SIGCONT)
        supervised.gateway("r1", not_pid=successor)
        time.sleep(2 * CLOSE_S)
        assert granted(bench) == 1
        assert bench.fleet.reason() == SECOND_CONNECTION
        assert AGAIN not in supervised.log
        owner.end()
        until(lambda: AGAIN in supervised.log, LOOK_S, what="it serves the robot again")
        bench.fleet.hold(how="takeover")
        assert supervised.log.count("robot: established") == 1, "one connection, from the first to the last"


def test_of_two_that_start_together_one_serves_the_robot(bench: Bench) -> None:
    port = bench.simulator()
    gateways = [bench.gateway(device(port), name=name) for name in ("one", "other")]
    until(lambda: bench.fleet.state() == "established", what="established")
    until(lambda: any("another gateway serves r1" in gateway.log for gateway in gateways), what="one that waits")
    assert sum("another gateway serves r1" in gateway.log for gateway in gateways) == 1
    assert bench.fleet.tokens() == ["fleet/r1/@alive/gateway"]
