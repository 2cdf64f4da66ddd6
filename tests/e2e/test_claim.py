"""One gateway per robot, on a real bus: forged claims, two that start together, and networks that were cut in two."""

from __future__ import annotations

import asyncio
import contextlib
import random
import subprocess
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import msgpack
import pytest
import zenoh

from tests.e2e.conftest import WAIT_S, Bench, Fleet, end, free_port, until
from tests.e2e.robots import ScriptedRobot
from zbridge.bus import Bus, BusSettings, open_bus
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics
from zbridge.robot.ownership import WATCH_S, Ownership

KEYS = KeySpace("fleet", "r1")
CLAIM = "fleet/r1/@rpc/claim/gateway"
TOLD = "another gateway serves this robot too: "
LEFT = "another gateway served r1 before this one: leaving it alone"


@pytest.fixture
def robot() -> Iterator[ScriptedRobot]:
    with contextlib.closing(ScriptedRobot()) as scripted:
        yield scripted


def joined(*endpoints: str, mode: str = "client") -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", f'"{mode}"')
    config.insert_json5("listen/endpoints", "[]")  # a router listens at one port for all, if it is told nothing
    config.insert_json5("connect/endpoints", str(list(endpoints)).replace("'", '"'))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def reason(bench: Bench) -> str:
    return bench.fleet.last("r1/status").get("reason") or ""


@pytest.mark.parametrize(("held_s", "plausible"), [(1e300, False), (3600.0, True)])
def test_a_forged_claim_takes_the_robot_from_nobody_and_a_plausible_one_is_told(
    bench: Bench, robot: ScriptedRobot, held_s: float, plausible: bool
) -> None:
    bench.serve("r1", robot.port)
    forged = msgpack.packb({"zid": "0", "held_s": held_s, "has": True})
    with joined(bench.endpoint) as forger:
        zid = str(forger.zid())
        asked: list[zenoh.Query] = []

        def answer(query: zenoh.Query) -> None:
            query.reply(CLAIM, forged)
            asked.append(query)

        forger.declare_queryable(CLAIM, answer)
        forger.liveliness().declare_token("fleet/r1/@alive/gateway")
        bench.fleet.session.close()
        bench.fleet = Fleet(bench.router())
        until(lambda: bench.fleet.state("r1") == "established", what="the gateway on the bus again")
        until(lambda: asked, WAIT_S + WATCH_S, what="a look at the forged claim")
        count = len(asked)
        until(lambda: len(asked) > count, WAIT_S + WATCH_S, what="another look")
        assert (robot.connections, bench.fleet.state("r1")) == (1, "established")
        if plausible:
            until(lambda: reason(bench) == TOLD + zid, what="status that names the forger")
            (refused,) = until(lambda: bench.fleet.last("r1/control").get("refusals"))
            assert (refused["who"], refused["command"], refused["code"]) == (zid, "claim", "held")
    until(lambda: reason(bench) == "", WAIT_S + WATCH_S, what="status without the forger")
    bench.fleet.session.close()


class Halves:
    """Two networks that know nothing of each other until they are joined."""

    def __init__(self, bench: Bench, stack: contextlib.ExitStack, folder: Path) -> None:
        self.bench = bench
        self.other = f"tcp/127.0.0.1:{free_port()}"
        self._stack = stack
        self._folder = folder
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", f'["{self.other}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        self.far = Fleet(stack.enter_context(zenoh.open(config)))

    def gateway(self, port: int) -> subprocess.Popen[str]:
        """Start a gateway in the other half."""
        file = self.bench.configuration("r1", port)
        far = self._folder / "far.toml"
        far.write_text(file.read_text().replace(self.bench.endpoint, self.other))
        return self.bench.zbridge("run", str(far))

    def join(self) -> None:
        self._stack.enter_context(joined(self.bench.endpoint, self.other, mode="router"))


@pytest.fixture
def halves(bench: Bench, tmp_path: Path) -> Iterator[Halves]:
    with contextlib.ExitStack() as stack:
        yield Halves(bench, stack, tmp_path)


def test_of_two_that_meet_the_one_that_has_the_robot_keeps_it(bench, halves, robot) -> None:
    second = halves.gateway(free_port())  # it serves the robot for longer, and never reaches it
    until(halves.far.tokens, what="a gateway that serves the robot")
    first = bench.serve("r1", robot.port)
    halves.join()
    assert second.stdout is not None
    assert any(LEFT in line for line in second.stdout)
    until(lambda: bench.fleet.state("r1") == "established", what="its status again")
    assert LEFT not in end(first)
    assert robot.connections == 1


def test_where_both_have_the_robot_both_keep_it_and_tell(bench: Bench, halves: Halves) -> None:
    port = free_port()
    bench.simulator(port)
    first, second = bench.gateway("r1", port), halves.gateway(port)
    until(lambda: bench.fleet.state("r1") == halves.far.state("r1") == "established", what="both have it")
    halves.join()
    until(lambda: told(bench), WAIT_S + WATCH_S, what="both tell")
    for gateway in (first, second):
        output = end(gateway)
        assert output.count(TOLD) == 1
        assert LEFT not in output


def told(bench: Bench) -> bool:
    """Whether both gateways, on the one key, have named each other."""
    reasons = {str(status["reason"]) for status in bench.fleet.seen["fleet/r1/status"]}
    return len([reason for reason in reasons if TOLD in reason]) == 2


# Starting together


@contextlib.asynccontextmanager
async def claims(settings: list[BusSettings]) -> AsyncIterator[list[Ownership]]:
    buses: list[Bus] = list(await asyncio.gather(*(open_bus(each, Metrics()) for each in settings)))
    try:
        yield [Ownership(bus, KEYS) for bus in buses]
    finally:
        await asyncio.gather(*(bus.close() for bus in buses))


async def settled(settings: list[BusSettings], apart_s: float) -> int:
    """Start gateways at nearly the same moment; count how many serve the robot when all has settled."""
    async with claims(settings) as contending:

        async def serve(claim: Ownership, after_s: float) -> None:
            await asyncio.sleep(after_s)
            await claim.take()
            await claim.watch(lambda: False, lambda zids: None)

        tasks = [asyncio.create_task(serve(claim, random.uniform(0.0, apart_s))) for claim in contending]
        await asyncio.sleep(2.0 + apart_s)
        held = [repr(claim) for claim in contending].count("<Ownership r1 held>")
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        return held


async def start_together(times: int) -> list[int]:
    """Start two so many times: through a router, and directly linked."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = await open_bus(BusSettings(mode="router", listen=(endpoint,), multicast=False), Metrics())
    try:
        through = 2 * [BusSettings(connect=(endpoint,), multicast=False)]
        served = [await settled(through, 0.3 * (number % 3)) for number in range(times)]
    finally:
        await router.close()
    for number in range(times):
        near = f"tcp/127.0.0.1:{free_port()}"
        direct = [
            BusSettings(mode="peer", listen=(near,), multicast=False),
            BusSettings(mode="peer", connect=(near,), multicast=False),
        ]
        served.append(await settled(direct, 0.3 * (number % 3)))
    return served


async def test_of_two_that_start_together_one_serves_the_robot() -> None:
    assert await start_together(2) == [1] * 4
