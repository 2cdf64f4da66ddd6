"""The bounded worlds that are searched. What is not in any of them is said in ``docs/reliability.md``."""

from tests.search.moves import Bounds
from tests.search.world import Program

ANN, BOB = Program("ann"), Program("bob")
LISTENER, OTHER = Program("hq.l.1", waits=False), Program("hq.m.1", waits=False)
CHIEF = Program("chief", takeover=True, waits=False)
ELDER = Program("elder", priority=1, waits=False)

_DRIVES = ("motion", "neutral")


def _of(*faults: str) -> frozenset[str]:
    return frozenset(faults)


QUICK = (
    Bounds("one client asks and loses", (ANN,), channel=1, faults=_of("stop")),
    Bounds("one listener drives", (LISTENER,), _DRIVES, channel=1, loses=False, faults=_of("link")),
    Bounds("a latch", (LISTENER,), channel=1, loses=False, faults=_of("robot latch")),
    Bounds("a takeover", (LISTENER, CHIEF), channel=1, loses=False, drops=False, beats=False),
)
"""Those that the tests search."""
FULL = (
    Bounds("one listener drives by itself", (LISTENER,), ("autonomous", "manual", "neutral"), channel=1, loses=False,
           faults=_of("stop", "bus")),
    Bounds("two listeners", (LISTENER, OTHER), channel=1, loses=False),
    Bounds("a takeover, and programs that give up", (LISTENER, CHIEF), channel=1, loses=False),
    Bounds("one client, all news lost", (ANN,), channel=1, faults=_of("stop", "token", "gateway", "bus")),
    Bounds("one client drives", (ANN,), _DRIVES, channel=1, faults=_of("stop", "link")),
    Bounds("two messages on their way", (LISTENER,), _DRIVES, channel=2, repeats=True, faults=_of("stop")),
    Bounds("late by two steps", (LISTENER,), _DRIVES, channel=1, delay=2, faults=_of("link")),
    Bounds("a frozen gateway", (LISTENER,), _DRIVES, channel=1, freezes=True, faults=_of("stop", "offline")),
    Bounds("two kinds of latch", (LISTENER,), ("motion",), channel=1, faults=_of("robot latch", "fleet latch", "stop")),
    Bounds("two clients", (ANN, BOB), channel=1),
    Bounds("two listeners drive", (LISTENER, OTHER), _DRIVES, channel=1, faults=_of("stop")),
    Bounds("a takeover with losses", (LISTENER, CHIEF), ("motion",), channel=1, faults=_of("stop")),
    Bounds("a higher priority", (LISTENER, ELDER), ("motion",), channel=1, faults=_of("stop")),
)
"""Those that ``python -m tests.search`` searches besides."""
