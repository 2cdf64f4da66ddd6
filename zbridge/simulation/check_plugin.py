"""Conformance of the protocol object: its name, its template, and the session as tables show it."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator

import msgspec

from zbridge.fleet.messages import SessionEntry
from zbridge.protocol.plugin import Protocol
from zbridge.protocol.session import Role
from zbridge.simulation.check_report import Finding
from zbridge.simulation.check_stage import robot_of


def check_plugin(protocol: Protocol, name: str) -> Iterator[Finding]:
    """Check what the gateway needs before the first connection. name: the entry point's."""
    checks: tuple[tuple[str, Callable[[], str | None]], ...] = (
        ("the protocol has the name of its entry point", lambda: _named(protocol, name)),
        ("the template is a configuration of this protocol", lambda: _template(protocol)),
        ("a session can be shown", lambda: _shown(protocol)),
    )
    for claim, find in checks:
        try:
            yield Finding(claim, find())
        except Exception as error:  # whatever the protocol's own code raises is a finding
            yield Finding.broken(claim, error)


def _named(protocol: Protocol, name: str) -> str | None:
    return None if protocol.name == name else f"the entry point is {name!r}, Protocol.name is {protocol.name!r}"


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
            return f"role is {session.role!r}, not Role.HQ"
        msgspec.convert(msgspec.to_builtins(session.snapshot()), SessionEntry)
    return None
