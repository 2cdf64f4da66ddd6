"""The conformance kit: ``python -m zbridge.simulation.check NAME`` checks an installed protocol.

It prints one line per requirement, and exits with 0 if all hold, else with 1. The
checks are in ``check_plugin`` (name, template), ``check_messages`` (what is read and written), ``check_sessions``
(handshake, garbage, silence, end), ``check_commands`` (stop, commands) and ``check_motion`` (the simulated robot drives
and stops). Knows no protocol.
"""

from __future__ import annotations

import asyncio
import logging
import sys
import tomllib
from collections.abc import Iterator

import msgspec

from zbridge.errors import ConfigError
from zbridge.fleet.processes import SessionEntry
from zbridge.protocol.plugin import Protocol, find_protocol
from zbridge.protocol.session import Role
from zbridge.simulation.check_commands import check_commands, check_stop
from zbridge.simulation.check_messages import check_messages
from zbridge.simulation.check_motion import check_motion
from zbridge.simulation.check_sessions import check_sessions
from zbridge.simulation.check_stage import CheckFinding, Transcript, raised, record, robot_of

USAGE = "usage: python -m zbridge.simulation.check NAME\n"
ESTABLISH_S = 10.0
"""Time limit to establish a session with the simulated robot, seconds."""


def check(protocol: Protocol, name: str, *, establish_s: float = ESTABLISH_S) -> Iterator[CheckFinding]:
    """Check a protocol, installed as ``name``; yield the findings in the order of the checks."""
    yield from check_plugin(protocol, name)
    yield from check_messages(protocol)
    recording = Transcript()
    try:
        recording = asyncio.run(record(protocol, establish_s))
    except Exception as error:  # whatever the protocol's own code raises is a finding
        problem = raised(error, "a simulated robot that listens")
        yield CheckFinding("the session with the simulated robot is established", problem)
        return
    yield from check_sessions(protocol, recording)
    if not recording.established:
        return
    yield from check_stop(protocol, recording)
    yield from check_commands(protocol, recording)
    yield from check_motion(protocol, establish_s)


def main(arguments: list[str]) -> int:
    """Check the protocol that the command line names; give the exit status."""
    if arguments in (["--help"], ["-h"]):
        sys.stdout.write(f"{USAGE}\n{__doc__}")
        return 0
    if len(arguments) != 1 or arguments[0].startswith("-"):
        sys.stderr.write(USAGE)
        return 2
    try:
        protocol = find_protocol(arguments[0])
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    failed = held = 0
    for finding in check(protocol, arguments[0]):
        failed, held = failed + (finding.problem is not None), held + (finding.problem is None)
        sys.stdout.write(f"{finding}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{protocol.name}: {held} hold, {failed} do not\n")
    return 1 if failed else 0


def check_plugin(protocol: Protocol, name: str) -> Iterator[CheckFinding]:
    """Check what the gateway needs before the first connection. name: of the entry point."""
    other = f"the entry point is {name!r}, Protocol.name is {protocol.name!r}" if protocol.name != name else None
    yield CheckFinding("the protocol has the name of its entry point", other)
    yield CheckFinding.tried("the template is a configuration of this protocol", lambda: _template(protocol))
    yield CheckFinding.tried("a session can be shown", lambda: _shown(protocol))


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


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)  # of this process only: the findings report what is wrong
    sys.exit(main(sys.argv[1:]))
