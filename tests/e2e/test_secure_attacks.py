"""Attacks on a robot that is held, by certified members over a real router: none of them succeeds.

The robot has a real gateway (of g2), and op1 holds it all the time. Attackers are plain Zenoh sessions with real
certificates: they send what they like. What would show that an attack succeeded is looked for after each.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh

import zbridge
from tests.access import LAB, OTHER
from tests.e2e.conftest import Bench, Gateway, ask, device, until
from tests.e2e.rigs.secure import FAR, GRACE_S, SecureBus, declared
from tests.proofs import Holder, packed
from zbridge.bus.tls.files import folder_tls
from zbridge.errors import BusError, LeaseLost, Malformed
from zbridge.security.roles import Member, Roles

ROLES = Roles(
    {
        **LAB.names,
        FAR: Member("router"),
        "op2": Member("operator"),
        "g3": Member("gateway", (OTHER,)),
        "h2": Member("hq", (OTHER,)),
    }
)
FORGED = "forged"
DENIED_S = 0.7
DRIVE = packed({"forward": 1.0})
Attack = Callable[["Scene", zenoh.Session], object]


class Scene:
    """A robot with its gateway, and what everybody sees of it."""

    def __init__(self, bench: Bench, folder: Path) -> None:
        self.bus = SecureBus(folder / "bus", ROLES)
        bench.stack.callback(self.bus.stop)
        files = folder_tls(self.bus.folders["g2"])
        tls = f'[bus.tls]\nca = "{files.ca}"\ncertificate = "{files.certificate}"\nkey = "{files.key}"\n'
        audit = f'[control]\naudit = "{folder}/audit.jsonl"\n'
        robot = device(bench.simulator())
        self.gateway = Gateway(bench.stack, folder / "gateway.toml", self.bus.endpoint, robot, audit, tls)
        self.seen: dict[str, dict[str, Any]] = {}
        self.forged = 0
        self._lock = threading.Lock()
        self.far = bench.stack.enter_context(self.bus.session(FAR))
        bench.stack.enter_context(declared(self.far.declare_subscriber("fleet/**", self._take)))
        until(lambda: self.last("status").get("state") == "established", what=self.gateway.log)
        self.audit = folder / "audit.jsonl"

    def _take(self, sample: zenoh.Sample) -> None:
        fields = msgpack.unpackb(sample.payload.to_bytes())
        with self._lock:
            self.forged += FORGED in str(fields)
            self.seen[str(sample.key_expr)] = fields

    def last(self, path: str) -> dict[str, Any]:
        return self.seen.get(f"fleet/r1/{path}", {})

    @contextlib.contextmanager
    def fleet(self, name: str) -> Iterator[Any]:
        tls = folder_tls(self.bus.folders[name])
        with zbridge.blocking.connect(self.bus.endpoint, tls=tls) as fleet:
            yield fleet

    @property
    def refusals(self) -> dict[tuple[str | None, str, str], int]:
        """How often the gateway refused what got as far as that: by who, command and code."""
        entries = self.last("control").get("refusals", ())
        return {(each["who"], each["command"], each["code"]): each["count"] for each in entries}

    def ask(self, session: zenoh.Session, path: str, **wishes: Any) -> list[Any]:
        """Ask for the lease; the forged and the real answers."""
        return ask(session, f"fleet/r1/@rpc/control/{path}", timeout_s=DENIED_S, **wishes)


def drives(scene: Scene, session: zenoh.Session) -> None:
    """Send drives: without a proof, and with one that is forged for the holder's lease, whose id is public."""
    lease = scene.last("control").get("lease") or bytes(8)
    for key in ("fleet/r1/@cmd/drive", "fleet/r1/@cmd/*", "fleet/*/@cmd/drive", "fleet/r1/**"):
        session.put(key, DRIVE)
        session.put(key, DRIVE, attachment=Holder(lease, bytes(32), first=1000).attachment("drive", DRIVE))


def asks(*paths: str, **wishes: Any) -> Attack:
    """Ask for the lease there; succeed if it is granted."""

    def attack(scene: Scene, session: zenoh.Session) -> None:
        answers = [answer for path in paths for answer in scene.ask(session, path, **wishes)]
        assert not any(answer.get("ok") for answer in answers), answers

    return attack


def dies_for_the_holder(scene: Scene, session: zenoh.Session) -> None:
    """Declare the holder's own token, and take it back: as if the holder had died."""
    (own,) = [str(reply.ok.key_expr) for reply in scene.far.liveliness().get(f"{ALIVE}/operator.op1.$*") if reply.ok]
    for key in (own, f"{ALIVE}/operator.op1.$*", f"{ALIVE}/*"):
        token = session.liveliness().declare_token(key)
        time.sleep(0.1)
        token.undeclare()


def stops(scene: Scene, session: zenoh.Session) -> None:
    for key in ("fleet/r1/@cmd/stop", "fleet/*/@cmd/stop", "fleet/**/@cmd/**", "fleet/r1/@cmd/*"):
        session.put(key, packed({}))


def writes_status(scene: Scene, session: zenoh.Session) -> None:
    forged = packed({"state": "offline", "reason": FORGED})
    for key in ("fleet/r1/status", "fleet/r1/control", "fleet/*/status", "fleet/**", "fleet/r$*/status"):
        session.put(key, forged)


def answers_acquire(scene: Scene, session: zenoh.Session) -> None:
    """Answer what the robot's gateway is asked, with leases of its own."""
    granted = packed({"ok": True, "lease": b"f" * 8, "token": b"f" * 32, "holder": FORGED})

    def answer(query: zenoh.Query) -> None:
        with contextlib.suppress(zenoh.ZError):
            query.reply(str(query.key_expr), granted)
        query.drop()

    keys = ("fleet/r1/@rpc/control/acquire/*", "fleet/r1/@rpc/**", "fleet/*/@rpc/**", "fleet/r1/*")
    with declared(*(session.declare_queryable(key, answer) for key in keys)), scene.bus.session("op2") as asking:
        time.sleep(GRACE_S)
        answers = scene.ask(asking, "acquire/op2", who="op2")
        assert [answer["code"] for answer in answers] == ["held"], answers


def claims(scene: Scene, session: zenoh.Session) -> None:
    """Be the robot's gateway: its token, and an answer to whoever asks who has the robot."""
    has = packed({"held_s": 3600.0, "has": True})

    def answer(query: zenoh.Query) -> None:
        with contextlib.suppress(zenoh.ZError):
            query.reply("fleet/r1/@rpc/claim/gateway", has)
        query.drop()

    with declared(
        session.declare_queryable("fleet/r1/@rpc/claim/gateway", answer),
        session.liveliness().declare_token("fleet/r1/@alive/gateway"),
    ):
        time.sleep(GRACE_S)
        replies = scene.far.get("fleet/r1/@rpc/claim/gateway", timeout=1.0, target=zenoh.QueryTarget.ALL)
        held_s = [msgpack.unpackb(reply.ok.payload.to_bytes())["held_s"] for reply in replies if reply.ok]
        assert len(held_s) == 1, held_s
        assert held_s[0] < 3600.0
    assert "another gateway" not in (scene.last("status").get("reason") or "")


ALIVE = "fleet/r1/@alive"
ATTACKS: list[tuple[str, str, Attack]] = [
    ("v1", "drives", drives),
    ("v1", "asks for the lease", asks("acquire/v1", "takeover/v1", who="v1")),
    ("v1", "asks in the name of op1", asks("acquire/op1", "takeover/op1", who="op1", priority=9)),
    ("v1", "dies for op1", dies_for_the_holder),
    ("op2", "drives by a forged proof", drives),
    ("op2", "asks in the name of op1", asks("acquire/op1", "takeover/op1", who="op1", priority=9)),
    ("op2", "asks in its own name for op1", asks("acquire/op2", who="op1", priority=9)),
    ("op2", "asks as a listener", asks("acquire/hq.op2", "acquire/hq.h1", who="hq.h1.7", priority=9)),
    ("op2", "asks with the token of op1", asks("acquire/op2", who="op2", priority=9, alive="operator.op1.a1.1")),
    ("op2", "takes over", asks("takeover/op2", who="op2")),
    ("op2", "dies for op1", dies_for_the_holder),
    ("h1", "asks in the name of op1", asks("acquire/hq.h1", "acquire/op1", "acquire/h1", who="op1", priority=9)),
    ("h1", "takes over", asks("takeover/h1", "takeover/hq.h1", who="hq.h1.1")),
    ("h2", "drives a robot that is not its own", drives),
    ("h2", "asks for a robot that is not its own", asks("acquire/hq.h2", "acquire/h2", who="hq.h2.1", priority=9)),
    ("h2", "stops a robot that is not its own", stops),
    ("g3", "writes another robot's status", writes_status),
    ("g3", "answers another robot's acquire", answers_acquire),
    ("g3", "claims another robot", claims),
    ("g3", "stops", stops),
    ("rec1", "stops", stops),
    ("rec1", "drives", drives),
    ("rec1", "asks for the lease", asks("acquire/rec1", "takeover/rec1", who="rec1")),
    ("rec1", "writes a status", writes_status),
]
ARRIVE = {
    ("op2", "acquire", "malformed"),  # in its own name for op1, and with the token of op1
    ("h1", "acquire", "malformed"),
    ("hq.h1", "acquire", "malformed"),
}
"""What the router lets through, and the gateway refuses, under the name that the key says."""


def test_no_attack_on_a_robot_that_is_held_succeeds(bench: Bench, tmp_path: Path) -> None:
    scene, succeeded = Scene(bench, tmp_path), []
    with scene.fleet("op1") as fleet, fleet["r1"].control("op1.laptop") as drive:
        until(lambda: scene.last("control").get("holder") == "op1.laptop")
        held = scene.last("control")["lease"]
        for name, what, attack in ATTACKS:
            with scene.bus.session(name) as session:
                try:
                    attack(scene, session)
                    time.sleep(0.2)
                    drive(forward=0.0)
                    control = scene.last("control")
                    assert (control["holder"], control["lease"], scene.forged) == ("op1.laptop", held, 0)
                    assert scene.last("status")["state"] == "established"
                except (AssertionError, LeaseLost) as error:
                    succeeded.append(f"{name} {what}: {error}")
        assert succeeded == []
        with scene.fleet("op2") as another, pytest.raises(Malformed, match="certificate of this program says 'op2'"):
            another["r1"].control("op1.laptop").__enter__()
    until(lambda: scene.last("control").get("holder") is None)
    assert scene.refusals.keys() >= ARRIVE
    assert not any(who in ("v1", "rec1", "h2", "g3") for who, _, _ in scene.refusals), scene.refusals
    assert any(who is None and code != "rate" for who, _, code in scene.refusals), "the forged proofs of op2 arrive"
    scene.gateway.end()
    assert '"op1.laptop"' in scene.audit.read_text()
    assert '"v1"' not in scene.audit.read_text()


def test_a_router_that_restarts_without_a_name_ends_what_it_was_allowed_and_every_lease(
    bench: Bench, tmp_path: Path
) -> None:
    scene = Scene(bench, tmp_path)

    def op1_refused() -> dict[tuple[str | None, str, str], int]:
        return {key: count for key, count in scene.refusals.items() if key[0] == "op1"}

    with scene.fleet("op1") as fleet, fleet["r1"].control() as drive:
        drive(forward=0.2)
        until(lambda: scene.last("control").get("holder") == "op1")
        scene.bus.stop()
        scene.bus.start(ROLES.without("op1"))
        until(lambda: scene.last("control").get("state") == "stopped", 20.0, what="the end of the lease")
        until(lambda: re.search(r'"ended", "who": "op1", "reason": "(bus|holder) lost"', scene.audit.read_text()))
        before = op1_refused()
        with scene.bus.session("op1") as session:
            for key in ("fleet/r1/@cmd/drive", "fleet/r1/@cmd/stop"):
                session.put(key, DRIVE)
            assert scene.ask(session, "acquire/op1", who="op1") == []
    with pytest.raises(BusError, match=r"does not know operator\.op1"), scene.fleet("op1"):
        pass
    with scene.fleet("op2") as fleet, fleet["r1"].control() as drive:
        drive(forward=0.1)
    assert op1_refused() == before
    scene.gateway.end()
