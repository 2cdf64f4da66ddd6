"""The conformance kit: ``python -m zbridge.simulation.check NAME`` checks an installed protocol.

It prints one line for each thing that holds or does not, and exits with 0 where all hold and with 1 otherwise. The
checks are in ``check_messages`` (what is read and written), ``check_sessions`` (handshake, garbage, silence, end),
``check_commands`` (stop, commands) and ``check_motion`` (the simulated robot drives and stands). Knows no protocol.
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
from zbridge.simulation.check_report import Finding
from zbridge.simulation.check_sessions import check_sessions
from zbridge.simulation.check_stage import Recording, record

ESTABLISH_S = 10.0
"""Seconds that a session with the simulated robot has to be established."""


def check(protocol: Protocol, *, establish_s: float = ESTABLISH_S) -> Iterator[Finding]:
    """Check a protocol; yield what holds and what does not, in the order of the checks."""
    yield from check_messages(protocol)
    recording = Recording()
    try:
        recording = asyncio.run(record(protocol, establish_s))
    except Exception as error:  # whatever the protocol's own code raises is a finding
        yield Finding.broken("the session with the simulated robot is established", error)
        return
    yield from check_sessions(protocol, recording)
    if not recording.established:
        return
    yield from check_stop(protocol, recording)
    yield from check_commands(protocol, recording)
    yield from check_motion(protocol, establish_s)


def main(arguments: list[str]) -> int:
    """Check the protocol that the command line names; give the exit status."""
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m zbridge.simulation.check NAME\n")
        return 2
    try:
        protocol = find_protocol(arguments[0])
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    failed = held = 0
    for finding in check(protocol):
        failed, held = failed + (finding.problem is not None), held + (finding.problem is None)
        sys.stdout.write(f"{finding}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{protocol.name}: {held} hold, {failed} do not\n")
    return 1 if failed else 0


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)  # of this process alone: the findings say what is wrong
    sys.exit(main(sys.argv[1:]))
