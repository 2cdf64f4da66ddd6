"""A lease over time: two stories, played by the authority that the gateway executes, with its default settings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from docs.diagrams.machines import kind_of
from docs.diagrams.svg import Kind, Picture
from zbridge.control.authority import Authority
from zbridge.control.settings import ControlSettings
from zbridge.fleet.lease_messages import Acquire
from zbridge.lease.proof import Signer, read

SETTINGS = ControlSettings()
RENEW_S, DRIVE_S = SETTINGS.lease_s / 3, 0.25
"""How often the lease client renews its lease, and the programs of the picture repeat a drive."""
END_S, LEFT, SECOND = 10.5, 86, 76
"""Seconds shown; pixels left of second 0, and of a second."""
KEY = "fleet/r1/@cmd/drive"


class Act(NamedTuple):
    """What a program does, and until when it repeats that."""

    at: float
    who: str
    doing: str
    until: float = 0.0

    def steps(self) -> list[float]:
        """Return each time at which it does it."""
        period_s = RENEW_S if self.doing == "renew" else DRIVE_S
        return [self.at + number * period_s for number in range(1 + max(0, int((self.until - self.at) / period_s)))]


LOST_DRIVER = (
    *(Act(0.5, "ann", "acquire"), Act(1.5, "ann", "renew", 5.9), Act(1.25, "ann", "drives", 2.75)),
    *(Act(3.0, "ann", "neutral"), Act(4.5, "ann", "drives", 6.0), Act(6.0, "ann", "cut off")),
)
TAKEOVER = (
    *(Act(0.5, "ann", "acquire"), Act(1.5, "ann", "renew", 3.0), Act(1.25, "ann", "drives", 3.0)),
    *(Act(3.25, "bob", "takeover"), Act(4.25, "bob", "renew", 6.3), Act(4.5, "bob", "drives", 6.25)),
    *(Act(6.5, "eve", "stop"), Act(7.25, "bob", "acquire"), Act(8.25, "bob", "renew", 9.5)),
    *(Act(8.0, "bob", "drives", 8.75), Act(9.0, "bob", "neutral"), Act(9.75, "bob", "release")),
)
_MARKS: dict[str, tuple[int, Kind]] = {"renew": (80, "neutral"), "stop": (63, "stop"), "cut off": (63, "stop")}
"""Where what is done is marked, and how."""
Changes = list[tuple[float, str]]
"""Values, each with the time from which it is the value."""


def play(story: tuple[Act, ...]) -> tuple[Changes, Changes, Changes]:
    """Play a story; return the holders, the authority's states, and why the robot was stopped."""
    authority, signer = Authority(SETTINGS.lease_s, SETTINGS.deadman_s, bytes), None
    holders, states, stops = changed = ([], [], [])  # type: tuple[Changes, Changes, Changes]
    acts = sorted((at, act) for act in story for at in act.steps())
    while acts or authority.deadline() is not None:
        due = authority.deadline() or math.inf
        if not acts or due <= acts[0][0]:
            now = due
            authority.expire(now)
        else:
            now, act = acts.pop(0)
            signer = _do(authority, act, now, signer)
        holder = authority.holders.current
        for changes, value in ((holders, holder.who if holder else ""), (states, authority.machine.state.value)):
            if not changes or changes[-1][1] != value:
                changes.append((now, value))
        stops += [(now, event.reason or "") for event in authority.events() if event.stops]
    return changed


def _do(authority: Authority, act: Act, now: float, signer: Signer | None) -> Signer | None:
    """Do one thing; return what signs for the holder of the lease."""
    if act.doing in ("acquire", "takeover"):
        return Signer(getattr(authority, act.doing)(Acquire(act.who), now))
    if act.doing == "stop":
        authority.stop("stop")
    elif signer is not None and act.doing in ("renew", "release"):
        getattr(authority, act.doing)(read(signer.renewal(KEY, 0)), KEY, now)
    elif signer is not None and act.doing in ("drives", "neutral"):
        authority.admit(signer.command(KEY, b"", 0), KEY, b"", now)
        authority.applied(KEY, now, moving=act.doing == "drives", whole=True)
    return signer


def lease() -> Picture:
    """Draw both stories, one below the other."""
    deadman_s, lease_s = SETTINGS.deadman_s, SETTINGS.lease_s
    told = (
        f"Ann is cut off: her robot is stopped after {deadman_s:g} s, her lease ends after {lease_s:g} s; below, Bob "
    )
    picture = Picture("A lease over time", f"{told}takes over from Ann, and Eve stops the robot.", _x(END_S) + 14, 486)
    for second in range(int(END_S) + 1):
        picture.line((_x(second), 40), (_x(second), 460), "grid", width=1)
        picture.text(_x(second), 475, f"{second} s", "small", "middle")
    _draw(picture, 12, "The driver is cut off", LOST_DRIVER)
    _draw(picture, 262, "A takeover, and a stop by somebody else", TAKEOVER)
    picture.text(_x(END_S), 28, f"mark on a lease: renewed, every {RENEW_S:g} s", "small", "end")
    cut_at = LOST_DRIVER[-1].at
    for y, name, seconds in ((204, "deadman_s", deadman_s), (224, "lease_s", lease_s)):
        picture.line((_x(cut_at), y), (_x(cut_at + seconds), y), "stop", heads=2)
        picture.text(_x(cut_at) - 8, y + 4, f"{name} = {seconds:g} s", "small", "end")
    return picture


def _draw(picture: Picture, top: float, heading: str, story: tuple[Act, ...]) -> None:
    """Draw one story."""
    picture.text(16, top + 16, heading, "bold")
    for number, name in enumerate(("programs", "lease", "state", "robot")):
        picture.text(16, top + 66 + 30 * number, name)
    holders, states, stops = play(story)
    _bars(picture, top + 80, holders, {"ann": "gateway", "bob": "bus"})
    _bars(picture, top + 110, states, {state: kind_of(state) for _, state in states})
    _bars(picture, top + 140, [(at, "moves" * (state == "moving")) for at, state in states], {"moves": "robot"})
    for act in story:
        y, kind = _MARKS.get(act.doing, (63, ""))
        for at in act.steps():
            picture.line((_x(at), top + y), (_x(at), top + y + 9), kind, width=1.8)
        for line, words in enumerate((act.who, act.doing) if act.doing != "renew" else ()):
            picture.text(_x(act.at) + 3, top + 46 + 13 * line, words, "small")
    for at, reason in stops:
        picture.line((_x(at), top + 136), (_x(at), top + 168), "stop", width=4)
        picture.text(_x(at), top + 181, f"stop: {reason}" if reason != "stop" else reason, "small", "middle")


def _bars(picture: Picture, top: float, changes: Changes, kinds: Mapping[str, Kind]) -> None:
    """Draw what was when; nothing for an empty value."""
    for (start, value), (end, _) in zip(changes, [*changes[1:], (END_S, "")], strict=True):
        if value:
            picture.box((_x(start), top), ((end - start) * SECOND, 24), kinds[value], value, first="small")


def _x(at: float) -> float:
    return LEFT + at * SECOND
