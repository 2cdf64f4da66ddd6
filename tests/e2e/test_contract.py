"""Commands on a real bus that others overhear: what they see, and what they can do with it (nothing)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import msgpack
import pytest
import zenoh

from tests.e2e.conftest import Bench, until
from tests.e2e.loss import configuration
from tests.e2e.robots import ScriptedRobot
from tests.proofs import Holder, packed, shown

DRIVE = "fleet/r1/@cmd/drive"
FORWARD, TURN = packed({"forward": 0.5}), packed({"turn": 0.5})


@pytest.fixture
def robot() -> Iterator[ScriptedRobot]:
    scripted = ScriptedRobot()
    yield scripted
    scripted.close()


class Eavesdropper:
    """Listens to every command, and to every question by a queryable that never answers."""

    def __init__(self, session: zenoh.Session) -> None:
        self.commands: list[tuple[str, bytes, bytes]] = []
        self.questions: list[tuple[str, bytes]] = []
        self._session = session
        self._declared = (
            session.declare_subscriber("fleet/*/@cmd/**", self._hear),
            session.declare_queryable("fleet/*/@rpc/**", self._overhear),
        )

    def _hear(self, sample: zenoh.Sample) -> None:
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else b""
        self.commands.append((str(sample.key_expr), sample.payload.to_bytes(), attachment))

    def _overhear(self, query: zenoh.Query) -> None:
        self.questions.append((str(query.key_expr), query.payload.to_bytes() if query.payload is not None else b""))
        query.drop()  # type: ignore[no-untyped-call]

    def put(self, key: str, payload: bytes, attachment: bytes) -> None:
        self._session.put(key, payload, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)

    def leave(self) -> None:
        for each in self._declared:
            each.undeclare()


def ask(session: zenoh.Session, key: str, payload: bytes) -> dict[str, Any]:
    """Ask one thing about the lease: the answer, or the error."""
    (reply,) = (reply for reply in session.get(key, payload=payload, timeout=2.0))
    answer: dict[str, Any] = msgpack.unpackb((reply.ok or reply.err).payload.to_bytes())
    return answer


def acquired(session: zenoh.Session) -> Holder:
    return Holder.of(ask(session, "fleet/r1/@rpc/control/acquire/me%40here", packed({"who": "me@here"})))


def refused(bench: Bench, code: str, command: str) -> dict[str, Any] | None:
    entries = bench.fleet.last("r1/control").get("refusals", [])
    return next((entry for entry in entries if (entry["code"], entry["command"]) == (code, command)), None)


def test_whoever_overhears_everything_can_do_nothing_with_it(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    with (
        zenoh.open(configuration("client", [bench.endpoint])) as ours,
        zenoh.open(configuration("client", [bench.endpoint])) as theirs,
    ):
        ear = Eavesdropper(theirs)
        time.sleep(0.3)  # until what it declared is known
        held = acquired(ours)
        control = until(lambda: bench.fleet.last("r1/control"))
        until(lambda: bench.fleet.last("r1/control")["lease"] == held.lease, what="the public id")
        for _ in range(3):
            ours.put(DRIVE, FORWARD, attachment=held.attachment("drive", FORWARD))
        assert ask(ours, "fleet/r1/@rpc/control/renew", held.question("renew"))["ok"]
        until(lambda: len(ear.commands) == 3 and any("renew" in key for key, _ in ear.questions), what="overheard")
        assert control["state"] in ("free", "held")
        seen = b"".join(b"".join(map(bytes, heard[1:])) for heard in (*ear.commands, *ear.questions))
        assert held.token not in seen
        assert not any(part in seen for part in (held.token[:8], held.token[-8:]))

        until(lambda: robot.packets(11), what="motion")
        moves = len(robot.packets(12))
        _, payload, attachment = ear.commands[-1]
        ear.put(DRIVE, payload, attachment)
        until(lambda: refused(bench, "out_of_order", "drive"), what="the repeated one refused")
        ear.put(DRIVE, TURN, attachment)
        ear.put("fleet/r1/@cmd/motor/left", payload, attachment)
        ear.put(DRIVE, TURN, shown(held.lease, bytes(32), DRIVE, 2**63, TURN))
        until(lambda: (refused(bench, "malformed", "drive") or {}).get("count") == 2, what="the altered ones refused")
        until(lambda: refused(bench, "malformed", "motor/left"), what="that of another key refused")
        (renewal,) = (payload for key, payload in ear.questions if key.endswith("/renew"))
        assert ask(theirs, "fleet/r1/@rpc/control/renew", renewal)["code"] == "out_of_order"
        assert ask(theirs, "fleet/r1/@rpc/control/release", renewal)["code"] == "malformed"

        assert {entry["who"] for entry in bench.fleet.last("r1/control")["refusals"]} == {None}
        ours.put(DRIVE, FORWARD, attachment=held.attachment("drive", FORWARD))
        time.sleep(0.2)
        assert len(robot.packets(12)) == moves, "nothing they sent was carried out"
        assert bench.fleet.last("r1/control")["holder"] == "me@here"
        assert ask(ours, "fleet/r1/@rpc/control/release", held.question("release"))["ok"]
        ear.put(DRIVE, payload, attachment)
        late = until(lambda: refused(bench, "lease_ended", "drive"), what="one of the former lease refused")
        assert late["who"] is None
        ear.leave()


def test_of_what_has_wildcards_only_a_stop_is_carried_out(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    session = bench.fleet.session
    held = acquired(session)
    wild = "fleet/*/@cmd/drive"
    session.put(wild, TURN, attachment=shown(held.lease, held.token, wild, 1, TURN))
    until(lambda: refused(bench, "malformed", "drive"), what="refusal")
    for asked in ("acquire/*", "takeover/*"):
        error = ask(session, f"fleet/r1/@rpc/control/{asked}", packed({"who": "me@here"}))
        assert (error["code"], error["reason"]) == ("malformed", "its key has wildcards")
    wild = "fleet/*/@rpc/control/renew"
    assert ask(session, wild, shown(held.lease, held.token, wild, 1))["code"] == "malformed"
    error = ask(session, "fleet/r1/@rpc/control/takeover/other", packed({"who": "me@here"}))
    assert (error["code"], error["reason"]) == ("malformed", "who = 'me@here': expected 'other', or that and '.suffix'")
    assert not robot.packets(12)

    session.put(DRIVE, FORWARD, attachment=held.attachment("drive", FORWARD))
    moved_at, _ = until(lambda: robot.packets(11), what="motion")[0]
    session.put("fleet/*/@cmd/stop", b"")
    until(lambda: [at for at, _ in robot.packets(13) if at > moved_at], what="the stop")
    until(lambda: bench.fleet.last("r1/control")["state"] == "stopped")
    assert refused(bench, "malformed", "stop") is None
    assert refused(bench, "unsupported", "stop") is None
