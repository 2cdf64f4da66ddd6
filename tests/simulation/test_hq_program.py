"""An HQ program to play with: what it prints, and that it drives only after neutral, and leaves with it."""

from __future__ import annotations

import asyncio

import pytest

from zbridge.simulation.hq_program import LET_GO_S, NEUTRAL_S, HqProgram

pytestmark = pytest.mark.jumping


class Toy(HqProgram):
    """Is ready after 2 s, and notes what it is told."""

    def __init__(self, fails: OSError | None = None) -> None:
        super().__init__()
        self.told: list[tuple[float, str]] = []
        self.seen = "nothing"
        self._fails = fails
        self._ready = ""
        self._begun = asyncio.get_running_loop().time()

    @property
    def now(self) -> float:
        return round(asyncio.get_running_loop().time() - self._begun, 1)

    async def run(self, host: str, port: int) -> None:
        if self._fails is not None:
            raise self._fails
        await asyncio.sleep(2.0)
        self._ready = "connected"
        self._event("it reads no more")
        await asyncio.sleep(8.0)
        self.alive, self.death = False, "a bad packet"

    @property
    def agreed(self) -> str:
        return self._ready

    def shown(self) -> str:
        return self.seen

    async def neutral(self) -> None:
        self.told.append((self.now, "neutral"))

    async def push(self, forward: float, turn: float) -> None:
        self.told.append((self.now, f"{forward} {turn}"))
        self.seen = "a robot that moves"


async def test_it_prints_what_happens_and_drives_once_it_has_sent_neutral_for_a_while(capsys) -> None:
    toy = Toy()
    await toy.simulate("robot", 1, (0.3, -0.2))
    assert capsys.readouterr().out.splitlines() == [
        *("connecting to robot:1", "connected", "it reads no more", "is shown nothing", "sends neutral"),
        *("drives: forward 0.3, turn -0.2", "is shown a robot that moves", "died: a bad packet"),
    ]
    (at, neutral), (then, pushed) = toy.told
    assert (neutral, pushed) == ("neutral", "0.3 -0.2")
    assert 2.0 <= at <= 2.2
    assert then - at == pytest.approx(NEUTRAL_S)


@pytest.mark.parametrize(("drive", "told"), [((0.3, 0.0), ["neutral", "0.3 0.0", "neutral"]), (None, [])])
async def test_a_program_that_is_ended_sends_neutral_before_it_leaves(drive, told: list[str], capsys) -> None:
    toy = Toy()
    running = asyncio.create_task(toy.simulate("robot", 1, drive))
    await asyncio.sleep(5.0)
    running.cancel()
    with pytest.raises(asyncio.CancelledError):
        await running
    assert [text for _, text in toy.told] == told
    assert toy.now == pytest.approx(5.0 + (LET_GO_S if drive else 0.0), abs=0.11)
    assert ("stops driving" in capsys.readouterr().out) is bool(drive)


async def test_nobody_listening_is_an_error() -> None:
    with pytest.raises(ConnectionRefusedError):
        await Toy(ConnectionRefusedError()).simulate("robot", 1, (1.0, 0.0))
