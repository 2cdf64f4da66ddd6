"""A simulated robot at a UDP port, and who reaches it there by datagrams alone."""

from __future__ import annotations

import asyncio

import msgspec
import pytest

from zbridge.cli.simulate import SimulateOptions, simulation_of
from zbridge.doctor.probe import shake_hands
from zbridge.errors import ConfigError
from zbridge.protocol.address import Address, DatagramAddress
from zbridge.protocol.plugin import find_protocol


async def test_a_simulated_robot_listens_at_a_udp_port_and_is_probed_there() -> None:
    protocol = msgspec.structs.replace(find_protocol("alf"), datagrams=True)
    simulation = simulation_of(protocol, SimulateOptions(listen=("udp://127.0.0.1:0",)))
    listens: asyncio.Future[tuple[Address, ...]] = asyncio.get_running_loop().create_future()
    simulation = msgspec.structs.replace(simulation, ready=listens.set_result)
    robot = asyncio.create_task(protocol.simulate(simulation))
    try:
        (address,) = await asyncio.wait_for(listens, 2.0)
        assert isinstance(address, DatagramAddress)
        probed = await shake_hands(protocol, address)
        assert (probed.established, probed.session.transport) == (True, "udp"), probed
    finally:
        robot.cancel()
        await asyncio.gather(robot, return_exceptions=True)


def test_a_robot_of_another_protocol_is_simulated_at_tcp_ports_only() -> None:
    with pytest.raises(ConfigError, match=r"--listen 'udp://127\.0\.0\.1:0': expected tcp://host:port"):
        simulation_of(find_protocol("alf"), SimulateOptions(listen=("udp://127.0.0.1:0",)))
