"""Many gateways in one process: what one of them raises ends it alone, and it begins anew."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator

import pytest

from tests.fake_bus import FakeBus
from zbridge.app import GatewayPlan, plan
from zbridge.app.gateway import Gateway, Neighbourhood
from zbridge.app.joining import RECONNECTS_S, STUCK_S
from zbridge.bus import Bus
from zbridge.errors import LinkError
from zbridge.host.settings import HostSettings
from zbridge.host.together import LONGEST_PAUSE_S, Together

pytestmark = pytest.mark.jumping

NAMES = ("r1", "r2", "r3")
DEVICE = {"protocol": "tcpudp", "connect": ["tcp://127.0.0.1:1"]}


def planned(name: str) -> GatewayPlan:
    return plan({"robot": {"name": name}, "device": DEVICE})


class Played:
    """Gateways that only say when they begin and end; those in ``faults`` raise after a second."""

    def __init__(self) -> None:
        self.begun: list[tuple[str, float]] = []
        self.ended: list[str] = []
        self.faults: dict[str, Exception] = {}
        self.parts: set[float] = set()
        self.buses: dict[str, Bus] = {}

    async def run_on(self, gateway: Gateway, bus: Bus, neighbourhood: Neighbourhood) -> None:
        name, loop = repr(gateway).removeprefix("<Gateway ").removesuffix(">"), asyncio.get_running_loop()
        self.begun.append((name, loop.time()))
        self.buses[name] = bus
        self.parts.add(neighbourhood.part)
        gateway.metrics.count("begun").value += 1
        bus.announce(f"fleet/{name}/@alive/gateway")
        try:
            if name in self.faults:
                await asyncio.sleep(1.0)
                raise self.faults[name]
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.5)  # its robot is stopped
            self.ended.append(name)


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Played:
    played = Played()
    monkeypatch.setattr(Gateway, "run_on", lambda gateway, bus, near: played.run_on(gateway, bus, near))
    monkeypatch.setattr("zbridge.host.together.time.monotonic", lambda: asyncio.get_running_loop().time())
    return played


@contextlib.asynccontextmanager
async def together(monkeypatch: pytest.MonkeyPatch, host: HostSettings | None = None) -> AsyncIterator[Together]:
    bus = FakeBus("1")

    async def open_bus(*_: object, **__: object) -> Bus:
        return bus

    monkeypatch.setattr("zbridge.app.joining.open_bus", open_bus)
    plans = {name: planned(name) for name in NAMES}
    served = Together(plans, host or HostSettings(together=True), lambda plan: contextlib.nullcontext())
    running = asyncio.create_task(served.run())
    await asyncio.sleep(0.5)
    try:
        yield served
    finally:
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running


async def test_gateways_start_one_after_the_other_and_end_all_at_once(monkeypatch, played: Played) -> None:
    async with together(monkeypatch, HostSettings(together=True, stagger_s=0.1, share=0.5)) as served:
        assert len(served) == 3
        assert [name for name, _ in played.begun] == list(NAMES)
        assert 0.05 < played.begun[-1][1] - played.begun[0][1] < 0.35
        assert played.parts == {0.5}
        before = asyncio.get_running_loop().time()
    assert asyncio.get_running_loop().time() - before < 1.0
    assert sorted(played.ended) == list(NAMES)


@pytest.mark.parametrize("fault", [ZeroDivisionError("of a translator"), LinkError("tcp://127.0.0.1:1: in use")])
async def test_a_gateway_that_fails_begins_anew_after_a_growing_pause_and_the_others_go_on(
    monkeypatch, played: Played, caplog, fault: Exception
) -> None:
    played.faults["r2"] = fault
    async with together(monkeypatch) as served:
        await asyncio.sleep(300.0)
        times = [at for name, at in played.begun if name == "r2"]
        pauses = [after - before - 1.5 for before, after in itertools.pairwise(times)]
        assert 5 < len(times) < 15
        assert pauses[0] < 1.0
        assert all(pause > LONGEST_PAUSE_S / 2 for pause in pauses[7:])
        assert [name for name, _ in played.begun if name != "r2"] == ["r1", "r3"]
        assert served.metrics.total("gateway_failures") == len(times) - (len(times) > len(played.ended))
        assert served.metrics.total("begun", robot="r2") == len(times)
        del played.faults["r2"]
        await asyncio.sleep(2 * LONGEST_PAUSE_S)
        failed = served.metrics.total("gateway_failures")
        await asyncio.sleep(300.0)
        assert served.metrics.total("gateway_failures") == failed
    assert str(fault) in caplog.text


async def test_one_robot_is_stopped_and_started_again_while_the_others_stay(monkeypatch, played: Played) -> None:
    async with together(monkeypatch) as served:
        watch = FakeBus.join(played.buses["r1"], "2")  # type: ignore[arg-type]
        await served.stop("r2")
        await served.stop("r2")
        assert played.ended == ["r2"]
        assert await watch.alive("fleet/*/@alive/gateway") == [f"fleet/{name}/@alive/gateway" for name in ("r1", "r3")]
        served.start("r2", planned("r2"))
        with pytest.raises(ValueError, match="'r2': is already running"):
            served.start("r2", planned("r2"))
        await asyncio.sleep(0.1)
        assert len(await watch.alive("fleet/*/@alive/gateway")) == 3


async def test_all_robots_move_to_a_new_session_where_the_first_one_does_not_connect_again(
    monkeypatch, played: Played
) -> None:
    opened: list[FakeBus] = []

    async def open_bus(*_: object, **__: object) -> Bus:
        opened.append(FakeBus(f"{len(opened)}"))
        return opened[-1]

    monkeypatch.setattr("zbridge.app.joining.open_bus", open_bus)
    bus = {"connect": ["tcp/127.0.0.1:1"]}
    plans = {name: plan({"robot": {"name": name}, "device": DEVICE, "bus": bus}) for name in NAMES}
    running = asyncio.create_task(
        Together(plans, HostSettings(together=True), lambda plan: contextlib.nullcontext()).run()
    )
    await asyncio.sleep(10.0)
    opened[0].connection(False)
    await asyncio.sleep(STUCK_S + RECONNECTS_S + 10.0)
    assert len(opened) == 3, "the first, one to try, and the new one"
    assert sorted(played.ended) == sorted(NAMES)
    assert [await opened[-1].alive(f"fleet/{name}/@alive/gateway") for name in NAMES] == [
        [f"fleet/{name}/@alive/gateway"] for name in NAMES
    ]
    running.cancel()
    await asyncio.wait([running])
