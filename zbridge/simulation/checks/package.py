"""Conformance of the protocol object: what the gateway needs before the first connection."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator

import msgspec

from zbridge.fleet.processes import SessionEntry
from zbridge.protocol.plugin import Protocol
from zbridge.protocol.session import Role
from zbridge.simulation.checks.finding import CheckFinding
from zbridge.simulation.checks.rehearsal import robot_of

_ENTRY_POINT, _PROTOCOL = "1. The package", "8. The protocol"


def check_package(protocol: Protocol, name: str) -> Iterator[CheckFinding]:
    """Check the names, the template, and that a session can be shown. name: of the entry point."""
    other = f"the entry point is {name!r}, Protocol.name is {protocol.name!r}" if protocol.name != name else None
    yield CheckFinding("the protocol has the name of its entry point", other, guide=_ENTRY_POINT)
    claim = "the template is a configuration of this protocol"
    yield CheckFinding.tried(claim, lambda: _template(protocol), guide=_PROTOCOL)
    yield CheckFinding.tried("a session can be shown", lambda: _shown(protocol), guide="3. The session")


def _template(protocol: Protocol) -> str | None:
    device = tomllib.loads(protocol.template).get("device")
    if device is None:
        return "it has no table [device]"
    if device.get("protocol") != protocol.name:
        return f"its protocol is {device.get('protocol')!r}, not {protocol.name!r}"
    if not device.get("connect"):
        return "it has no connect"
    msgspec.convert(device.get("options", {}), protocol.options)
    return None


def _shown(protocol: Protocol) -> str | None:
    robot = robot_of(protocol)
    for link in robot.link_names:
        session = robot.session(link, "tcp://robot.test:1")
        if not isinstance(session.role, Role):
            return f"{type(session).__qualname__}.role is {session.role!r}, not Role.HQ"
        msgspec.convert(msgspec.to_builtins(session.snapshot()), SessionEntry)
    return None
