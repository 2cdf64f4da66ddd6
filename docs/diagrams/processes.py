"""What the processes of a host say to each other: in a restart, and after a crash. Names and times are the code's."""

from __future__ import annotations

from docs.diagrams.svg import LINE, Kind, Picture
from zbridge.app.handover.channel import Go, HandoverState, Hello, Up
from zbridge.app.handover.sequence import PREPARE_S
from zbridge.host.child import DRIVEN_HEARTBEAT_S
from zbridge.host.duplicates import TIMES
from zbridge.host.fd_channel import Deposited, Fork, Heartbeat, Opened, Succeeded, WantSuccessor
from zbridge.host.watchdog import DRIVEN_S

ACTORS = ("HQ program", "robot", "gateway", "successor", "supervisor")
KINDS: tuple[Kind, ...] = ("program", "robot", "gateway", "gateway", "plain")
HANDOVER = f"{HandoverState.__name__}, sockets"
HELLO = f"{Hello.__name__}: version of the state"


def restart() -> Picture:
    """Draw a restart under a supervisor."""
    return _sequence(
        "A restart that no robot notices",
        "A gateway stops its robot, hands its state and sockets to a successor, and ends; all connections stay.",
        "gateway <> robot: commands, telemetry",
        "gateway: zbridge restart r1",
        f"gateway > supervisor: {WantSuccessor.__name__}",
        f"supervisor > successor: {Fork.__name__}",
        f"successor > gateway: {HELLO}",
        f"gateway: ends the lease;|prepares for {PREPARE_S:g} s at most",
        "gateway > HQ program: the robot is away",
        "gateway > robot: stop",
        "gateway: reads and writes nothing;|input waits in the kernel",
        f"gateway > successor: {HANDOVER}",
        "successor: declares its keys, its claim|and its liveliness token",
        f"successor > gateway: {Up.__name__}",
        f"gateway > supervisor: {Succeeded.__name__}: the successor has the robot",
        f"gateway > successor: {Go.__name__}",
        "gateway: closes its copies, and ends",
        "successor <> robot: repeated stops, telemetry; the same connection",
        "successor > HQ program: the robot is back; the same connection",
    )


def crash() -> Picture:
    """Draw what a supervisor does when a gateway crashes or hangs."""
    return _sequence(
        "A gateway crashes",
        "The supervisor stops the robot over its duplicate of the socket; the next process takes the connection over.",
        "gateway <> robot: commands, telemetry",
        f"gateway > supervisor: {Opened.__name__}: duplicates of the sockets",
        f"gateway > supervisor: {Heartbeat.__name__}: the robot's stop; {1 / DRIVEN_HEARTBEAT_S:g} a second",
        f"gateway > supervisor: {Deposited.__name__}: the state, in shared memory",
        f"gateway: dies, or hangs: killed after|{DRIVEN_S:g} s without a heartbeat",
        f"supervisor > robot: stop, {TIMES} times, over the duplicate",
        f"supervisor > successor: {Fork.__name__}",
        f"successor > supervisor: {HELLO}",
        f"supervisor > successor: {HANDOVER}",
        f"successor > supervisor: {Up.__name__}",
        f"supervisor > successor: {Go.__name__}, when the stops are written",
        "successor > robot: stop, over the same connection",
        "successor <> robot: commands, telemetry",
    )


def _sequence(title: str, description: str, *steps: str) -> Picture:
    """Draw messages (``from > to: words``) and notes (``actor: lines``), from top to bottom."""
    actors = [name for name in ACTORS if any(name in step for step in steps)]
    at = {name: 92 + number * 708 / (len(actors) - 1) for number, name in enumerate(actors)}
    picture, y = Picture(title, description, 892, 0), 56.0
    for step in steps:
        who, _, words = step.partition(": ")
        sender, arrow, receiver = who.partition(" > " if " > " in who else " <> ")
        if arrow:
            y += 34
            side = 5 if at[receiver] > at[sender] else -5
            kind: Kind = "stop" if words.startswith("stop") else ""
            picture.line((at[sender] + side, y), (at[receiver] - side, y), kind, heads=len(arrow) - 2)
            picture.text((at[sender] + at[receiver]) / 2, y - 6, words, "small", "middle")
        else:
            lines = words.split("|")
            height = 12 + LINE * len(lines)
            picture.box(
                (at[who] - 95, y + 10), (190, height), "stop" if "dies" in words else "neutral", *lines, first="small"
            )
            y += height + 10
    drawn, picture.parts, picture.height = picture.parts, [], y + 24
    for name, x in at.items():
        picture.line((x, 46), (x, y + 12), "grid")
        picture.box((x - 74, 16), (148, 30), KINDS[ACTORS.index(name)], name)
    picture.parts += drawn
    return picture
