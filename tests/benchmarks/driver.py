"""The client on the bus: raw Zenoh, holds the lease, drives at a steady pace, and asks.

``python -m tests.benchmarks.driver ENDPOINT LEASED``; LEASED 0 drives the script, which knows of no lease. Words:

- ``lease``: get a lease anew, after having had one that has ended; tells both tokens.
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

from tests.benchmarks.drives import CONTROL, DRIVE, attachment, drive, packed, plain
from tests.benchmarks.peer import hear, open_session, tell

_MATCH_S = 15.0
_ASK_S = 2.0


class Driver:
    """Drives one robot. ``leased``: whoever takes the commands wants to see a token."""

    def __init__(self, session: zenoh.Session, *, leased: bool) -> None:
        self._session = session
        self._leased = leased
        self._token: bytes | None = None
        self._seq = 0
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
        self._ask("release", token=ended)
        return {"ended": ended.hex(), "token": self._authorize().hex()}

    def drive(self, first: int, count: int, rate_hz: float) -> dict[str, Any]:
        """Drive on an absolute schedule; end with neutral, which keeps the lease."""
        token = self._authorize() if self._leased else None
        first_seq = self._seq
        commands = [self._command(token, number) for number in (*range(first, first + count), 0)]
        sent_ns = self._pace(commands[:-1], rate_hz)
        payload, shown = commands[-1]
        self._publisher.put(payload, attachment=shown)
        return {"first_seq": first_seq, "sent_ns": sent_ns}

    def renew(self, count: int) -> list[float]:
        """Ask for the lease to go on, one question after the other; microseconds to each answer."""
        payload = packed({"token": self._authorize() if self._leased else bytes(16)})
        return [self._question("renew", payload)[0] for _ in range(count)]

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

    def _command(self, token: bytes | None, number: int) -> tuple[bytes, bytes | None]:
        if token is None:
            return plain(drive(number)), None
        self._seq += 1
        return packed(drive(number)), attachment(token, self._seq - 1)

    def _authorize(self) -> bytes:
        """Give the token of a lease that is held now."""
        if self._token is None or not self._ask("renew", token=self._token)["ok"]:
            lease = self._ask("acquire", who="bench", priority=0)
            if not lease["ok"]:
                raise SystemExit(f"no lease: {lease['reason']}")
            self._token = lease["token"]
        assert self._token is not None
        return self._token

    def _ask(self, what: str, **fields: Any) -> dict[str, Any]:
        answer: dict[str, Any] = msgpack.unpackb(self._question(what, packed(fields))[1])
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
