"""The fake bus: key matching by Zenoh's rules, samples, last values, queries, tokens."""

import asyncio

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from zbridge.bus import Answer, IncomingQuery, Lane, Sample, Sort
from zbridge.bus.fake import FakeBus, FakeQuery, matches, meet
from zbridge.errors import NotReady
from zbridge.fleet import topics

pytestmark = pytest.mark.jumping

YES: dict[str, tuple[str, ...]] = {
    "a/b/c": ("a/b/c",),
    "a/*/c": ("a/b/c",),
    "*": ("a",),
    "**": ("a", "a/b/c"),
    "a/**": ("a", "a/b/c"),
    "a/**/c": ("a/c", "a/b/b/c"),
    "**/c": ("a/b/c", "c"),
    "a/**/b/**/c": ("a/x/b/y/b/c",),
    # chunks that begin with @ are matched by nothing but themselves
    "fleet/*/@cmd/drive": ("fleet/r1/@cmd/drive",),
    "fleet/*/@cmd/**": ("fleet/r1/@cmd/drive", "fleet/r1/@cmd"),
    "fleet/**/@cmd/*": ("fleet/r1/@cmd/drive",),
    "fleet/*/@alive/*": ("fleet/r1/@alive/gateway",),
    "**/@alive/**": ("fleet/r1/@alive/gateway",),
}
NO: dict[str, tuple[str, ...]] = {
    "a/b/c": ("a/b",),
    "a/b": ("a/b/c",),
    "a/*/c": ("a/c", "a/b/b/c"),
    "*": ("a/b",),
    "a/**": ("b",),
    "a/**/c": ("a/b/c/d",),
    "fleet/r1/*": ("fleet/r1/@cmd",),
    "fleet/r1/**": ("fleet/r1/@cmd/drive",),
    "fleet/**": ("fleet/r1/@cmd/drive",),
    "**/drive": ("fleet/r1/@cmd/drive",),
    "**": ("@alive",),
    "fleet/r1/@cmd/**": ("fleet/r1/@cmd/@x", "fleet/r1/@rpc/map"),
}
MATCHES = [(one, key, table is YES) for table in (YES, NO) for one, keys in table.items() for key in keys]


@pytest.mark.parametrize(("key_expr", "key", "matching"), MATCHES)
def test_a_key_expression_matches_as_the_rules_of_zenoh_say(key_expr: str, key: str, matching: bool) -> None:
    assert matches(key_expr, key) is matching
    assert zenoh.KeyExpr(key_expr).includes(zenoh.KeyExpr(key)) is matching


@pytest.fixture
def bus() -> FakeBus:
    return FakeBus()


CHUNK = st.sampled_from(["a", "b", "@a", "@b"])


@given(
    st.lists(CHUNK | st.sampled_from(["*", "**"]), min_size=1, max_size=5).map("/".join),
    st.lists(CHUNK, min_size=1, max_size=5).map("/".join),
)
def test_a_key_expression_matches_as_zenoh_itself_says(key_expr: str, key: str) -> None:
    canonical = zenoh.KeyExpr.autocanonize(key_expr)
    assert matches(str(canonical), key) is canonical.includes(zenoh.KeyExpr(key))


@given(*2 * [st.lists(CHUNK | st.sampled_from(["*", "**"]), min_size=1, max_size=5).map("/".join)])
def test_two_key_expressions_meet_as_zenoh_itself_says(one: str, other: str) -> None:
    first, second = zenoh.KeyExpr.autocanonize(one), zenoh.KeyExpr.autocanonize(other)
    assert meet(str(first), str(second)) is first.intersects(second)


def test_what_is_put_on_an_expression_reaches_whoever_it_meets_with_the_expression_as_its_key(bus: FakeBus) -> None:
    seen = list[Sample]()
    bus.subscribe("fleet/r1/@cmd/**", seen.append)
    for key in ("fleet/*/@cmd/stop", "fleet/r1/@cmd/*", "fleet/r2/@cmd/*", "fleet/**"):
        bus.publisher(key, topics.CMD_STOP).put(b"s")
    assert [sample.key for sample in seen] == ["fleet/*/@cmd/stop", "fleet/r1/@cmd/*"]


async def test_a_question_knows_what_was_asked_and_which_key_it_answers(bus: FakeBus) -> None:
    asked = list[tuple[str, str]]()
    for key in ("fleet/r1/@rpc/control/acquire/*", "fleet/r1/@rpc/control/renew"):
        bus.answer(key, lambda question: asked.append((question.asked, question.key)))
    for key in ("fleet/r1/@rpc/control/acquire/op1", "fleet/*/@rpc/control/renew", "fleet/r1/@rpc/control/acquire/*"):
        await bus.ask(key)
    assert asked == [
        ("fleet/r1/@rpc/control/acquire/op1", "fleet/r1/@rpc/control/acquire/op1"),
        ("fleet/*/@rpc/control/renew", "fleet/r1/@rpc/control/renew"),
        ("fleet/r1/@rpc/control/acquire/*", "fleet/r1/@rpc/control/acquire/*"),
    ]


def test_a_sample_reaches_every_subscriber_that_matches_on_every_session(bus: FakeBus) -> None:
    other = bus.join("2")
    seen: list[tuple[str, Sample]] = []
    bus.subscribe("fleet/*/pose", lambda sample: seen.append(("star", sample)))
    other.subscribe("fleet/r1/pose", lambda sample: seen.append(("exact", sample)))
    other.subscribe("fleet/r2/pose", lambda sample: seen.append(("other", sample)))
    bus.publisher("fleet/r1/pose", topics.POSE).put(b"p", b"attached")
    sample = Sample("fleet/r1/pose", b"p", b"attached")
    assert seen == [("star", sample), ("exact", sample)]
    assert other.values("fleet/**") == [b"p"]


def test_a_closed_subscription_gets_nothing_and_closing_twice_does_no_harm(bus: FakeBus) -> None:
    seen: list[Sample] = []
    handle = bus.subscribe("**", seen.append)
    handle.close()
    handle.close()
    bus.publisher("fleet/r1/pose", topics.POSE).put(b"p")
    assert seen == []


def test_a_latecomer_gets_last_values_of_states_only(bus: FakeBus) -> None:
    bus.publisher("fleet/r1/pose", topics.POSE).put(b"pose")
    status = bus.publisher("fleet/r1/status", topics.STATUS)
    status.put(b"one")
    status.put(b"two")
    seen: list[Sample] = []
    bus.join("2").subscribe("fleet/**", seen.append, history=True)
    assert seen == [Sample("fleet/r1/status", b"two")]
    without: list[Sample] = []
    bus.subscribe("fleet/**", without.append)
    assert without == []


async def test_a_query_gets_last_values_until_their_publisher_goes(bus: FakeBus) -> None:
    publisher = bus.publisher("fleet/r1/status", topics.STATUS)
    publisher.put(b"one")
    assert await bus.ask("fleet/*/status") == [Answer("fleet/r1/status", b"one")]
    publisher.close()
    assert await bus.ask("fleet/*/status") == []


async def test_a_query_is_answered_or_refused_by_whoever_answers_its_key(bus: FakeBus) -> None:

    def answer(question: IncomingQuery) -> None:
        question.answer(question.payload + b"!")

    bus.answer("fleet/r1/@rpc/map", answer)
    offline = NotReady("offline")
    handle = bus.join("2").answer("fleet/r2/@rpc/map", lambda question: question.refuse(offline))
    assert await bus.ask("fleet/*/@rpc/map", b"hi") == [
        Answer("fleet/r1/@rpc/map", b"hi!", replier="1"),
        Answer("fleet/r2/@rpc/map", b"", offline, replier="2"),
    ]
    handle.close()
    assert await bus.ask("fleet/r2/@rpc/map") == []


async def test_tokens_are_seen_while_they_last(bus: FakeBus) -> None:
    handle = bus.announce("fleet/r1/@alive/gateway")
    bus.join("2").announce("fleet/r2/@alive/gateway")
    assert await bus.alive("fleet/*/@alive/*") == ["fleet/r1/@alive/gateway", "fleet/r2/@alive/gateway"]
    handle.close()
    assert await bus.alive("fleet/*/@alive/*") == ["fleet/r2/@alive/gateway"]


def test_who_watches_tokens_is_told_those_there_are_those_that_come_and_those_that_go(bus: FakeBus) -> None:
    other = bus.join("2")
    first = other.announce("fleet/r1/@alive/first")
    other.announce("fleet/r2/@alive/elsewhere")
    seen: list[tuple[str, bool]] = []
    handle = bus.watch_alive("fleet/r1/@alive/*", lambda key, alive: seen.append((key, alive)))
    assert seen == [("fleet/r1/@alive/first", True)]
    second = bus.announce("fleet/r1/@alive/second")
    bus.announce("fleet/r1/@alive/a/b")
    first.close()
    first.close()
    assert seen[1:] == [("fleet/r1/@alive/second", True), ("fleet/r1/@alive/first", False)]
    handle.close()
    handle.close()
    second.close()
    assert len(seen) == 3


async def test_who_watches_tokens_is_told_when_a_session_leaves_and_not_after_leaving_itself(bus: FakeBus) -> None:
    other, third = bus.join("2"), bus.join("3")
    seen: list[tuple[str, bool]] = []
    left: list[tuple[str, bool]] = []
    bus.watch_alive("fleet/*/@alive/*", lambda key, alive: seen.append((key, alive)))
    third.watch_alive("fleet/*/@alive/*", lambda key, alive: left.append((key, alive)))
    other.announce("fleet/r1/@alive/hq")
    await third.close()
    await other.close()
    assert seen == [("fleet/r1/@alive/hq", True), ("fleet/r1/@alive/hq", False)]
    assert left == [("fleet/r1/@alive/hq", True)]


async def test_what_was_put_is_with_the_bus_at_once(bus: FakeBus) -> None:
    bus.publisher("fleet/r1/@cmd/drive", topics.CMD_DRIVE).put(b"1")
    await bus.flush()
    assert bus.values("fleet/r1/@cmd/drive") == [b"1"]


@pytest.mark.parametrize("lane", [Lane.STOP, Lane.OTHER, lambda key, shown, size, look: Lane.COMMAND])
def test_a_sample_comes_by_whatever_lane(bus: FakeBus, lane: Lane | Sort) -> None:
    seen: list[Sample] = []
    bus.subscribe("fleet/r1/@cmd/**", seen.append, lane=lane)
    bus.publisher("fleet/r1/@cmd/drive", topics.CMD_DRIVE).put(b"1", b"token")
    assert seen == [Sample("fleet/r1/@cmd/drive", b"1", b"token")]


async def test_a_session_that_leaves_takes_back_what_it_declared_and_nothing_else(bus: FakeBus) -> None:
    other = bus.join("2")
    seen: list[Sample] = []
    other.subscribe("**", seen.append)
    other.announce("fleet/r1/@alive/hq")
    other.answer("fleet/r1/@rpc/map", lambda question: question.answer(b""))
    bus.announce("fleet/r1/@alive/gateway")
    await other.close()
    await other.close()
    bus.publisher("fleet/r1/pose", topics.POSE).put(b"p")
    assert seen == []
    assert await bus.ask("fleet/r1/@rpc/map") == []
    assert await bus.alive("**/@alive/*") == ["fleet/r1/@alive/gateway"]


def test_the_loss_and_return_of_the_bus_can_be_played(bus: FakeBus) -> None:
    seen: list[bool] = []
    handle = bus.watch_connected(seen.append)
    bus.connection(False)
    bus.connection(True)
    handle.close()
    bus.connection(False)
    assert seen == [True, False, True]


def test_a_full_bus_asks_for_a_pause_and_relieves_it(bus: FakeBus) -> None:
    publisher = bus.publisher("fleet/r1/pose", topics.POSE)
    relieved: list[bool] = []
    bus.on_relief(lambda: relieved.append(True))
    assert bus.put_all([(publisher, [b"1", b"2"])])
    bus.takes = False
    assert not bus.put_all([(publisher, [b"3"])])
    assert bus.values("fleet/r1/pose") == [b"1", b"2", b"3"]
    bus.relieve()
    assert relieved == [True]
    assert bus.put_all([])


async def test_frames_are_wanted_only_while_somebody_listens(bus: FakeBus) -> None:
    told: list[bool] = []
    bus.frames("fleet/r1/@wire/robot/in", told.append)
    await asyncio.sleep(0)
    assert told == []
    bus.subscribe("fleet/r1/@wire/**", lambda sample: None)
    bus.frames("fleet/r1/@wire/robot/in", told.append)
    await asyncio.sleep(0)
    assert told == [True]


def test_a_question_keeps_its_replies() -> None:
    question = FakeQuery("k", b"?")
    question.answer(b"a")
    no = NotReady("no")
    question.refuse(no)
    assert question.replies == [Answer("k", b"a"), Answer("k", b"", no)]
    assert (question.payload, question.attachment) == (b"?", None)


def test_sessions_tell_their_ids() -> None:
    bus = FakeBus("7")
    assert (bus.zid, bus.join("8").zid, repr(bus)) == ("7", "8", "<FakeBus 7>")
