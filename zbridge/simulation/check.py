"""The conformance kit: ``python -m zbridge.simulation.check NAME`` checks an installed protocol.

It prints one line for each thing that holds or does not, and exits with 0 where all hold and with 1 otherwise. The
checks are in ``check_plugin`` (name, template), ``check_messages`` (what is read and written), ``check_sessions``
(handshake, garbage, silence, end), ``check_commands`` (stop, commands) and ``check_motion`` (the simulated robot drives
and stands). Knows no protocol.
"""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Iterator

from zbridge.errors import ConfigError
from zbridge.protocol.plugin import Protocol, find_protocol
from zbridge.simulation.check_commands import check_commands, check_stop
from zbridge.simulation.check_messages import check_messages
from zbridge.simulation.check_motion import check_motion
from zbridge.simulation.check_plugin import check_plugin
from zbridge.simulation.check_report import Finding
from zbridge.simulation.check_sessions import check_sessions
from zbridge.simulation.check_stage import Recording, record

USAGE = "usage: python -m zbridge.simulation.check NAME\n"
ESTABLISH_S = 10.0
"""Seconds that a session with the simulated robot has to be established."""


def check(protocol: Protocol, name: str, *, establish_s: float = ESTABLISH_S) -> Iterator[Finding]:
    """Check a protocol, installed as ``name``; yield what holds and what does not, in the order of the checks."""
    yield from check_plugin(protocol, name)
    yield from check_messages(protocol)
    recording = Recording()
    try:
        recording = asyncio.run(record(protocol, establish_s))
    except Exception as error:  # whatever the protocol's own code raises is a finding
        yield Finding.broken(
            "the session with the simulated robot is established", error, "a simulated robot that listens"
        )
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


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)  # of this process alone: the findings say what is wrong
    sys.exit(main(sys.argv[1:]))
