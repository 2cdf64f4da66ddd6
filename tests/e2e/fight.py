"""Two drivers fight for one robot: does it ever obey both, and does the audit log tell all of it?

    python -m tests.e2e.fight                 # a minute
    python -m tests.e2e.fight --seconds 600 --seed 3

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

from tests.e2e.loss import SCALE, STOP, Frame, Scene, commander, configuration, kill, query, start
from tests.proofs import Holder

NAMES = ("anna", "bert")
LEASE_S, DEADMAN_S = 0.4, 0.15
GRANTS = {"acquired", "taken over"}
ENDS = {"released", "ended"}
SLACK_S = 0.1
"""Seconds by which clocks of one machine, read in several processes, may disagree when it is busy."""
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
    with zenoh.open(configuration("client", [endpoint])) as session:
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
    log: str = ""

    def __str__(self) -> str:
        told = Counter(
            f"{a['what']} {'granted' if a['ok'] else 'denied'}" for a in self.accounts if a["what"] != "stop"
        )
        told["stop"] = sum(account["what"] == "stop" for account in self.accounts)
        runs = [holder for holder, _ in itertools.groupby(who for _, who in self.motions())]
        return (
            f"drivers: {dict(told)}\naudit: {dict(Counter(line['event'] for line in self.audit))}\n"
            f"control: {len(self.control)} messages\n"
            f"robot: {sum(1 for _ in self.motions())} motions of {len(runs)} leases, "
            f"{sum(frame.packet_id == STOP for frame in self.frames)} stops"
        )

    def motions(self) -> list[tuple[Frame, str]]:
        """Give the motions that arrived, each with the name that its lease was asked for under."""
        return [(frame, holder_of(frame)) for frame in self.frames if frame.moves]


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
        command = [sys.executable, "-m", "tests.e2e.fight", "--be", "driver", scene.endpoint]
        drivers = [start(*command, name, str(seconds), str(seed)) for name in NAMES]
        for driver in drivers:
            stack.callback(kill, driver)
            assert driver.stdout is not None
            assert driver.stdout.readline() == "ready\n"
        for driver in drivers:
            assert driver.stdin is not None
            driver.stdin.write("go\n")
            driver.stdin.flush()
        for driver in drivers:
            output, _ = driver.communicate(timeout=seconds + 20)
            story.accounts += map(json.loads, output.splitlines())
            assert driver.returncode == 0
        time.sleep(LEASE_S + 1.2)  # what refusals repeat themselves is written once a second
        scene.gateway.terminate()
        assert scene.gateway.wait(timeout=5) == 0
        story.audit = [json.loads(line) for line in audit.read_text().splitlines()]
        scene.log.seek(0)
        story.log = scene.log.read()
    return story


# Whether it is one story


def faults(story: Story) -> list[str]:
    """Hold the accounts against one another; give every contradiction."""
    if not story.audit or not story.accounts or not story.frames:
        return ["nothing happened"]
    found = [
        *_shape(story.audit),
        *_one_holder(story.audit),
        *_grants(story),
        *_releases_and_stops(story),
        *_refusals(story),
        *_control(story),
        *_robot(story),
    ]
    if "Traceback" in story.log:
        found.append(f"the gateway failed: {story.log}")
    return found


def _shape(audit: list[dict[str, Any]]) -> list[str]:
    """Check that every line has a time in UTC with milliseconds, in order, and what happened to which robot."""
    found, last = [], ""
    for line in audit:
        at = datetime.fromisoformat(line["time"])
        if at.utcoffset() is None or at.utcoffset() or line["time"] != at.isoformat(timespec="milliseconds"):
            found.append(f"time {line['time']!r} is not UTC with milliseconds")
        if line["time"] < last:
            found.append(f"{line['time']} after {last}")
        last = line["time"]
        if line["robot"] != "r1" or not line["event"]:
            found.append(f"no robot or event: {line}")
    return found


def _one_holder(audit: list[dict[str, Any]]) -> list[str]:
    """Check that the lease was given only when nobody had it, and ended only for who had it."""
    found, holder = [], None
    for line in audit:
        event, who = line["event"], line.get("who")
        if event in GRANTS:
            if holder is not None:
                found.append(f"{who} was given the lease of {holder}")
            holder = who
        elif event in ENDS:
            if who != holder:
                found.append(f"{event} {who} while {holder} held the lease")
            holder = None
        elif event == "stopped":
            if who != holder:
                found.append(f"stopped {who} while {holder} held the lease")
            if line.get("reason") != "deadman":  # after a deadman the lease stays
                holder = None
    return found


def _grants(story: Story) -> list[str]:
    """Check that the drivers were granted what the log says, when it says, in its order."""
    granted = {a["who"]: a for a in story.accounts if a["ok"] and a["what"] in ("acquire", "takeover")}
    lines = [line for line in story.audit if line["event"] in GRANTS]
    unanswered = {account["who"] for account in story.accounts if not account["answered"]}
    found = [
        f"{who} was granted, the log has no word of it" for who in granted.keys() - {line["who"] for line in lines}
    ]
    began = 0.0
    for line in lines:
        account = granted.get(line["who"])
        if account is None:
            if line["who"] not in unanswered:
                found.append(f"the log says {line['event']}, {line['who']} was not granted it")
            continue
        if (account["what"] == "takeover") != (line["event"] == "taken over"):
            found.append(f"the log says {line['event']}, {line['who']} asked for {account['what']}")
        if account["ended"] < began:
            found.append(f"{line['who']} was granted before the one that the log has before")
        began = max(began, account["began"])
        found += _in_time(line, account)
    return found


def _in_time(line: dict[str, Any], account: dict[str, Any]) -> list[str]:
    at = datetime.fromisoformat(line["time"]).timestamp()
    if account["began"] - SLACK_S <= at <= account["ended"] + SLACK_S:
        return []
    return [f"{line} is not in the time of {account}"]


SAME_STOP_S = 0.3
"""Seconds after a stop within which another one may be counted with it, however late the machine is."""


def _releases_and_stops(story: Story) -> list[str]:
    """Check that every release that was answered, and every stop, is written down."""
    released = {line["who"]: line for line in story.audit if line["event"] == "released"}
    accounts = {a["who"]: a for a in story.accounts if a["what"] == "release" and a["ok"]}
    found = [f"{who} released, the log has no word of it" for who in accounts.keys() - released.keys()]
    found += [fault for who in accounts.keys() & released.keys() for fault in _in_time(released[who], accounts[who])]
    stops = sorted(account["began"] for account in story.accounts if account["what"] == "stop")
    apart = sum(later - sooner > SAME_STOP_S for sooner, later in itertools.pairwise([0.0, *stops]))
    written = sum(
        line.get("count", 1) for line in story.audit if line["event"] == "stopped" and line.get("reason") == "stop"
    )
    if not apart <= written <= len(stops):
        found.append(f"{len(stops)} stops were put, {apart} of them apart, {written} are in the log")
    return found


def _refusals(story: Story) -> list[str]:
    """Check that who was denied the lease is in the log with the reason that it was told."""
    written = {(line.get("who"), line.get("reason")) for line in story.audit if line["event"] == "refused"}
    denied = [a for a in story.accounts if a["what"] in ("acquire", "takeover") and a["answered"] and not a["ok"]]
    return [
        f"{a['who']} was denied ({a['reason']}), the log has no word of it"
        for a in denied
        if (a["who"], a["reason"]) not in written
    ]


def _control(story: Story) -> list[str]:
    """Check that ``control`` shows one holder at most, and the holders in the log's order."""
    order = _order(story)
    found, last = [], -1
    for shown in story.control:
        holder = shown.get("holder")
        if (shown["state"] == "held") != (holder is not None):
            found.append(f"control: {shown['state']} by {holder}")
        if holder is None:
            continue
        if holder not in order:
            found.append(f"control shows {holder}, who is not in the log")
        elif order[holder] < last:
            found.append(f"control shows {holder} after a later holder")
        else:
            last = order[holder]
    return found


def _order(story: Story) -> dict[str, int]:
    lines = [line["who"] for line in story.audit if line["event"] in GRANTS]
    return {who: number for number, who in enumerate(lines)}


def _robot(story: Story) -> list[str]:
    """Check that the robot moved for one holder after the other, in the log's order, and was stopped in between."""
    order, times = _order(story), _times(story)
    found: list[str] = []
    moving: str | None = None
    last = -1
    for frame in story.frames:
        if not frame.moves:
            moving = None if frame.packet_id == STOP else moving
            continue
        who = holder_of(frame)
        if who not in order:
            found.append(f"the robot moved for {who}, who is not in the log")
            continue
        if order[who] < last:
            found.append(f"the robot moved for {who} after a later holder")
        if moving not in (None, who):
            found.append(f"the robot moved for {moving} and then for {who} without a stop")
        begins, ends = times[who]
        if not begins - SLACK_S <= frame.at + story.clock_s <= ends + SLACK_S:
            found.append(f"the robot moved for {who} at {frame.at + story.clock_s - begins:.3f} s of its lease")
        moving, last = who, max(last, order[who])
    if moving is not None:
        found.append(f"the robot was left moving for {moving}")
    return found


def _times(story: Story) -> dict[str, tuple[float, float]]:
    """Give when each lease began and ended, in Unix time."""
    times: dict[str, tuple[float, float]] = {}
    holder: str | None = None
    for line in story.audit:
        at = datetime.fromisoformat(line["time"]).timestamp()
        if line["event"] in GRANTS:
            holder = line["who"]
            times[holder] = (at, float("inf"))
        elif holder is not None and line["event"] != "refused" and line.get("reason") != "deadman":
            times[holder] = (times[holder][0], at)
            holder = None
    return times


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
