"""Commands on a real bus that others overhear: what they see, and what they can do with it (nothing)."""

from __future__ import annotations

import time
from typing import Any

import zenoh

from tests.e2e.conftest import Bench, ask, configuration, until
from tests.e2e.rigs.robots import MOVE, ROTATE, Robot
from tests.proofs import Holder, packed, shown

DRIVE = "fleet/r1/@cmd/drive"
CONTROL = "fleet/r1/@rpc/control/"
FORWARD, TURN = packed({"forward": 0.5}), packed({"turn": 0.5})


class Eavesdropper:
    """Listens to every command, and to every question by a queryable that never answers."""

    def __init__(self, session: zenoh.Session) -> None:
        self.commands: list[tuple[bytes, bytes]] = []
        self.questions: list[tuple[str, bytes]] = []
        self._session = session
        self._declared = (
            session.declare_subscriber("fleet/*/@cmd/**", self._hear),
            session.declare_queryable("fleet/*/@rpc/**", self._overhear),
        )

    def _hear(self, sample: zenoh.Sample) -> None:
        self.commands.append((sample.payload.to_bytes(), sample.attachment.to_bytes() if sample.attachment else b""))

    def _overhear(self, query: zenoh.Query) -> None:
        self.questions.append((str(query.key_expr), query.payload.to_bytes() if query.payload is not None else b""))
        query.drop()  # type: ignore[no-untyped-call]

    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        self._session.put(key, payload, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)

    def leave(self) -> None:
        for each in self._declared:
            each.undeclare()


def answer(session: zenoh.Session, name: str, payload: bytes) -> dict[str, Any]:
    """Ask one thing about the lease: the answer, or the error."""
    (reply,) = ask(session, CONTROL + name, payload)
    assert isinstance(reply, dict)
    return reply


def acquired(session: zenoh.Session) -> Holder:
    return Holder.of(answer(session, "acquire/me%40here", packed({"who": "me@here"})))


def test_whoever_overhears_everything_can_do_nothing_with_it(bench: Bench, robot: Robot) -> None:
    bench.serve(robot.port)
    fleet, client = bench.fleet, configuration("client", bench.endpoint)
    with zenoh.open(client) as ours, zenoh.open(client) as theirs:
        ear = Eavesdropper(theirs)
        time.sleep(0.3)  # until what it declared is known
        held = acquired(ours)
        until(lambda: fleet.last("r1/control").get("lease") == held.lease, what="the public id")
        for _ in range(3):
            ours.put(DRIVE, FORWARD, attachment=held.attachment("drive", FORWARD))
        assert answer(ours, "renew", held.question("renew"))["ok"]
        until(lambda: len(ear.commands) == 3 and any("renew" in key for key, _ in ear.questions), what="overheard")
        seen = b"".join(part for heard in ear.commands for part in heard)
        seen += b"".join(asked for _, asked in ear.questions)
        assert not any(part in seen for part in (held.token[:8], held.token[-8:]))

        until(lambda: robot.packets(MOVE), what="motion")
        payload, attachment = ear.commands[-1]
        ear.put(DRIVE, payload, attachment)
        until(lambda: fleet.refusal(code="out_of_order", command="drive"), what="the repeated one refused")
        ear.put(DRIVE, TURN)
        until(lambda: fleet.refusal(code="no_lease", command="drive"), what="one without a lease refused")
        ear.put(DRIVE, TURN, attachment)
        ear.put("fleet/r1/@cmd/motor/left", payload, attachment)
        ear.put(DRIVE, TURN, shown(held.lease, bytes(32), DRIVE, 2**63, TURN))
        until(lambda: fleet.refusal(code="malformed", command="drive", count=2), what="the altered ones refused")
        until(lambda: fleet.refusal(code="malformed", command="motor/left"), what="that of another key refused")
        (renewal,) = (asked for key, asked in ear.questions if key.endswith("/renew"))
        assert answer(theirs, "renew", renewal)["code"] == "out_of_order"
        assert answer(theirs, "release", renewal)["code"] == "malformed"

        assert {entry["who"] for entry in fleet.last("r1/control")["refusals"]} == {None}
        ours.put(DRIVE, FORWARD, attachment=held.attachment("drive", FORWARD))
        time.sleep(0.2)
        assert not robot.packets(ROTATE), "nothing they sent was carried out"
        assert fleet.last("r1/control")["holder"] == "me@here"
        assert answer(ours, "release", held.question("release"))["ok"]
        ear.put(DRIVE, payload, attachment)
        until(lambda: fleet.refusal(code="lease_ended", command="drive", who=None), what="one of the former lease")
        acquired(ours)
        ear.put("fleet/*/@cmd/stop", b"")
        until(lambda: fleet.last("r1/control")["state"] == "stopped", what="a stop, which is everybody's")
        ear.leave()
