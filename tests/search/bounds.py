"""The bounded worlds that are searched. What is not in any of them is said in ``reliability.md``."""

from tests.search.moves import Bounds
from tests.search.world import Program

ANN = Program("ann")
LISTENER = Program("hq.l.1", waits=False)
BOB = Program("bob")
CAPTAIN = Program("captain", priority=1, waits=False, drives=False)
SAM = Program("sam", takeover=True, waits=False)
CHIEF = Program("chief", takeover=True, waits=False, drives=False)

_DRIVES = ("motion", "neutral")


def _of(*faults: str) -> frozenset[str]:
    return frozenset(faults)


QUICK = (
    Bounds("one listener drives", (LISTENER,), _DRIVES, channel=1, loses=False, faults=_of("link")),
    Bounds("a latch", (LISTENER,), channel=1, loses=False, faults=_of("robot latch")),
)
"""Those that the tests search."""
FULL = (
    Bounds("one client asks and loses", (ANN,), channel=1, faults=_of("stop")),
    Bounds("a takeover", (LISTENER, CHIEF), channel=1, loses=False, drops=False, beats=False),
    Bounds("one listener drives by itself", (LISTENER,), ("autonomous", "manual", "neutral"), channel=1, loses=False,
           faults=_of("stop", "bus")),
    Bounds("one client, and all is lost", (ANN,), channel=1, faults=_of("stop", "token", "gateway", "bus")),
    Bounds("late by two steps", (LISTENER,), _DRIVES, channel=1, delay=2, faults=_of("link")),
    Bounds("a frozen gateway", (LISTENER,), _DRIVES, channel=1, freezes=True, faults=_of("stop", "offline")),
    Bounds("one client drives", (ANN,), _DRIVES, channel=1, faults=_of("stop", "link")),
    Bounds("two clients, with losses", (ANN, BOB), channel=1, drops=False, beats=False),
    Bounds("a takeover while the robot moves", (LISTENER, CHIEF), _DRIVES, channel=1, loses=False, beats=False,
           hears=False),
    Bounds("a higher priority while the robot moves", (LISTENER, CAPTAIN), ("motion",), channel=1, loses=False,
           beats=False, hears=False),
    Bounds("a latch while the robot moves", (SAM,), _DRIVES, channel=1, loses=False, beats=False, hears=False,
           faults=_of("stop", "robot latch", "link", "bus")),
    Bounds("a gateway that cannot say", (ANN,), channel=1, faults=_of("later", "gateway")),
    Bounds("two parts of a robot", (LISTENER,), ("motion", "neutral", "motor", "motor neutral"), channel=1, delay=2,
           loses=False, drops=False, beats=False),
    Bounds("messages that come twice", (LISTENER,), ("motion",), channel=1, loses=False, beats=False, repeats=True),
    Bounds("motion without a lease", (LISTENER,), ("motion",), channel=1, loses=False, beats=False, hears=False,
           overtaken=True, faults=_of("stop", "robot latch")),
    Bounds("neutral without a lease", (LISTENER,), ("neutral",), channel=1, delay=2, loses=False, beats=False,
           hears=False, overtaken=True, faults=_of("stop", "robot latch", "link")),
)  # fmt: skip
"""Those that ``python -m tests.search`` searches besides."""
