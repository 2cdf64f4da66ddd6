"""How robots are, as monitoring asks."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from tests.clock import jumping
from tests.fake_bus import FakeBus
from zbridge.client import Fleet
from zbridge.client.health import Health, HealthLevel, health, judge, same_addresses
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import LinkStatus, Status

OK, WARNING, CRITICAL = HealthLevel
SILENT = "its gateway has published nothing for 3 s"


@pytest.mark.parametrize(
    ("status", "heard", "expected"),
    [
        (None, False, Health(CRITICAL, None, "no gateway serves it")),
        (Status("established", host="lab1"), True, Health(OK, "established", None, "lab1")),
        (Status("established", "client id 3"), True, Health(WARNING, "established", "client id 3")),
        (Status("established"), False, Health(CRITICAL, "established", SILENT)),
        (Status("handshaking"), True, Health(WARNING, "handshaking")),
        (Status("connecting"), True, Health(WARNING, "connecting")),
        (Status("closing", "bye"), True, Health(WARNING, "closing", "bye")),
        (Status("offline", "no route"), True, Health(CRITICAL, "offline", "no route")),
    ],
)
def test_a_status_is_judged(status: Status | None, heard: bool, expected: Health) -> None:
    assert judge(status, fresh=heard) == expected


def at(peer: str, *, shared: bool = False) -> Status:
    return Status("established", links=(LinkStatus("robot", "established", peer, shared=shared),))


def test_robots_of_one_address_name_each_other_unless_they_share_it_or_the_address_is_of_one_machine() -> None:
    twice, here, line = "tcp://192.0.2.7:11001", "tcp://127.0.0.1:11001", "serial:///dev/ttyUSB0?baud=9600"
    statuses = {"r1": at(twice), "r2": at(twice), "r3": at("tcp://192.0.2.7:11002"), "r4": at(here), "r5": at(here)}
    statuses |= {"r6": at(line), "r7": at(line), "r8": at("tcp://[::1]:1"), "r9": at("tcp://[::1]:1")}
    statuses |= {"s1": at("tcp://[2001:db8::1]:1", shared=True), "s2": at("tcp://[2001:db8::1]:1", shared=True)}
    assert same_addresses(statuses) == {
        "r1": f"{twice} is the address of r2 too",
        "r2": f"{twice} is the address of r1 too",
    }
    many = same_addresses({f"r{number}": at(twice) for number in range(500)})
    assert many["r499"] == f"{twice} is the address of r0, r1, r10, r100 too"
    assert many["r0"] == f"{twice} is the address of r1, r10, r100 too"


class Gateways:
    """Gateways on a fake bus: the last value of each is known, and some publish theirs every second."""

    def __init__(self) -> None:
        self.bus = FakeBus("1")
        self.fleet = Fleet(self.bus.join("2"))
        self.status = Status("established")

    async def publish(self, *robots: str) -> None:
        publishers = [self.bus.publisher(f"fleet/{robot}/status", topics.STATUS) for robot in robots]
        while True:
            for publisher in publishers:
                publisher.put(payloads.encode(self.status))
            await asyncio.sleep(1.0)

    async def ask(self, robot: str | None, *lively: str) -> dict[str, str]:
        task = asyncio.ensure_future(self.publish(*lively))
        await asyncio.sleep(0.5)
        try:
            found = await health(self.fleet, robot)
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        return {name: each.level.name for name, each in found.items()}


@jumping
async def test_all_robots_of_the_bus_are_judged_within_a_little_more_than_a_second() -> None:
    began = asyncio.get_running_loop().time()
    assert await Gateways().ask(None, "r1", "r2") == {"r1": "OK", "r2": "OK"}
    assert asyncio.get_running_loop().time() - began < 3.0


@jumping
async def test_robots_of_one_address_are_a_warning_also_where_one_of_them_was_asked_for() -> None:
    gateways = Gateways()
    gateways.status = at("tcp://192.0.2.7:11001")
    assert await gateways.ask(None, "r1", "r2") == {"r1": "WARNING", "r2": "WARNING"}
    assert await gateways.ask("r1", "r1", "r2") == {"r1": "WARNING"}


@jumping
async def test_a_gateway_that_only_has_its_last_value_is_critical() -> None:
    gateways = Gateways()
    token = gateways.bus.announce("fleet/r3/@alive/gateway")
    assert await gateways.ask(None, "r1") == {"r1": "OK", "r3": "CRITICAL"}
    token.close()


@jumping
async def test_a_robot_that_was_asked_for_is_judged_alone() -> None:
    gateways = Gateways()
    assert await gateways.ask("r1", "r1", "r2") == {"r1": "OK"}
    assert await gateways.ask("r9", "r1", "r2") == {"r9": "CRITICAL"}


@jumping
async def test_an_empty_bus_has_no_robots() -> None:
    assert await Gateways().ask(None) == {}
