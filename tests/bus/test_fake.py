"""The fake bus matches keys by Zenoh's rules; what else it does is in ``test_interface.py``."""

import zenoh
from hypothesis import example, given
from hypothesis import strategies as st

from tests.fake_bus import FakeBus, matches, meet
from zbridge.bus import Sample
from zbridge.fleet import topics

CHUNK = st.sampled_from(["a", "b", "@a", "@b"])
EXPRESSION = st.lists(CHUNK | st.sampled_from(["*", "**"]), min_size=1, max_size=5).map("/".join)


@given(EXPRESSION, st.lists(CHUNK, min_size=1, max_size=5).map("/".join))
@example("fleet/**", "fleet/r1/@cmd/drive")  # chunks that begin with @ are matched by nothing but themselves
@example("fleet/**/@cmd/*", "fleet/r1/@cmd/drive")
@example("**/@alive/**", "fleet/r1/@alive/gateway")
def test_a_key_expression_matches_as_zenoh_itself_says(key_expr: str, key: str) -> None:
    canonical = zenoh.KeyExpr.autocanonize(key_expr)
    assert matches(str(canonical), key) is canonical.includes(zenoh.KeyExpr(key))


@given(EXPRESSION, EXPRESSION)
def test_two_key_expressions_meet_as_zenoh_itself_says(one: str, other: str) -> None:
    first, second = zenoh.KeyExpr.autocanonize(one), zenoh.KeyExpr.autocanonize(other)
    assert meet(str(first), str(second)) is first.intersects(second)


async def test_sessions_share_one_bus_and_one_that_leaves_takes_back_what_it_declared() -> None:
    bus = FakeBus()
    other, seen = bus.join("2"), list[Sample]()
    other.publisher("fleet/r1/status", topics.STATUS).put(b"up")
    bus.subscribe("fleet/**", seen.append, history=True)
    assert seen == [Sample("fleet/r1/status", b"up")]
    other.subscribe("**", seen.append)
    other.answer("fleet/r1/@rpc/map", lambda question: question.answer(b""))
    for session, name in ((other, "hq"), (bus, "gateway")):
        session.announce(f"fleet/r1/@alive/{name}")
    await other.close()
    await other.close()
    bus.publisher("fleet/r1/pose", topics.POSE).put(b"p")
    assert len(seen) == 2
    assert await bus.ask("fleet/r1/**") == await bus.ask("fleet/r1/@rpc/map") == []
    assert await bus.alive("**/@alive/*") == ["fleet/r1/@alive/gateway"]
