"""What views of live robots share: which robots live, payloads that are counted, subscriptions that are needed."""

from __future__ import annotations

import pytest

from tests.fake_bus import FakeBus
from zbridge.fleet.messages import Switch
from zbridge.fleet.payload import encode, measured_ns
from zbridge.metrics import Metrics
from zbridge.views.live_robots import OnDemandSubscriptions, read_payload, watch_robots


@pytest.mark.parametrize(("watched", "expected"), [((), ["r1", "r2"]), (("r2",), ["r2"])])
async def test_the_watched_robots_of_the_realm_are_reported_as_they_come_and_go(
    watched: tuple[str, ...], expected: list[str]
) -> None:
    bus, changes = FakeBus(), list[tuple[str, bool]]()
    watch_robots(bus.join("2"), "fleet", watched, lambda name, alive: changes.append((name, alive)))
    keys = ("fleet/r1/@alive/gateway", "fleet/r2/@alive/gateway", "fleet/r2/@alive/hq", "fleet/a$b/@alive/gateway")
    tokens = [bus.announce(key) for key in keys]
    assert changes == [(name, True) for name in expected]
    for token in tokens:
        token.close()
    assert changes == [(name, True) for name in expected] + [(name, False) for name in expected]


def test_a_payload_that_cannot_be_decoded_is_counted_and_left_out() -> None:
    malformed = Metrics().count("malformed")
    assert read_payload(Switch, encode(Switch(on=True)), malformed) == Switch(on=True)
    assert malformed.value == 0
    assert read_payload(Switch, b"\xc1", malformed) is None
    assert malformed.value == 1


class Subscription:
    def __init__(self, path: str, open_paths: set[str]) -> None:
        self._path, self._open_paths = path, open_paths
        assert path not in open_paths
        open_paths.add(path)

    def close(self) -> None:
        self._open_paths.remove(self._path)


def test_what_is_needed_is_subscribed_to_once_and_nothing_else() -> None:
    open_paths: set[str] = set()
    subscriptions = OnDemandSubscriptions(lambda path: Subscription(path, open_paths))
    for needed in ({"pose", "scan"}, {"scan", "map"}, set[str]()):
        subscriptions.need(needed)
        assert open_paths == needed


@pytest.mark.parametrize(("stamp_ns", "expected"), [(0, 0), (99, 99), (100, 50), (-1, 50)])
def test_a_stamp_outside_what_can_be_written_becomes_now(stamp_ns: int, expected: int) -> None:
    assert measured_ns(stamp_ns, 50, 100) == expected
