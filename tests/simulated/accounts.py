"""What the checker knows of leases and commands, and how it reads frames; it shares no code with the gateway."""

from __future__ import annotations

import math
import re
import struct
from typing import Any

import msgpack

TOLERANCE = {"tcpudp": 1e-6, "alf": 0.0051, "wc2ec": 1e-6}
"""By how much a value at the robot may differ from the one that was given, fractions of full scale."""
MAX_AGE_S = 0.4
"""Seconds after which a dated command is stale, unless the deadman is less."""
CLOSE_S = 0.05
"""By how much the age of a command may be misjudged."""
SLACK_S = 0.06
"""What is on its way through a gateway when a lease ends may be written so long."""
WHEEL_FULL = 10.0
"""rad/s of a wheel at full scale, as the scenarios configure it."""


class Command:
    """A drive, motor or mode command that somebody put on the bus."""

    def __init__(self, key: str, payload: bytes, shown: dict[str, Any], who: str, now: float) -> None:
        fields = read(payload)
        self.kind = key.partition("@cmd/")[2].partition("/")[0]
        self.part = key.partition("@cmd/motor/")[2]
        """The name of a motor; empty: the whole robot."""
        self.who = who
        self.put_at = self.given_at = now
        """When it was put on the bus, and when its program gave it."""
        self.lease = shown.get("lease")
        self.number = shown.get("seq", 0)
        self.called_off: float | None = None
        """When its sender said neutral, or chose another mode; of a mode."""
        self.perhaps_stale = False
        """Whether its age is so near the limit that it may have been refused."""
        self.dated = "t" in shown
        self.received: dict[str, float] = {}
        """By gateway."""
        self.forbidden: str | None = None
        """Why it must not move the robot, whatever else holds."""
        if self.kind == "mode":
            self.value = 1.0 if fields.get("mode") == "autonomous" else 0.0
        elif self.kind == "motor":
            self.value = abs(fields.get("value", 0.0)) / WHEEL_FULL
        else:
            along = math.hypot(fields.get("forward") or 0.0, fields.get("left") or 0.0)
            self.value = max(along, abs(fields.get("turn") or 0.0))

    def __repr__(self) -> str:
        return f"{self.kind} {self.value:.5f} of {self.who} put at {self.put_at:.3f}"


class Grant:
    """A lease that a gateway granted."""

    def __init__(self, gateway: str, asker: str, answer: dict[str, Any], request: dict[str, Any], now: float) -> None:
        self.lease: bytes = answer["lease"]
        self.gateway = gateway
        self.asker = asker
        self.at = now
        self.who = str(request.get("who"))
        self.lease_s: float = answer.get("expires_in_s") or 3.0
        self.alive: str | None = request.get("alive")
        self.dated = "t" in request and answer.get("max_age_s") is not None
        self.renewed_at = now
        self.ended_at: float | None = None
        self.why = ""
        self.deadman_s = 2.0
        self.base_s = 0.5
        """The least time that anything of it took to the gateway."""
        self.shown = False
        """Whether ``control`` showed it."""
        self.autonomous = False
        self.last_motion: Command | None = None
        self.last_mode: Command | None = None
        self.needs_neutral = False
        self.moved: set[str] = set()
        """Its parts that moved, and had no neutral since; ``""``: the whole robot."""
        self._newest = 0
        """The highest number of its commands that arrived."""
        self.used = False
        """Whether anything was sent with it."""

    def __repr__(self) -> str:
        return f"lease {self.lease.hex()[:6]} of {self.asker} at {self.gateway}"

    def end(self, now: float, why: str) -> None:
        """Note the first end."""
        if self.ended_at is None:
            self.ended_at, self.why = now, why

    def expires_by(self, now: float) -> bool:
        """Whether it has expired by its gateway's clock, which may be a little fast, unless that renewed it."""
        return now > self.renewed_at + 0.999 * self.lease_s - 0.01

    def over(self, now: float, slack_s: float) -> bool:
        """Whether it ended more than so long ago."""
        return self.ended_at is not None and now > self.ended_at + slack_s

    def asks_again(self, asker: str, request: dict[str, Any]) -> bool:
        """Whether its own program asks once more: the grant did not reach it, and it used nothing."""
        return asker == self.asker and self.alive is not None and request.get("alive") == self.alive and not self.used

    def paused(self, now: float) -> None:
        """Follow a pause of the gateway: a command that came just before may be served after it, and be stale then."""
        last = self.last_motion
        if last is not None and last.dated and now - last.received[self.gateway] < CLOSE_S:
            last.perhaps_stale = True

    def received(self, command: Command, now: float) -> None:
        """Follow a command that reached the gateway: when motion must wait for neutral."""
        self.used = True
        late_s = now - command.given_at
        self.base_s = min(self.base_s, late_s)
        late_s -= self.base_s
        if not command.dated or late_s < MAX_AGE_S + 0.1:
            self.renewed_at = now
        if command.number < self._newest:
            return  # refused as out of order
        self._newest = command.number
        mode = self.last_mode
        if mode is not None and mode.called_off is None and not command.value and command.number > mode.number:
            mode.called_off = now
        if command.kind == "mode":
            self.autonomous, self.last_mode = command.value > 0, command
            return
        if not command.value:
            if late_s < 0.3 or not command.dated:
                self.moved -= {command.part} if command.part else self.moved
                self.needs_neutral = bool(self.needs_neutral and self.moved)
            self.last_motion, self.autonomous = None, False
            return
        most_s = min(MAX_AGE_S, self.deadman_s)
        if command.dated and late_s > most_s + CLOSE_S:
            return  # refused as stale for certain: it begins nothing
        command.perhaps_stale = command.dated and late_s > most_s - CLOSE_S
        last = self.last_motion
        if last is not None and not last.perhaps_stale:
            since_s = now - (last.given_at if last.dated else last.received[self.gateway])
            if since_s > self.deadman_s + self.base_s + 0.1:
                self.needs_neutral = True
        if self.needs_neutral:
            command.forbidden = "neutral first"
        else:
            self.last_motion = command
            self.moved.add(command.part)


def fault_of(command: Command, grant: Grant | None, gateway: str, now: float) -> tuple[str, str] | None:
    """Return the rule that motion breaks which a gateway writes now, and how; None where this command allows it."""
    received = command.received[gateway]
    if grant is None or grant.gateway != gateway:
        return "no-lease", "without a lease of this gateway"
    if command.who != grant.asker:
        return "forged", f"{command.who} used the lease of {grant.asker}"
    if grant.over(now, SLACK_S):
        return "lease-ended", f"its lease ended {now - (grant.ended_at or 0):.2f} s ago: {grant.why}"
    if received < grant.at:
        return "no-lease", "received before its lease"
    if command.forbidden:
        return "neutral-first", "after the deadman, without a neutral"
    late_s = received - command.given_at - grant.base_s
    if command.dated and late_s > min(MAX_AGE_S, grant.deadman_s) + CLOSE_S:
        return "stale", f"it came {late_s:.2f} s late"
    if command.called_off is not None and now > command.called_off + SLACK_S:
        return "called-off", f"it was called off {now - command.called_off:.2f} s ago"
    if command.kind == "mode":
        return ("stale", "long ago") if now - received > 2.5 else None
    given_at = command.given_at + grant.base_s if command.dated else received
    if now - given_at > grant.deadman_s + 0.1:
        return "deadman", f"given {now - given_at:.2f} s ago, deadman {grant.deadman_s:g} s"
    return None


def read(payload: bytes | None) -> dict[str, Any]:
    """Read a MessagePack map; anything else is empty."""
    try:
        fields = msgpack.unpackb(payload) if payload else {}
    except (ValueError, msgpack.exceptions.UnpackException):
        return {}
    return fields if isinstance(fields, dict) else {}


def motions(protocol: str, data: bytes) -> list[tuple[str, float]]:
    """Read the motion in what was written to a robot: (``motion`` or ``mode``, fraction of full scale or mode)."""
    found: list[tuple[str, float]] = []
    if protocol == "tcpudp" and len(data) >= 6:
        if data[5] == 11 and len(data) >= 18:
            found = [("motion", abs(struct.unpack("<fff", data[6:18])[2]))]
        elif data[5] == 12 and len(data) >= 10:
            found = [("motion", abs(struct.unpack("<f", data[6:10])[0]))]
        elif data[5] == 10 and len(data) >= 10:
            found = [("mode", float(struct.unpack("<i", data[6:10])[0]))]
    elif protocol == "alf":
        if data[:1] == b"\x03":
            found = [("motion", data[1] / 100)]
        else:
            found = [("motion", int(speed) / 100) for speed in re.findall(rb"(?:^|;)3\|(\d+)\|", data)]
    elif protocol == "wc2ec":
        for start in range(0, len(data) - 10, 11):
            if data[start] == 130:
                found.append(("motion", abs(struct.unpack("<d", data[start + 3 : start + 11])[0]) / WHEEL_FULL))
    return [(kind, value) for kind, value in found if value]
