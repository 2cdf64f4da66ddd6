"""The conformance kit: ``python -m zbridge.simulation.check NAME`` checks an installed protocol.

It prints one line for each claim: ``ok``, ``FAIL`` with what is wrong, or ``?`` with the reason why the claim could not
be checked. Its exit status is 0 if no claim fails, else 1. The checks are in :mod:`zbridge.simulation.checks`. Knows no
protocol.
"""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Iterator

from zbridge.errors import ConfigError
from zbridge.protocol.plugin import Protocol, find_protocol
from zbridge.simulation.checks.commands import check_commands
from zbridge.simulation.checks.examples import check_examples
from zbridge.simulation.checks.finding import CheckFinding, raised
from zbridge.simulation.checks.live import check_live
from zbridge.simulation.checks.messages import check_messages
from zbridge.simulation.checks.package import check_package
from zbridge.simulation.checks.sessions import ESTABLISHED, check_sessions
from zbridge.simulation.checks.stage import record
from zbridge.simulation.checks.stops import check_stops

USAGE = "usage: python -m zbridge.simulation.check NAME\n"
ESTABLISH_S = 10.0
"""Time limit to establish a session with the simulated robot, seconds."""


def check(protocol: Protocol, name: str, *, establish_s: float = ESTABLISH_S) -> Iterator[CheckFinding]:
    """Check a protocol, installed as ``name``; yield the findings in the order of the checks."""
    yield from check_package(protocol, name)
    yield from check_messages(protocol)
    yield from check_examples(protocol)
    try:
        recording = asyncio.run(record(protocol, establish_s))
    except Exception as error:  # whatever the protocol's own code raises is a finding
        yield CheckFinding(ESTABLISHED, raised(error, "a simulated robot that listens"), guide="7. A simulated robot")
        return
    yield from check_sessions(protocol, recording)
    if not recording.established:
        return
    yield from check_stops(protocol, recording)
    yield from check_commands(protocol, recording)
    yield from check_live(protocol, establish_s)


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
    failed = held = unchecked = 0
    for finding in check(protocol, arguments[0]):
        failed += finding.problem is not None
        unchecked += finding.unchecked is not None
        held += finding.problem is None and finding.unchecked is None
        sys.stdout.write(f"{finding}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{protocol.name}: {held} hold, {failed} do not, {unchecked} not checked\n")
    return 1 if failed else 0


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)  # of this process only: the findings report what is wrong
    sys.exit(main(sys.argv[1:]))
