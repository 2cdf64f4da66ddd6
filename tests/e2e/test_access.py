"""Who may do what, tried over a real router with real certificates: the allowed arrives, the forbidden does not."""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

from tests.access import COLUMNS, LAB, Try, granted_by_the_code, table
from tests.certificates import Authority
from tests.e2e.conftest import until
from tests.e2e.rigs.secure import FAR, GRACE_S, ROLES, Matrix, SecureBus, declared, ignore, secure, text
from zbridge.security.access import STOPS_HZ, Column
from zbridge.security.roles import Roles

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "roles.md"


class Scene:
    """A router, and a session of every member."""

    def __init__(self, bus: SecureBus, members: dict[Column, zenoh.Session], far: zenoh.Session) -> None:
        self.bus, self.members, self.far = bus, members, far


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    bus = SecureBus(tmp_path_factory.mktemp("bus"))
    with contextlib.ExitStack() as stack:
        stack.callback(bus.stop)
        far = stack.enter_context(bus.session(FAR))
        members = {column: stack.enter_context(bus.session(name)) for column, name in COLUMNS.items()}
        yield Scene(bus, members, far)


class Heard:
    """What came to the far end."""

    def __init__(self, far: zenoh.Session, *key_exprs: str) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        """Of each sender and key."""
        self._lock = threading.Lock()
        self._entities = [
            entity
            for each in key_exprs
            for entity in (far.declare_subscriber(each, self._sample), far.declare_queryable(each, self._query))
        ]
        time.sleep(GRACE_S)

    def __enter__(self) -> Heard:
        return self

    def __exit__(self, *_: object) -> None:
        with declared(*self._entities):
            pass

    def _sample(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self.counts[text(sample.attachment), str(sample.key_expr)] += 1

    def _query(self, query: zenoh.Query) -> None:
        with self._lock:
            self.counts[text(query.payload), str(query.key_expr)] += 1
        query.drop()


WIDE = ("fleet/**", "fleet/**/@cmd/**", "fleet/**/@rpc/**", "fleet/@mark")


@pytest.mark.long
def test_every_role_may_do_what_the_table_says_and_nothing_else(scene: Scene) -> None:
    seen, expected = Matrix(scene.members, scene.far).run(), granted_by_the_code()
    print(table(seen), end="")
    assert sorted(map(said, expected - seen)) == []
    assert sorted(map(said, seen - expected)) == []
    assert table(seen) in PAGE.read_text()


def said(each: Try) -> str:
    return f"{each.column}: {each.kind} {each.key}"


PUTS: list[tuple[Column, str, bool]] = [
    ("viewer", "fleet/*/@cmd/stop", True),
    ("viewer", "fleet/**", False),
    ("viewer", "fleet/r1/**", False),
    ("viewer", "fleet/r1/@cmd/*", False),
    ("viewer", "fleet/r1/@cmd/**", False),
    ("viewer", "fleet/*/@cmd/*", False),
    ("viewer", "fleet/r1/@cmd/s$*", False),
    ("operator", "fleet/**", False),
    ("operator", "fleet/r1/*", False),
    ("operator", "fleet/r1/@cmd/**", True),
    ("supervisor", "fleet/**", False),
    ("supervisor", "fleet/r$*/@cmd/stop", True),
    ("gateway", "fleet/r1/**", True),
    ("gateway", "fleet/**", False),
    ("gateway", "fleet/*/status", False),
    ("gateway", "fleet/r$*/status", False),
    ("gateway", "fleet/r1/@cmd/stop", False),
    ("gateway", "fleet/*/@cmd/stop", False),
    ("gateway with listeners", "fleet/*/@cmd/stop", False),
    ("hq", "fleet/*/@cmd/stop", False),
    ("recorder", "fleet/*/@cmd/stop", False),
    ("recorder", "fleet/**", False),
]
QUERIES: list[tuple[Column, str, bool]] = [
    ("viewer", "fleet/**", True),
    ("viewer", "fleet/*/status", True),
    ("viewer", "fleet/*/@rpc/sessions/*", True),
    ("viewer", "fleet/*/@rpc/**", False),
    ("viewer", "fleet/r1/@rpc/control/acquire/*", False),
    ("operator", "fleet/r1/@rpc/control/acquire/*", False),
    ("operator", "fleet/r1/@rpc/control/acquire/o$*", False),
    ("operator", "fleet/r1/@rpc/control/*/op1", False),
    ("operator", "fleet/*/@rpc/control/acquire/op1", True),
    ("supervisor", "fleet/*/@rpc/control/takeover/*", False),
    ("hq", "fleet/r1/@rpc/control/acquire/hq.$*", False),
    ("hq", "fleet/r1/@rpc/control/acquire/hq.h1$*", False),
    ("hq", "fleet/**", False),
    ("gateway", "fleet/r1/@rpc/control/acquire/g1", False),
    ("recorder", "fleet/**", True),
]


def test_a_wildcard_reaches_no_further_than_the_keys_that_are_allowed(scene: Scene) -> None:
    with Heard(scene.far, *WIDE) as heard:
        for column, key_expr, _ in PUTS:
            scene.members[column].put(key_expr, b"", attachment=f"{column} puts")
        for column, key_expr, _ in QUERIES:
            scene.members[column].get(key_expr, ignore, payload=f"{column} asks", timeout=1.0)
        expected = {
            *((f"{column} puts", key_expr) for column, key_expr, allowed in PUTS if allowed),
            *((f"{column} asks", key_expr) for column, key_expr, allowed in QUERIES if allowed),
        }
        with contextlib.suppress(AssertionError):
            until(lambda: expected <= heard.counts.keys(), 5.0)
        time.sleep(GRACE_S)
        assert heard.counts.keys() == expected


Wish = tuple[Column, str, tuple[str, ...]]
_COMMANDS = ("fleet/r1/@cmd/drive", "fleet/*/@cmd/stop")
ALLOWED: list[Wish] = [
    ("viewer", "fleet/**", ("fleet/r1/scan",)),
    ("viewer", "fleet/*/scan", ("fleet/r1/scan",)),
    ("gateway", "fleet/r1/@cmd/**", _COMMANDS),
    ("recorder", "fleet/**", ("fleet/r1/scan",)),
    ("recorder", "fleet/**/@cmd/**", _COMMANDS),
    ("recorder", "fleet/*/@cmd/*", _COMMANDS),
]
FORBIDDEN: list[Wish] = [
    ("viewer", "**", ()),
    ("viewer", "fleet/**/@cmd/**", ()),
    ("viewer", "fleet/*/@wire/**", ()),
    ("viewer", "fleet/*/@cmd/*", ()),
    ("gateway", "fleet/**", ()),
    ("gateway", "fleet/*/@cmd/**", ()),
    ("hq", "fleet/**", ()),
    ("hq", "fleet/*/scan", ()),
]


def test_subscriptions_with_wildcards_hear_what_is_allowed_and_publishers_hear_of_them(scene: Scene) -> None:
    scan = scene.members["gateway with listeners"].declare_publisher("fleet/r1/scan")
    drive = scene.members["operator"].declare_publisher("fleet/r1/@cmd/drive")
    with declared(scan, drive), hearing(scene, ALLOWED) as got:
        until(lambda: scan.matching_status.matching and drive.matching_status.matching)
        scan.put(b"")
        drive.put(b"")
        scene.members["supervisor"].put("fleet/*/@cmd/stop", b"")
        until(lambda: all(got[wish] == set(wish[2]) for wish in ALLOWED), what=f"{got}")
    with hearing(scene, FORBIDDEN) as got:  # apart: a session hears on each subscription what came for any of its own
        for key in ("fleet/r1/scan", "fleet/r1/@cmd/drive", "fleet/*/@cmd/stop", "fleet/r1/@wire/robot/in"):
            scene.far.put(key, b"")
        time.sleep(2 * GRACE_S)
        assert {wish: keys for wish, keys in got.items() if keys} == {}


@contextlib.contextmanager
def hearing(scene: Scene, wishes: list[Wish]) -> Iterator[dict[Wish, set[str]]]:
    got: dict[Wish, set[str]] = {wish: set() for wish in wishes}

    def subscribed(wish: Wish) -> Any:
        column, key_expr, _ = wish
        return scene.members[column].declare_subscriber(key_expr, lambda sample: got[wish].add(str(sample.key_expr)))

    with declared(*map(subscribed, wishes)):
        time.sleep(GRACE_S)
        yield got


def test_last_values_reach_everybody_and_a_gateway_answers_for_its_own_robot_alone(scene: Scene) -> None:
    def answer(query: zenoh.Query) -> None:
        for key in ("fleet/r1/status", "fleet/r2/status"):
            if query.key_expr.intersects(zenoh.KeyExpr(key)):
                query.reply(key, b"of g1")
        query.drop()

    def asked(key_expr: str) -> set[str]:
        replies = scene.members["viewer"].get(key_expr, timeout=1.0, target=zenoh.QueryTarget.ALL)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    with declared(scene.members["gateway"].declare_queryable("fleet/r1/*", answer)):
        until(lambda: asked("fleet/r1/status") == {"fleet/r1/status"})
        for key_expr in ("fleet/*/status", "fleet/**", "fleet/r1/*", "fleet/r1/**"):
            assert asked(key_expr) == {"fleet/r1/status"}, key_expr
    with declared(*(scene.members["gateway"].declare_queryable(each, answer) for each in ("fleet/*/*", "fleet/r2/*"))):
        time.sleep(GRACE_S)
        assert asked("fleet/*/status") == asked("fleet/r2/status") == set()


TOKENS: list[tuple[Column, str]] = [
    ("viewer", "fleet/r1/@alive/operator.v1.a1.1"),
    ("operator", "fleet/r1/@alive/operator.sup1.a1.1"),
    ("operator", "fleet/r1/@alive/operator.$*"),
    ("operator", "fleet/r1/@alive/operator.op1"),
    ("operator", "fleet/r1/@alive/operator.op10.a1.1"),
    ("operator", "fleet/r1/@alive/hq.op1.7"),
    ("operator", "fleet/r1/@alive/*"),
    ("operator", "fleet/r1/@alive/gateway"),
    ("gateway", "fleet/r2/@alive/gateway"),
    ("gateway", "fleet/*/@alive/gateway"),
    ("gateway", "fleet/r1/@alive/operator.op1.a1.1"),
    ("hq", "fleet/r1/@alive/hq.h2.7"),
    ("recorder", "fleet/r1/@alive/operator.rec1.a1.1"),
]


def test_nobody_declares_the_token_of_another(scene: Scene) -> None:
    came: set[str] = set()
    watch = scene.far.liveliness().declare_subscriber(
        "fleet/**/@alive/**", lambda sample: came.add(str(sample.key_expr))
    )
    with declared(
        watch,
        *(scene.members[column].liveliness().declare_token(key) for column, key in TOKENS),
        scene.members["operator"].liveliness().declare_token("fleet/r1/@alive/operator.op1.a1.2"),
    ):
        until(lambda: came)
        time.sleep(GRACE_S)
        assert came == {"fleet/r1/@alive/operator.op1.a1.2"}


def test_a_flood_of_stops_is_thinned_for_its_robot_and_no_other_stop_is_lost(scene: Scene) -> None:
    viewer = scene.members["viewer"]
    with Heard(scene.far, "fleet/*/@cmd/**") as heard:
        started = time.monotonic()
        for _ in range(FLOOD):
            viewer.put("fleet/r1/@cmd/stop", b"", attachment="viewer", congestion_control=BLOCK)
        viewer.put("fleet/r2/@cmd/stop", b"", attachment="viewer", congestion_control=BLOCK)
        until(lambda: ("viewer", "fleet/r2/@cmd/stop") in heard.counts, what="the stop of the other robot")
        time.sleep(APART_S)
        viewer.put("fleet/*/@cmd/stop", b"", attachment="viewer", congestion_control=BLOCK)
        scene.members["operator"].put("fleet/r1/@cmd/stop", b"", attachment="operator", congestion_control=BLOCK)
        most = 2 + STOPS_HZ * (time.monotonic() - started)
        until(lambda: len(heard.counts) == 4)
        time.sleep(GRACE_S)
        assert 1 <= heard.counts["viewer", "fleet/r1/@cmd/stop"] <= most < FLOOD
        assert heard.counts["viewer", "fleet/r2/@cmd/stop"] == 1
        assert heard.counts["viewer", "fleet/*/@cmd/stop"] == 1
        assert heard.counts["operator", "fleet/r1/@cmd/stop"] == 1


FLOOD = 20_000
APART_S = 0.005
"""Before a stop with wildcards that must arrive: it counts for a robot that the flood was for."""
BLOCK = zenoh.CongestionControl.BLOCK
SIZES: list[tuple[Column, str, int, bool]] = [
    ("viewer", "fleet/r1/@cmd/stop", 256, True),
    ("supervisor", "fleet/r1/@cmd/stop", 300, False),
    ("operator", "fleet/r1/@cmd/drive", 250, True),
    ("supervisor", "fleet/r1/@cmd/drive", 300, False),
    ("operator", "fleet/r1/@cmd/scan", 60_000, True),
    ("supervisor", "fleet/r1/@cmd/scan", 70_000, False),
    ("gateway", "fleet/r1/image", 3_000_000, True),
    ("gateway with listeners", "fleet/r1/image", 17_000_000, False),
]


def test_what_is_larger_than_its_class_allows_is_lost(scene: Scene) -> None:
    with Heard(scene.far, "fleet/**", "fleet/*/@cmd/**") as heard:
        for column, key, size, _ in SIZES:
            scene.members[column].put(key, bytes(size - len(column)), attachment=column, congestion_control=BLOCK)
        expected = {(column, key) for column, key, _, passes in SIZES if passes}
        with contextlib.suppress(AssertionError):
            until(lambda: expected <= heard.counts.keys(), 3.0)
        time.sleep(GRACE_S)
        assert heard.counts.keys() == expected


def test_the_admin_space_of_the_router_is_the_supervisors_alone(scene: Scene) -> None:
    def shown(column: Column) -> int:
        replies = scene.members[column].get("@/*/router", timeout=1.0, target=zenoh.QueryTarget.ALL)
        return sum(reply.ok is not None for reply in replies)

    assert {column: shown(column) for column in COLUMNS if column != "router"} == {
        **{column: 0 for column in COLUMNS if column != "router"},
        "supervisor": 1,
    }


def test_a_member_hears_who_it_is_and_an_unknown_name_hears_silence(scene: Scene) -> None:
    def whoami(session: zenoh.Session, name: str) -> list[Any]:
        replies = session.get(f"fleet/@bus/whoami/{name}", timeout=1.0)
        told = [msgspec.msgpack.decode(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]
        assert all(abs(each.pop("stamp_ns") - time.time_ns()) < 10**10 for each in told)
        return told

    assert whoami(scene.members["hq"], "h1") == [{"name": "h1", "role": "hq", "robots": ["r1"]}]
    assert whoami(scene.members["viewer"], "v1") == [{"name": "v1", "role": "viewer", "robots": []}]
    assert whoami(scene.members["viewer"], "op1") == whoami(scene.members["operator"], "*") == []
    scene.bus.folders["stranger"] = scene.bus.authority.issue("viewer.stranger")
    with scene.bus.session("stranger") as stranger:
        got: list[str] = []
        with declared(stranger.declare_subscriber("fleet/**", lambda sample: got.append(str(sample.key_expr)))):
            time.sleep(GRACE_S)
            scene.far.put("fleet/r1/status", b"")
            assert whoami(stranger, "stranger") == got == []
    said = r"WARNING .* viewer\.stranger connected from tls/127\.0\.0\.1:\d+: .* roles\.toml"
    until(lambda: re.search(said, scene.bus.log()), what="a warning in the log")
    assert re.search(
        r"WARNING .* viewer\.stranger connected from tls/127\.0\.0\.1:\d+: .* roles\.toml", scene.bus.log()
    )


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_a_viewer_that_is_no_client_gets_no_further(scene: Scene, mode: str) -> None:
    more = {"listen__endpoints": [], "scouting__gossip__enabled": True}
    with scene.bus.session("v1", mode, **more) as viewer, Heard(scene.far, *WIDE) as heard:
        for key in ("fleet/r1/@cmd/drive", "fleet/r1/status", "fleet/r1/@cmd/stop"):
            viewer.put(key, b"", attachment=mode)
        until(lambda: heard.counts)
        time.sleep(GRACE_S)
        assert heard.counts.keys() == {(mode, "fleet/r1/@cmd/stop")}
        assert {str(link.dst) for link in viewer.info.links()} == {scene.bus.endpoint}


def test_a_router_that_starts_again_knows_only_who_is_left(tmp_path: Path) -> None:
    bus = SecureBus(tmp_path)
    try:
        with bus.session(FAR) as far, bus.session("op1") as operator, bus.session("v1") as viewer:
            for roles, drivers in ((ROLES, {"op1", "v1"}), (without("op1"), {"v1"})):
                if roles is not ROLES:
                    bus.stop()
                    bus.start(roles)
                with Heard(far, *WIDE) as heard:

                    def stopped(heard: Heard = heard) -> set[str]:
                        for name, session in (("op1", operator), ("v1", viewer)):
                            session.put("fleet/r1/@cmd/stop", b"", attachment=name)
                        time.sleep(0.1)
                        return {name for name, _ in heard.counts}

                    until(lambda drivers=drivers: stopped() >= drivers)
                    time.sleep(1.5)
                    assert stopped() == drivers
    finally:
        bus.stop()


REFUSED = [
    ("nobody", "refused a connection: it showed no certificate"),
    ("other", "refused a connection: its certificate is of another authority"),
    ("plain", "refused a connection: it spoke no TLS"),
]


def test_whom_the_router_refuses_is_said_in_its_log(scene: Scene, tmp_path: Path) -> None:
    other = Authority(tmp_path, "other").issue("viewer.v1")
    (other / "ca.pem").write_bytes(scene.bus.authority.ca.read_bytes())
    address = scene.bus.endpoint.partition("/")[2]
    brief = {"connect__endpoints": [scene.bus.endpoint], "connect__timeout_ms": 300}
    nobody = {"transport__link__tls__enable_mtls": False} | brief
    plain = brief | {"connect__endpoints": [f"tcp/{address}"]}
    for config in (secure(other, **nobody), secure(other, **brief), secure(other, **plain)):
        with pytest.raises(zenoh.ZError):
            zenoh.open(config)
    for _, words in REFUSED:
        until(lambda words=words: words in scene.bus.log(), what=words)
    assert "Hint" not in scene.bus.log()


def without(name: str) -> Roles:
    return Roles({other: member for other, member in ROLES.names.items() if other != name}, (name,))


assert set(LAB.names) < set(ROLES.names)
