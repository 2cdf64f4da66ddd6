"""The controller script for Webots, with a stand-in for Webots' own ``controller`` module and a real socket."""

import importlib.util
import math
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[3] / "deploy/webots/zbridge_controller.py"


class Device:
    node_type = 0

    def __init__(self, name: str) -> None:
        self.name = name

    def getName(self) -> str:  # noqa: N802 - Webots' names
        return self.name

    def getNodeType(self) -> int:  # noqa: N802
        return self.node_type


class DistanceSensor(Device):
    node_type = 37
    value = 123.466747

    def enable(self, period_ms: int) -> None:
        assert period_ms == 20

    def getValue(self) -> float:  # noqa: N802
        return self.value


class Motor(Device):
    node_type = 53

    def __init__(self, name: str, kind: int) -> None:
        super().__init__(name)
        self.kind = kind
        self.velocity = math.nan
        self.position = 0.0

    def getType(self) -> int:  # noqa: N802
        return self.kind

    def getMaxVelocity(self) -> float:  # noqa: N802
        return 10.0

    def setVelocity(self, value: float) -> None:  # noqa: N802
        self.velocity = value

    def setPosition(self, value: float) -> None:  # noqa: N802
        self.position = value


class Node:
    ROTATIONAL_MOTOR = 53
    LINEAR_MOTOR = 46


class Robot:
    def __init__(self) -> None:
        self.wheel, self.lift = Motor("wheel1", 53), Motor("lift", 46)
        self.devices = [self.wheel, self.lift, DistanceSensor("inf_left"), Device("camera")]

    def getNumberOfDevices(self) -> int:  # noqa: N802
        return len(self.devices)

    def getDeviceByIndex(self, index: int) -> Device:  # noqa: N802
        return self.devices[index]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    module = ModuleType("controller")
    for thing in (Robot, DistanceSensor, Motor, Node):
        setattr(module, thing.__name__, thing)
    monkeypatch.setitem(sys.modules, "controller", module)
    spec = importlib.util.spec_from_file_location("zbridge_controller", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


@pytest.fixture
def bridge(script: Any) -> Iterator[Any]:
    made = script.Bridge(Robot(), 0)
    yield made
    made.server.close()
    if made.gateway is not None:
        made.gateway.close()


@pytest.fixture
def gateway(bridge: Any) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", bridge.server.getsockname()[1])) as link:
        link.settimeout(5)
        stepped(bridge, lambda: bridge.gateway is not None)
        yield link


def stepped(bridge: Any, condition: Any) -> None:
    """Let steps pass until something is so: what a socket carries takes a moment."""
    for _ in range(100_000):
        bridge.step()
        if condition():
            return
    raise AssertionError("not so after many steps")


def read(link: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += link.recv(count - len(data))
    return data


REGISTERED = bytes.fromhex("00350006") + b"wheel1" + bytes.fromhex("00350104") + b"lift" + bytes.fromhex("00250208")
REGISTERED += b"inf_left" + bytes.fromhex("00000306") + b"camera"
READING = bytes.fromhex("012502") + struct.pack("<d", 123.466747)


def test_all_devices_are_registered_once_and_then_distances_come(bridge: Any, gateway: socket.socket) -> None:
    bridge.step()
    assert read(gateway, len(REGISTERED)) == REGISTERED
    bridge.step()
    assert read(gateway, len(READING)) == READING


def test_motors_obey_in_any_cut_and_within_their_limit(bridge: Any, gateway: socket.socket) -> None:
    wheel, lift = bridge.robot.wheel, bridge.robot.lift
    for byte in bytes.fromhex("823500") + struct.pack("<d", 2.5):
        gateway.sendall(bytes((byte,)))
        bridge.step()
    stepped(bridge, lambda: wheel.velocity == 2.5)
    gateway.sendall(
        bytes.fromhex("823500") + struct.pack("<d", 99.0) + bytes.fromhex("823501") + struct.pack("<d", 0.3)
    )
    stepped(bridge, lambda: lift.position == 0.3)
    assert wheel.velocity == 10.0


def test_what_is_no_motor_or_no_number_is_ignored(bridge: Any, gateway: socket.socket) -> None:
    bad = bytes.fromhex("822502") + struct.pack("<d", 1.0) + bytes.fromhex("823500") + struct.pack("<d", math.nan)
    gateway.sendall(bad + bytes.fromhex("823501") + struct.pack("<d", 0.1))
    stepped(bridge, lambda: bridge.robot.lift.position == 0.1)
    assert bridge.robot.wheel.velocity == 0.0


@pytest.mark.parametrize("goes", [b"", bytes.fromhex("05") + bytes(10)])
def test_motors_stand_when_the_gateway_goes_and_another_may_come(bridge: Any, gateway: socket.socket, goes) -> None:
    gateway.sendall(bytes.fromhex("823500") + struct.pack("<d", 2.5))
    stepped(bridge, lambda: bridge.robot.wheel.velocity == 2.5)
    gateway.sendall(goes) if goes else gateway.close()
    stepped(bridge, lambda: bridge.gateway is None)
    assert bridge.robot.wheel.velocity == 0.0
    with socket.create_connection(("127.0.0.1", bridge.server.getsockname()[1])) as again:
        again.settimeout(5)
        stepped(bridge, lambda: bridge.gateway is not None)
        bridge.step()
        assert read(again, len(REGISTERED)) == REGISTERED
