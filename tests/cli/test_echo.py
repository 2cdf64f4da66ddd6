"""``zbridge echo``: what it refuses, and when it ends."""

from __future__ import annotations

import asyncio
import json

import pytest

from tests.fake_bus import FakeBus
from zbridge.bus import Bus, BusSettings
from zbridge.cli.echo import HINT_S, Echo, Rates, echo, on_demand
from zbridge.errors import ConfigError
from zbridge.fleet import topics

NOWHERE = BusSettings(connect=("tcp/127.0.0.1:1",), multicast=False)
POSE = "fleet/r1/pose"
NO_ROBOT = "nothing yet on fleet/r1/pose: no robot r1 on the bus: `zbridge ls` lists those that are\n"
SECONDS = 30.0
"""As long as the loop's clock, which jumps, has to wait."""


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> FakeBus:
    bus = FakeBus("robot")
    joined: list[str | None] = []

    async def open_bus(*_: object, realm: str | None, **__: object) -> Bus:
        joined.append(realm)
        return bus.join("program")

    bus.joined = joined  # type: ignore[attr-defined]
    monkeypatch.setattr("zbridge.client.open_bus", open_bus)
    return bus


@pytest.mark.parametrize(
    ("key", "realm", "why"),
    [
        ("fleet/r1/pose*", None, "KEY = 'fleet/r1/pose*': `*` may only be preceded by `/` or `$`"),
        ("fleet/r1?", None, "KEY = 'fleet/r1?': `#` and `?` are forbidden characters"),
        ("", None, "KEY = '': empty chunks are forbidden, as well as leading and trailing slashes"),
        ("/", None, "KEY = '/': empty chunks are forbidden, as well as leading and trailing slashes"),
        (
            "/fleet/r1/*",
            None,
            "KEY = '/fleet/r1/*': empty chunks are forbidden, as well as leading and trailing slashes; "
            "keys neither begin nor end with '/': try 'fleet/r1/*'",
        ),
        ("r1/pose", "lab", "KEY = 'r1/pose': expected a key of realm lab, as 'lab/r1/pose'"),
        ("**", "a/b", "realm = 'a/b': expected letters, digits, '_', '.' and '-' only"),
    ],
)
async def test_what_is_no_key_expression_of_the_realm_is_refused_in_one_line(
    key: str, realm: str | None, why: str
) -> None:
    with pytest.raises(ConfigError) as error:
        await echo(NOWHERE, Echo(key=key), realm=realm)
    assert str(error.value) == why


@pytest.mark.parametrize(
    ("key", "realm", "joined"),
    [
        ("fleet/r1/pose", None, "fleet"),
        ("**/*", None, None),
        ("**", "lab", "lab"),
        ("lab/r1/pose", "lab", "lab"),
        ("*/r1/pose", "lab", "lab"),
    ],
)
@pytest.mark.jumping
async def test_the_realm_is_that_of_the_key_or_the_one_that_is_given(
    bus: FakeBus, key: str, realm: str | None, joined: str | None
) -> None:
    await echo(NOWHERE, Echo(key=key, seconds=SECONDS), realm=realm)
    assert bus.joined == [joined]  # type: ignore[attr-defined]


@pytest.mark.jumping
@pytest.mark.parametrize(
    ("messages", "count", "done", "said"),
    [
        (0, 0, False, f"{NO_ROBOT}no messages on fleet/r1/pose within 30 s\n"),
        (2, 0, True, ""),
        (2, 3, False, "2 messages on fleet/r1/pose within 30 s\n"),
        (3, 3, True, ""),
    ],
)
async def test_the_time_ends_and_with_too_few_messages_that_is_a_failure(
    bus: FakeBus, capfd: pytest.CaptureFixture[str], messages: int, count: int, done: bool, said: str
) -> None:
    echoing = asyncio.create_task(echo(NOWHERE, Echo(key=POSE, count=count, seconds=SECONDS)))
    await asyncio.sleep(HINT_S / 2)
    publisher = bus.publisher(POSE, topics.POSE)
    for _ in range(messages):
        publisher.put(b"\x80")
    assert await echoing is done
    out, err = capfd.readouterr()
    assert (out.count("\n"), err) == (messages, said)


THERE = ("fleet/r1/@alive/gateway", "fleet/r2/@alive/gateway")


@pytest.mark.jumping
@pytest.mark.parametrize(
    ("key", "tokens", "hint"),
    [
        (POSE, (), "no robot r1 on the bus: `zbridge ls` lists those that are"),
        (POSE, THERE[1:], "no robot r1 on the bus: `zbridge ls` lists those that are"),
        ("fleet/r1/@wire/**", (), "no robot r1 on the bus: `zbridge ls` lists those that are"),
        ("fleet/**", (), "no robots on the bus: `zbridge ls` lists those that are"),
        (POSE, THERE, "r1 is on the bus, but publishes nothing there: `zbridge ls` shows states"),
        ("fleet/*/pose", THERE, "r1, r2 are on the bus, but publish nothing there: `zbridge ls` shows states"),
        ("fleet/r1/image", THERE, None),
        ("fleet/r1/@wire/**", THERE, None),
        ("fleet/r1/@cmd/drive", THERE, None),
    ],
)
@pytest.mark.parametrize("hz", [False, True])
async def test_a_hint_says_whether_the_robot_is_missing_or_the_key_is_silent(
    bus: FakeBus, capfd: pytest.CaptureFixture[str], key: str, tokens: tuple[str, ...], hint: str | None, hz: bool
) -> None:
    for token in tokens:
        bus.announce(token)
    await echo(NOWHERE, Echo(key=key, seconds=SECONDS, hz=hz))
    out, err = capfd.readouterr()
    said = [f"nothing yet on {key}: {hint}"] if hint is not None else []
    assert (out, err.splitlines()) == ("", [*said, f"no messages on {key} within 30 s"])


@pytest.mark.jumping
async def test_rates_are_printed_once_a_second_and_count_no_last_value(
    bus: FakeBus, capfd: pytest.CaptureFixture[str]
) -> None:
    status = bus.publisher("fleet/r1/status", topics.STATUS)
    status.put(b"\x80")
    echoing = asyncio.create_task(echo(NOWHERE, Echo(key="fleet/r1/*", seconds=2.5, hz=True, as_json=True)))
    await asyncio.sleep(0.05)
    pose = bus.publisher(POSE, topics.POSE)
    for _ in range(9):
        pose.put(b"\x80")
        await asyncio.sleep(0.1)
    status.put(b"\x80")
    assert await echoing is True
    lines = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert [(line["key"], line["count"], line["hz"]) for line in lines] == [
        *((POSE, 9, 9.0), ("fleet/r1/status", 1, 1.0)),
        *((POSE, 9, 0.0), ("fleet/r1/status", 1, 0.0)),
        *((POSE, 9, 0.0), ("fleet/r1/status", 1, 0.0)),
    ]
    assert [line["longest_pause_s"] for line in lines if line["key"] == POSE] == pytest.approx(
        [0.15, 1.15, 1.65], abs=0.02
    )


def test_a_pause_is_told_while_it_lasts_and_after_it_ended() -> None:
    rates = Rates(100.0)
    for at in (100.1, 100.2, 100.9):
        rates.note(POSE, at)
    assert rates.report(101.0) == [{"key": POSE, "count": 3, "hz": 3.0, "longest_pause_s": 0.7}]
    assert rates.report(102.0) == [{"key": POSE, "count": 3, "hz": 0.0, "longest_pause_s": 1.1}]
    rates.note(POSE, 102.4)
    assert rates.report(103.0) == [{"key": POSE, "count": 4, "hz": 1.0, "longest_pause_s": 1.5}]


def test_the_keys_that_are_counted_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zbridge.cli.echo.KEYS", 1)
    rates = Rates(0.0)
    for key in (POSE, "fleet/r2/pose", POSE):
        rates.note(key, 0.5)
    assert (len(rates.report(1.0)), rates.left_out) == (1, 1)


def test_what_exists_only_on_demand_is_known() -> None:
    assert [key for key in (POSE, "fleet/**", "fleet/*/image", "fleet/r1/@rpc/map") if on_demand(key)] == [
        *("fleet/*/image", "fleet/r1/@rpc/map"),
    ]
