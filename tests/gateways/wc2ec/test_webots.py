"""The controller script for Webots, with a stand-in for Webots' own ``controller`` module and a real socket."""

import importlib.util
import math
import socket
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

SCRIPT = Path(__file__).parents[3] / "deploy/webots/zbridge_controller.py"
REGISTERED = bytes.fromhex("00350006") + b"wheel1" + bytes.fromhex("00350104") + b"lift" + bytes.fromhex("00250208")
REGISTERED += b"inf_left" + bytes.fromhex("00000306") + b"camera"
READING = bytes.fromhex("012502") + struct.pack("<d", 123.466747)


class DistanceSensor(Mock):
    """A device of Webots, like the next one: its methods answer and are asked afterwards."""


class Motor(Mock):
    pass


def answers(**methods: Any) -> dict[str, Any]:
    return {f"{method}.return_value": answer for method, answer in methods.items()}


class Simulation:
    """A robot, the script that serves it, and a gateway that is connected to the script."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wheel = Motor(**answers(getName="wheel1", getNodeType=53, getType=53, getMaxVelocity=10.0))
        self.lift = Motor(**answers(getName="lift", getNodeType=53, getType=46))
        sensor = DistanceSensor(**answers(getName="inf_left", getNodeType=37, getValue=123.466747))
        devices = [self.wheel, self.lift, sensor, Mock(**answers(getName="camera", getNodeType=0))]
        robot = Mock(getDeviceByIndex=devices.__getitem__, **answers(getNumberOfDevices=4))
        module = Mock(DistanceSensor=DistanceSensor, Motor=Motor, Node=Mock(ROTATIONAL_MOTOR=53, LINEAR_MOTOR=46))
        monkeypatch.setitem(sys.modules, "controller", module)
        spec = importlib.util.spec_from_file_location("zbridge_controller", SCRIPT)
        assert spec is not None
        assert spec.loader is not None
        script = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(script)
        self.bridge = script.Bridge(robot, 0)
        sensor.enable.assert_called_once_with(20)
        self.connect()

    def connect(self) -> None:
        self.gateway = socket.create_connection(("127.0.0.1", self.bridge.server.getsockname()[1]), 5)
        self.until(lambda: self.bridge.gateway is not None)

    def until(self, holds: Callable[[], bool]) -> None:
        """Let steps pass until something is so: what a socket carries takes a moment."""
        for _ in range(100_000):
            self.bridge.step()
            if holds():
                return
        raise AssertionError("not so after many steps")

    def told(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            self.bridge.step()
            data += self.gateway.recv(count - len(data))
        return data

    def set(self, number: int, value: float, kind: int = 53) -> None:
        self.gateway.sendall(struct.pack("<BBBd", 130, kind, number, value))

    @property
    def velocity(self) -> float:
        return float(self.wheel.setVelocity.call_args.args[0])

    @property
    def position(self) -> float:
        return float(self.lift.setPosition.call_args.args[0]) if self.lift.setPosition.called else 0.0


@pytest.fixture
def simulation(monkeypatch: pytest.MonkeyPatch) -> Iterator[Simulation]:
    made = Simulation(monkeypatch)
    yield made
    for opened in (made.gateway, made.bridge.server, made.bridge.gateway):
        if opened is not None:
            opened.close()


def test_all_devices_are_registered_once_and_then_distances_come(simulation: Simulation) -> None:
    assert simulation.told(len(REGISTERED) + 2 * len(READING)) == REGISTERED + READING * 2


def test_motors_obey_in_any_cut_and_within_their_limit_and_nothing_else_is_one(simulation: Simulation) -> None:
    assert simulation.velocity == 0.0
    for byte in bytes.fromhex("823500") + struct.pack("<d", 2.5):
        simulation.gateway.sendall(bytes((byte,)))
        simulation.bridge.step()
    simulation.until(lambda: simulation.velocity == 2.5)
    simulation.set(2, 1.0, 37)
    simulation.set(0, math.nan)
    simulation.set(1, 0.3)
    simulation.until(lambda: simulation.position == 0.3)
    assert simulation.velocity == 2.5
    simulation.set(0, 99.0)
    simulation.until(lambda: simulation.velocity == 10.0)


@pytest.mark.parametrize("goes", [b"", bytes.fromhex("05") + bytes(10)], ids=["closes", "sends what nobody knows"])
def test_motors_stand_when_the_gateway_goes_and_another_may_come(simulation: Simulation, goes: bytes) -> None:
    simulation.set(0, 2.5)
    simulation.until(lambda: simulation.velocity == 2.5)
    simulation.gateway.sendall(goes)
    if not goes:
        simulation.gateway.close()
    simulation.until(lambda: simulation.bridge.gateway is None)
    assert simulation.velocity == 0.0
    simulation.gateway.close()
    simulation.connect()
    assert simulation.told(len(REGISTERED)) == REGISTERED
