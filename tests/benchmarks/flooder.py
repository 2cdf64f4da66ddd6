"""Sends floods that no gateway wants: ``python -m tests.benchmarks.flooder ENDPOINT``.

``flood KIND RATE_HZ SECONDS LEASE`` sends one kind (:data:`KINDS`) for so long, at a rate (0: as fast as Zenoh takes
it) in bursts of a millisecond; LEASE is the holder's public id in hex. Tells how many were sent, and when.
Puts block where the bus is full, so that every one arrives; queries do not wait for their answers.
"""

from __future__ import annotations

import gc
import itertools
import os
import sys
import time
from collections.abc import Callable, Iterator

import zenoh

from tests.benchmarks.drives import CONTROL, DRIVE, drive, packed
from tests.benchmarks.peer import ROBOT, hear, open_session, tell

COMMANDS = f"fleet/{ROBOT}/@cmd"
BIG = 1_000_000
"""Bytes of the payloads that are too big."""
_BURST_S = 0.001
_READY = 4096

Send = Callable[[], object]


def _drives(session: zenoh.Session, lease: bytes) -> Send:
    """Drives without attachment, with one that is no authorization, and with another lease's, by turns."""
    put, payload = _publisher(session, DRIVE), packed(drive(2**19))
    shown = itertools.cycle(
        [None, b"no proof", packed({"lease": bytes(8), "seq": 2**63, "proof": bytes(16)})],
    )
    return lambda: put(payload, attachment=next(shown))


def _express(session: zenoh.Session, lease: bytes) -> Send:
    """Drives without attachment, each sent by itself: as dear for the receiving session as can be."""
    publisher = session.declare_publisher(
        DRIVE, priority=zenoh.Priority.REAL_TIME, congestion_control=zenoh.CongestionControl.BLOCK, express=True
    )
    put, payload = publisher.put, packed(drive(2**19))
    return lambda: put(payload)


def _forged(session: zenoh.Session, lease: bytes) -> Send:
    """Drives with the holder's lease, high numbers and a random proof."""
    put, payload = _publisher(session, DRIVE), packed(drive(2**19))
    made = [packed({"lease": lease, "seq": 2**62 + n, "proof": os.urandom(16)}) for n in range(_READY)]
    shown = itertools.cycle(made)
    return lambda: put(payload, attachment=next(shown))


def _scans(session: zenoh.Session, lease: bytes) -> Send:
    put, payload = _publisher(session, f"{COMMANDS}/scan"), bytes(BIG)
    return lambda: put(payload)


def _raws(session: zenoh.Session, lease: bytes) -> Send:
    put, payload = _publisher(session, f"{COMMANDS}/raw/tcpudp"), bytes(BIG)
    return lambda: put(payload)


def _small_scans(session: zenoh.Session, lease: bytes) -> Send:
    """Scans that are as large as they may be, and cannot be read."""
    put, payload = _publisher(session, f"{COMMANDS}/scan"), bytes(60_000)
    return lambda: put(payload)


def _stops(session: zenoh.Session, lease: bytes) -> Send:
    put = _publisher(session, f"{COMMANDS}/stop")
    return lambda: put(b"")


def _acquires(session: zenoh.Session, lease: bytes) -> Send:
    return _query(session, "acquire/noise", packed({"who": "noise"}))


def _takeovers(session: zenoh.Session, lease: bytes) -> Send:
    return _query(session, "takeover/noise", packed({"who": "noise"}))


def _renewals(session: zenoh.Session, lease: bytes) -> Send:
    return _query(session, "renew", packed({"lease": lease, "seq": 2**62, "proof": bytes(16)}))


KINDS: dict[str, Callable[[zenoh.Session, bytes], Send]] = {
    "drives": _drives,
    "express": _express,
    "forged": _forged,
    "acquires": _acquires,
    "renewals": _renewals,
    "scans": _scans,
    "raws": _raws,
    "small": _small_scans,
    "stops": _stops,
    "takeovers": _takeovers,
}


def main() -> None:
    """Do what the harness says until it is gone."""
    gc.disable()  # it lives for seconds
    with open_session(connect=sys.argv[1], shared_memory=False) as session:
        tell(ready=True)
        while True:
            word, *arguments = (hear() or "").split() or [""]
            if word == "flood":
                kind, rate_hz, seconds, lease = arguments
                send = KINDS[kind](session, bytes.fromhex(lease))
                begun_ns = time.perf_counter_ns()
                sent = _flood(send, float(rate_hz), float(seconds))
                tell(sent=sent, begun_ns=begun_ns, ended_ns=time.perf_counter_ns())


def _publisher(session: zenoh.Session, key: str) -> Callable[..., object]:
    publisher = session.declare_publisher(
        key, priority=zenoh.Priority.REAL_TIME, congestion_control=zenoh.CongestionControl.BLOCK
    )
    return publisher.put


def _query(session: zenoh.Session, name: str, payload: bytes) -> Send:
    def send() -> None:
        session.get(
            f"{CONTROL}/{name}",
            zenoh.handlers.RingChannel(1),
            payload=payload,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timeout=1.0,
        )

    return send


def _flood(send: Send, rate_hz: float, seconds: float) -> int:
    begun, sent = time.perf_counter(), 0
    for _ in _moments(begun + seconds):
        due = sent + 256 if not rate_hz else int((time.perf_counter() - begun) * rate_hz)
        while sent < due:
            send()
            sent += 1
        if rate_hz:
            time.sleep(_BURST_S)
    return sent


def _moments(end: float) -> Iterator[None]:
    while time.perf_counter() < end:
        yield


if __name__ == "__main__":
    main()
