"""Two drivers fight for one robot: does it ever obey both, and does the audit log tell all of it?

    python -m tests.e2e.measured.fight                 # a minute
    python -m tests.e2e.measured.fight --seconds 600 --seed 3

Two processes acquire, take over, drive, go silent, stop and release as chance wills, and drive on for a while with
leases they have lost. Each lease is asked for under a name of its own, and each command has a value of its own, so that
every motion at the robot belongs to one lease. The drivers' own accounts, the audit log, ``control``, and what arrived
at the robot must tell the same story.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import random
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import msgpack
import zenoh

from tests.e2e.conftest import configuration
from tests.e2e.rigs.loss import Scene, commander, query
from tests.e2e.rigs.processes import Part, module
from tests.e2e.rigs.robots import SCALE, STOP, Frame
from tests.proofs import Holder

NAMES = ("anna", "bert")
LEASE_S, DEADMAN_S = 0.4, 0.15
GRANTS = {"acquired", "taken over"}
ENDS = {"released", "ended"}
WRITTEN = {"acquire": "acquired", "takeover": "taken over", "release": "released"}
SLACK_S = 0.3
"""Seconds by which several processes of one machine, when it is busy, may differ about when something was."""
_NUMBERS = 100
"""Commands with a value of their own that one lease may carry; SCALE / 100 leases a driver."""


# A driver's process


class Driver:
    """One of the two. Prints what it did and what it was answered, a JSON line each, with the Unix times around it."""

    def __init__(self, session: zenoh.Session, name: str, rng: random.Random) -> None:
        self._session = session
        self._name = name
        self._rng = rng
        self._asked = 0
        self._drive = commander(session, "drive")
        self._stop = commander(session, "stop")
        self._alive = f"operator.{name}.{session.zid()}"
        self._announced = session.liveliness().declare_token(f"fleet/r1/@alive/{self._alive}")

    def fight(self, seconds: float) -> None:
        """Fight until the time is up."""
        ends_at = time.monotonic() + seconds
        while time.monotonic() < ends_at:
            lease = self._ask()
            if lease.get("ok"):
                self._use(Holder.of(lease, first=0))
            elif self._rng.random() < 0.1:
                self._stop_robot()
            time.sleep(self._rng.uniform(0.0, 0.05))
        self._announced.undeclare()

    def _ask(self) -> dict[str, Any]:
        """Ask for the lease: mostly politely, sometimes with more right, sometimes as who may take it over."""
        self._asked += 1
        how = self._rng.choices(("acquire", "takeover"), (5, 1))[0]
        wishes = {"who": f"{self._name}.{self._asked}", "priority": self._rng.choice((0, 0, 0, 1, 2))}
        return self._query(f"{how}/{self._name}", **wishes, lease_s=LEASE_S, deadman_s=DEADMAN_S, alive=self._alive)

    def _use(self, held: Holder) -> None:
        """Drive for a while, whether or not the lease is lost meanwhile, and leave it in one of many ways."""
        self._move(held, self._rng.uniform(0.05, 0.3))
        match self._rng.choice(("release", "release", "stop", "silence", "expire", "nothing")):
            case "release":
                self._query("release", held.question("release"))
            case "stop":
                self._stop_robot()
            case "silence":  # longer than the deadman; motion only after a neutral
                time.sleep(DEADMAN_S * 1.5)
                self._query("renew", held.question("renew"))
                self._send(held, 0.0)
                self._move(held, 0.1)
                self._query("release", held.question("release"))
            case "expire":
                time.sleep(LEASE_S * 1.2)
                self._move(held, 0.03)

    def _move(self, held: Holder, seconds: float) -> None:
        ends_at = time.monotonic() + seconds
        while time.monotonic() < ends_at:
            self._send(held, (self._asked * _NUMBERS + (held.seq + 1) % _NUMBERS) / SCALE)
            time.sleep(self._rng.uniform(0.005, 0.03))

    def _send(self, held: Holder, speed: float) -> None:
        """Send a drive; one of the two drives backwards."""
        payload = msgpack.packb({"forward": speed if self._name == NAMES[0] else -speed})
        self._drive.put(payload, attachment=held.attachment("drive", payload))

    def _stop_robot(self) -> None:
        began = time.time()
        self._stop.put(msgpack.packb({}))
        self._tell("stop", began, {"ok": True})

    def _query(self, how: str, payload: bytes = b"", **fields: Any) -> dict[str, Any]:
        began = time.time()
        answer = query(self._session, f"@rpc/control/{how}", payload, **fields)
        self._tell(how.partition("/")[0], began, answer)
        return answer

    def _tell(self, what: str, began: float, answer: dict[str, Any]) -> None:
        account = {
            "what": what,
            "who": f"{self._name}.{self._asked}",
            "ok": answer.get("ok", False),
            "answered": bool(answer),
            "reason": answer.get("reason"),
            "began": began,
            "ended": time.time(),
        }
        print(json.dumps(account), flush=True)


def be_driver(endpoint: str, name: str, seconds: float, seed: str) -> None:
    """Wait for the word, and fight."""
    with zenoh.open(configuration("client", endpoint)) as session:
        driver = Driver(session, name, random.Random(f"{name} {seed}"))
        print("ready", flush=True)
        if sys.stdin.readline():
            driver.fight(seconds)


# What everybody saw


@dataclass
class Story:
    """What the drivers were answered, what was written down, what ``control`` showed, what the robot got."""

    accounts: list[dict[str, Any]] = field(default_factory=list)
    audit: list[dict[str, Any]] = field(default_factory=list)
    control: list[dict[str, Any]] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    clock_s: float = 0.0
    """What the monotonic clock lags behind Unix time."""

    def __str__(self) -> str:
        told = Counter(f"{account['what']} {'granted' if account['ok'] else 'denied'}" for account in self.accounts)
        leases = {holder_of(frame) for frame in self.frames if frame.moves}
        return (
            f"drivers: {dict(told)}\naudit: {dict(Counter(line['event'] for line in self.audit))}\n"
            f"control: {len(self.control)} messages\n"
            f"robot: {sum(frame.moves for frame in self.frames)} motions of {len(leases)} leases, "
            f"{sum(frame.packet_id == STOP for frame in self.frames)} stops"
        )


def holder_of(frame: Frame) -> str:
    """Read from a motion which lease it was sent under."""
    return f"{NAMES[frame.number < 0]}.{abs(frame.number) // _NUMBERS}"


def fight(seconds: float, seed: int = 1) -> Story:
    """Let two drivers fight for a robot, and gather what everybody saw."""
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        audit = Path(folder) / "audit"
        scene = Scene(stack, parts=f"[control]\naudit = {json.dumps(str(audit))}\naudit_bytes = 1_000_000_000\n")
        story = Story(frames=scene.robot.frames, clock_s=time.time() - time.monotonic())
        stack.enter_context(
            scene.session.declare_subscriber(
                "fleet/r1/control", lambda sample: story.control.append(msgpack.unpackb(sample.payload.to_bytes()))
            )
        )
        driver = ("tests.e2e.measured.fight", "--be", "driver", scene.endpoint)
        drivers = [Part(stack, *module(*driver, name, seconds, seed)) for name in NAMES]
        for driver_part in drivers:
            assert driver_part.line() == "ready"
        for driver_part in drivers:
            driver_part.say("go")
        for driver_part in drivers:
            story.accounts += map(json.loads, driver_part.rest(seconds + 20))
        time.sleep(LEASE_S + 1.2)  # what refusals repeat themselves is written once a second
        scene.gateway.end()
        story.audit = [json.loads(line) for line in audit.read_text().splitlines()]
    return story


# Whether it is one story


def faults(story: Story) -> list[str]:
    """Hold the accounts against one another; give every contradiction."""
    if not story.audit or not story.accounts or not story.frames:
        return ["nothing happened"]
    held, found = _held(story.audit)
    found += [*_answers(story), *_stops(story)]
    return [*found, *_control(story, [*held]), *_robot(story, held)]


def _at(line: dict[str, Any]) -> float:
    return datetime.fromisoformat(line["time"]).timestamp()


def _held(audit: list[dict[str, Any]]) -> tuple[dict[str, tuple[float, float]], list[str]]:
    """Read from the log who held the robot, in order, from when to when in Unix time.

    The lease must be given only when nobody has it, and end only for who has it.
    """
    held: dict[str, tuple[float, float]] = {}
    found, holder = [], None
    for line in audit:
        event, who = line["event"], line.get("who")
        if event in GRANTS:
            if holder is not None:
                found.append(f"{who} was given the lease of {holder}")
            holder, held[who] = who, (_at(line), float("inf"))
        elif event in (*ENDS, "stopped"):
            if who != holder:
                found.append(f"{event} {who} while {holder} held the lease")
            if line.get("reason") != "deadman":  # after a deadman the lease stays
                held[who] = (held.get(who, (0.0, 0.0))[0], _at(line))
                holder = None
    return held, found


def _answers(story: Story) -> list[str]:
    """Check that what the drivers were answered is in the log, in its order and at its time, and nothing else."""
    written = {(line["event"], line.get("who")): line for line in story.audit}
    answered = {(WRITTEN[a["what"]], a["who"]): a for a in story.accounts if a["ok"] and a["what"] in WRITTEN}
    unanswered = {account["who"] for account in story.accounts if not account["answered"]}
    found = [f"{who} was answered, the log has not {event}" for event, who in answered.keys() - written.keys()]
    began = 0.0
    for (event, who), line in written.items():
        account = answered.get((event, who))
        if account is None:
            if event in GRANTS and who not in unanswered:
                found.append(f"the log has {event}, {who} was not granted it")
            continue
        if event in GRANTS:
            if account["ended"] < began:
                found.append(f"{who} was granted before the one that the log has before")
            began = max(began, account["began"])
        if not account["began"] - SLACK_S <= _at(line) <= account["ended"] + SLACK_S:
            found.append(f"{line} is not in the time of {account}")
    refused = {(line.get("who"), line.get("reason")) for line in story.audit if line["event"] == "refused"}
    denied = [a for a in story.accounts if a["what"] in ("acquire", "takeover") and a["answered"] and not a["ok"]]
    reasons = {(account["who"], account["reason"]) for account in denied}
    return found + [f"{who} was denied ({reason}), the log has no word of it" for who, reason in reasons - refused]


SAME_STOP_S = 0.3
"""Seconds after a stop within which another one may be counted with it, however late the machine is."""


def _stops(story: Story) -> list[str]:
    """Check that every stop is written down."""
    stops = sorted(account["began"] for account in story.accounts if account["what"] == "stop")
    apart = sum(later - sooner > SAME_STOP_S for sooner, later in itertools.pairwise([0.0, *stops]))
    lines = [line for line in story.audit if line["event"] == "stopped" and line.get("reason") == "stop"]
    written = sum(line.get("count", 1) for line in lines)
    if apart <= written <= len(stops):
        return []
    return [f"{len(stops)} stops were put, {apart} of them apart, {written} are in the log"]


def _control(story: Story, order: list[str]) -> list[str]:
    """Check that ``control`` shows one holder at most, and the holders in the log's order."""
    found = [
        f"control: {shown['state']} by {shown.get('holder')}"
        for shown in story.control
        if (shown["state"] == "held") != (shown.get("holder") is not None)
    ]
    holders = [shown["holder"] for shown in story.control if shown.get("holder") is not None]
    return found + _in_order("control shows", holders, order)


def _in_order(what: str, holders: list[str], order: list[str]) -> list[str]:
    """Check that every holder is in the log, and comes in its order."""
    strangers = {holder for holder in holders if holder not in order}
    places = [order.index(holder) for holder in holders if holder in order]
    back = [order[later] for sooner, later in itertools.pairwise(places) if later < sooner]
    found = [f"{what} {holder}, who is not in the log" for holder in strangers]
    return found + [f"{what} {holder} after a later holder" for holder in back]


def _robot(story: Story, held: dict[str, tuple[float, float]]) -> list[str]:
    """Check that the robot moved for one holder after the other, in the log's order, and was stopped in between."""
    found = _in_order("the robot moved for", [holder_of(frame) for frame in story.frames if frame.moves], [*held])
    moving: str | None = None
    for frame in story.frames:
        if not frame.moves:
            moving = None if frame.packet_id == STOP else moving
            continue
        who, at = holder_of(frame), frame.at + story.clock_s
        if moving not in (None, who):
            found.append(f"the robot moved for {moving} and then for {who} without a stop")
        begins, ends = held.get(who, (0.0, float("inf")))
        if not begins - SLACK_S <= at <= ends + SLACK_S:
            found.append(f"the robot moved for {who} at {at - begins:.3f} s of its lease")
        moving = who
    return found + ([f"the robot was left moving for {moving}"] if moving is not None else [])


def main() -> None:
    if sys.argv[1:3] == ["--be", "driver"]:
        endpoint, name, seconds, seed = sys.argv[3:]
        be_driver(endpoint, name, float(seconds), seed)
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=os.getpid())
    wanted = parser.parse_args()
    print(f"seed {wanted.seed}", flush=True)
    story = fight(wanted.seconds, wanted.seed)
    print(story)
    found = faults(story)
    for fault in found[:20]:
        print("FAULT:", fault)
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
