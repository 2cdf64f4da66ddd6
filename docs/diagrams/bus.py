"""The bus: its processes, the way of a drive command, and who may do what. Names and codes are the code's."""

from __future__ import annotations

from typing import NamedTuple

from docs.diagrams.svg import Kind, Picture
from zbridge.control.admission import SHOWN_HZ
from zbridge.control.settings import ControlSettings
from zbridge.errors import Code
from zbridge.fleet import topics
from zbridge.fleet.topics import KeySpace
from zbridge.security.access import GRANTS, Column, Keys, MessageKind

KEYS = KeySpace("fleet", "r1")
ROBOTS = {"TCP/UDP robot": "TCP, UDP", "ALF vehicle": "TCP, serial", "Webots robot": "TCP", "ROS 2 robot": "rmw_zenoh"}
SHOWN = (topics.STATUS, topics.POSE, topics.CMD_DRIVE, topics.CMD_STOP, topics.RPC_POSE)
PROGRAMS = ("Python client", "console", "Foxglove", "ROS 2", "recorder")


def architecture() -> Picture:
    """Draw the processes of a fleet."""
    told = "Robots of four protocols, one gateway process for each of them, the Zenoh bus, and the programs on it."
    picture = Picture("The processes of a fleet", told, 892, 372)
    picture.box((228, 34), (208, 322), "frame")
    picture.text(332, 26, "the gateways of a host", "small", "middle")
    for number, (robot, link) in enumerate(ROBOTS.items()):
        y = 46 + number * 66
        picture.box((16, y + 10), (122, 34), "robot", robot, first="")
        picture.line((138, y + 27), (240, y + 27), heads=2)
        picture.text(186, y + 20, link, "small", "middle")
        picture.box((240, y), (184, 54), "gateway", f"gateway r{number + 1}", "link · session", "translate · authority")
        picture.line((424, y + 27), (496, y + 27), heads=2)
    picture.box((240, 310), (184, 38), "plain", "supervisor", "starts and watches them")
    picture.box((496, 34), (158, 322), "bus", "Zenoh bus", "routers", "", *(KEYS.key(topic.path) for topic in SHOWN))
    for number, program in enumerate(("", *PROGRAMS)):
        y = 40 + number * 54
        picture.line((654, y + 19), (720, y + 19), heads=1 if program == "recorder" else 2)
        if program:
            picture.box((720, y), (156, 38), "program", program, first="")
    picture.box((720, 40), (64, 38), "gateway", "listeners", first="small")
    picture.line((784, 59), (810, 59), heads=2)
    picture.box((810, 40), (66, 38), "program", "HQ", "programs", first="small")
    return picture


class Step(NamedTuple):
    """A step of a drive command. codes: with which it is refused there. otherwise: how else it may end."""

    kind: Kind
    title: str
    does: str
    codes: tuple[Code, ...] = ()
    otherwise: str = ""


_BY_PROOF = (Code.NO_LEASE, Code.MALFORMED, Code.OUT_OF_ORDER)
STEPS: dict[str, tuple[Step, ...]] = {
    "program": (Step("program", "lease client", "numbers, dates and proves the command"),),
    "router": (Step("bus", "access rules, size limits", "on a secure bus", (), "dropped, not reported"),),
    "gateway: Zenoh thread": (
        Step("gateway", "admission filter", "checks proof and number", _BY_PROOF, f"over {SHOWN_HZ:g}/s: counted"),
        Step("gateway", "inbox", "stops first, then the holder's commands", (), "full: the oldest is dropped"),
    ),
    "gateway: event loop": (
        Step("gateway", "authority", "finds the holder, renews the lease", (*_BY_PROOF, Code.HELD, Code.LEASE_ENDED)),
        Step("gateway", "payload codec", "decodes it, unless the gateway ends", (Code.CLOSING, Code.MALFORMED)),
        Step("gateway", "command age", f"motion: at most {ControlSettings().max_age_s:g} s late", (Code.STALE,)),
        Step("gateway", "session", "established, not busy; motion: not in doubt", (Code.NOT_READY,)),
        Step("gateway", "enforcer", "motion: neutral first; limits", (Code.NEUTRAL_FIRST, Code.RATE)),
        Step("gateway", "translate", "to the messages of the protocol", (Code.UNSUPPORTED, Code.MALFORMED)),
        Step("gateway", "outbox", "a newer drive replaces it; gap_s apart"),
        Step("gateway", "link", "writes a frame", (), "stalled: waits, until its deadman"),
    ),
    "robot": (Step("robot", "robot", "moves; the deadman runs"),),
}
"""The way of one drive command, by who does it."""


def drive() -> Picture:
    """Draw the way of a drive command, and where it may end."""
    told = (
        "The steps of a drive command from a program to the robot, and the codes with which each of them may refuse it."
    )
    picture = Picture("The way of a drive command", told, 892, 680)
    for left, heading in ((16, "where"), (180, KEYS.key(topics.CMD_DRIVE.path)), (488, "refused, or ended")):
        picture.text(left, 26, heading, "bold")
    y = 0.0
    for where, steps in STEPS.items():
        picture.text(16, y + 71, where)
        for left, right in ((16, 170), (460, 876)) if y else ():
            picture.line((left, y + 41), (right, y + 41), "grid", width=1)
        for step in steps:
            y += 48
            picture.box((180, y), (270, 34), step.kind)
            picture.text(192, y + 15, step.title, "bold")
            picture.text(192, y + 29, step.does, "small")
            if where != "robot":
                picture.line((315, y + 34), (315, y + 48), heads=1)
            if step.codes or step.otherwise:
                picture.line((450, y + 17), (480, y + 17), "stop", heads=1)
            x = 488.0
            for code in step.codes:
                width = 12 + 6.6 * len(code.value)
                picture.box((x, y + 6), (width, 22), "stop", code.value, first="small")
                x += width + 6
            picture.text(x + 2, y + 21, step.otherwise, "small")
    return picture


RIGHTS: dict[str, tuple[tuple[Keys, MessageKind], ...]] = {
    "watch": ((Keys.DATA, MessageKind.SUBSCRIBE),),
    "stop, latch": ((Keys.STOP, MessageKind.PUT),),
    "drive": ((Keys.COMMANDS, MessageKind.PUT), (Keys.ACQUIRE, MessageKind.QUERY)),
    "set marks": ((Keys.MARK, MessageKind.PUT),),
    "release a robot's latch": ((Keys.UNLATCH, MessageKind.QUERY),),
    "take over": ((Keys.TAKEOVER, MessageKind.QUERY),),
    "release the fleet's latch": ((Keys.UNLATCH_FLEET, MessageKind.QUERY),),
    "restart": ((Keys.RESTART, MessageKind.QUERY),),
    "receive commands": ((Keys.COMMANDS, MessageKind.SUBSCRIBE),),
    "read raw frames": ((Keys.WIRE, MessageKind.SUBSCRIBE),),
    "serve robots": ((Keys.DATA, MessageKind.PUT), (Keys.RPC, MessageKind.REPLY)),
    "serve HQ programs": ((Keys.HQ_ACQUIRE, MessageKind.QUERY),),
}
"""What people want to do, and the messages that each needs."""
WHOSE: dict[str, Kind] = {"all": "gateway", "own": "program"}


def may(column: Column, keys: Keys, kind: MessageKind) -> str:
    """Return for which robots a member may send a message: ``all``, ``own``, or none."""
    grants = [grant for grant in GRANTS[column] if grant.keys in (keys, Keys.EVERYTHING) and kind in grant.kinds]
    of_robots = "{robot}" in keys.value[0]
    return ("own" if of_robots and all(grant.own for grant in grants) else "all") if grants else ""


def roles() -> Picture:
    """Draw what each role may do, as the access rules grant it."""
    told = "For each role, what it may do, and whether for all robots or only for those that roles.toml lists for it."
    picture = Picture("Who may do what on a secure bus", told, 892, 386)
    for place, (right, needed) in enumerate(RIGHTS.items()):
        x, words = 200 + place * 59, right.split(" ")
        for line, word in enumerate(words):
            picture.text(x, 72 - (len(words) - 1 - line) * 14, word, "small", "middle")
        for row, role in enumerate(GRANTS):
            allowed = {may(role, keys, kind) for keys, kind in needed}
            if "" not in allowed:
                whose = "own" if "own" in allowed else "all"
                picture.box((x - 21, 90 + row * 34), (42, 22), WHOSE[whose], whose, first="small")
    for row, role in enumerate(GRANTS):
        picture.line((16, 84 + row * 34), (876, 84 + row * 34), "grid", width=1)
        picture.text(16, 106 + row * 34, role)
    picture.text(180, 374, "all: every robot. own: the robots that roles.toml lists for the name.", "small")
    return picture
