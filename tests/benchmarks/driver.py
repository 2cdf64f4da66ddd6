"""The client on the bus: raw Zenoh, holds the lease, drives at a steady pace, and asks.

``python -m tests.benchmarks.driver ENDPOINT LEASED``; LEASED 0 drives the script, which knows of no lease. Words:

- ``lease``: get a lease anew, after having had one that has ended; tells the ids and tokens of both.
- ``drive FIRST COUNT RATE_HZ``: drive with running numbers until COUNT were sent or ``halt`` is said, then neutral;
  tells the first sequence number and the time of every put.
- ``renew COUNT``: ask one after the other, tells how long each answer took.
"""

from __future__ import annotations

import gc
import sys
import time
from typing import Any

import msgpack
import zenoh

from tests.benchmarks.drives import CONTROL, DRIVE, drive, packed, plain
from tests.benchmarks.peer import ROBOT, hear, open_session, tell
from tests.proofs import Holder

_MATCH_S = 15.0
_ASK_S = 2.0


class Driver:
    """Drives one robot. ``leased``: whoever takes the commands wants to see a proof."""

    def __init__(self, session: zenoh.Session, *, leased: bool) -> None:
        self._session = session
        self._leased = leased
        self._held: Holder | None = None
        self._publisher = session.declare_publisher(
            DRIVE,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
        )

    def wait(self) -> None:
        """Wait until somebody takes commands."""
        end = time.monotonic() + _MATCH_S
        while not self._publisher.matching_status.matching:  # type: ignore[attr-defined]
            if time.monotonic() > end:
                raise SystemExit(f"nobody took commands within {_MATCH_S:g} s")
            time.sleep(0.005)

    def lease(self) -> dict[str, str]:
        """Have a lease end and get another."""
        ended = self._authorize()
        self._ask("release", ended.question("release"))
        return {"ended": _written(ended), "lease": _written(self._authorize())}

    def drive(self, first: int, count: int, rate_hz: float) -> dict[str, Any]:
        """Drive on an absolute schedule; end with neutral, which keeps the lease."""
        held = self._authorize() if self._leased else None
        first_seq = held.seq + 1 if held is not None else 0
        commands = [_command(held, number) for number in (*range(first, first + count), 0)]
        sent_ns = self._pace(commands[:-1], rate_hz)
        payload, shown = commands[-1]
        self._publisher.put(payload, attachment=shown)
        return {"first_seq": first_seq, "sent_ns": sent_ns}

    def renew(self, count: int) -> list[float]:
        """Ask for the lease to continue, one question after the other; microseconds to each answer."""
        held = self._authorize() if self._leased else Holder(bytes(8), bytes(32), ROBOT)
        questions = [held.question("renew") for _ in range(count)]
        return [self._question("renew", payload)[0] for payload in questions]

    def _pace(self, commands: list[tuple[bytes, bytes | None]], rate_hz: float) -> list[int]:
        put, now_ns = self._publisher.put, time.perf_counter_ns
        begun_ns, period_ns, sent_ns = now_ns(), 1e9 / rate_hz, list[int]()
        for payload, shown in commands:
            wait_ns = begun_ns + (len(sent_ns) + 1) * period_ns - now_ns()
            if hear(max(0.0, wait_ns / 1e9)) is not None:
                break
            sent_ns.append(now_ns())
            put(payload, attachment=shown)
        return sent_ns

    def _authorize(self) -> Holder:
        """Give the lease that is held now."""
        if self._held is None or not self._ask("renew", self._held.question("renew"))["ok"]:
            lease = self._ask("acquire/bench", packed({"who": "bench"}))
            if not lease["ok"]:
                raise SystemExit(f"no lease: {lease['reason']}")
            self._held = Holder.of(lease, ROBOT)
        return self._held

    def _ask(self, what: str, payload: bytes) -> dict[str, Any]:
        answer: dict[str, Any] = msgpack.unpackb(self._question(what, payload)[1])
        return answer

    def _question(self, what: str, payload: bytes) -> tuple[float, bytes]:
        """Ask; give the microseconds until the answer was here, and the answer."""
        begun_ns = time.perf_counter_ns()
        replies = self._session.get(
            f"{CONTROL}/{what}", payload=payload, priority=zenoh.Priority.REAL_TIME, express=True, timeout=_ASK_S
        )
        reply = replies.recv()
        took_us = (time.perf_counter_ns() - begun_ns) / 1e3
        for _ in replies:  # nothing more, but the end of the query
            pass
        if reply.ok is None:
            raise SystemExit(f"{what}: {reply.err.payload.to_string() if reply.err else 'no answer'}")
        return took_us, reply.ok.payload.to_bytes()


def _command(held: Holder | None, number: int) -> tuple[bytes, bytes | None]:
    """Write a drive and what goes with it; what the script reads where there is no lease."""
    if held is None:
        return plain(drive(number)), None
    payload = packed(drive(number))
    return payload, held.attachment("drive", payload)


def _written(held: Holder) -> str:
    return f"{held.lease.hex()}:{held.token.hex()}"


def main() -> None:
    """Do what the harness says until it is gone."""
    gc.disable()  # it lives for seconds
    with open_session(connect=sys.argv[1]) as session:
        driver = Driver(session, leased=sys.argv[2] == "1")
        tell(ready=True)
        while True:
            word, *arguments = (hear() or "").split() or [""]
            if word == "wait":
                driver.wait()
                tell(matched=True)
            elif word == "lease":
                tell(**driver.lease())
            elif word == "drive":
                tell(**driver.drive(int(arguments[0]), int(arguments[1]), float(arguments[2])))
            elif word == "renew":
                tell(took_us=driver.renew(int(arguments[0])))


if __name__ == "__main__":
    main()
