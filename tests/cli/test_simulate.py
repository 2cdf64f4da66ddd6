"""``zbridge simulate``: what it starts."""

from __future__ import annotations

import asyncio

import pytest

from zbridge.cli.app import simulate_robot
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Simulation, find_protocol


async def test_a_simulated_robot_streams_pictures_too(capsys: pytest.CaptureFixture[str]) -> None:
    listening = asyncio.Event()
    simulation = Simulation((Address("127.0.0.1", 0),), ready=lambda addresses: listening.set())
    work = asyncio.create_task(simulate_robot(find_protocol("tcpudp"), simulation, "127.0.0.1:0"))
    async with asyncio.timeout(20.0):
        while not (listening.is_set() and "camera at http://127.0.0.1:" in capsys.readouterr().out):
            assert not work.done(), work.exception()
            await asyncio.sleep(0.01)
    work.cancel()
    await asyncio.gather(work, return_exceptions=True)
