"""``zbridge echo``: what it refuses, and when it ends."""

from __future__ import annotations

import asyncio

import pytest

from tests.fake_bus import FakeBus
from zbridge.bus import Bus, BusSettings
from zbridge.cli.bus import echo
from zbridge.errors import ConfigError
from zbridge.fleet import topics

NOWHERE = BusSettings(connect=("tcp/127.0.0.1:1",), multicast=False)
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
    monkeypatch.setattr("zbridge.cli.bus.open_bus", open_bus)
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
        await echo(NOWHERE, key, realm=realm)
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
    await echo(NOWHERE, key, realm=realm, seconds=SECONDS)
    assert bus.joined == [joined]  # type: ignore[attr-defined]


@pytest.mark.jumping
@pytest.mark.parametrize(
    ("messages", "count", "done", "said"),
    [
        (0, 0, False, "no messages on fleet/r1/pose within 30 s\n"),
        (2, 0, True, ""),
        (2, 3, False, "2 messages on fleet/r1/pose within 30 s\n"),
        (3, 3, True, ""),
    ],
)
async def test_the_time_ends_and_with_too_few_messages_that_is_a_failure(
    bus: FakeBus, capfd: pytest.CaptureFixture[str], messages: int, count: int, done: bool, said: str
) -> None:
    echoing = asyncio.create_task(echo(NOWHERE, "fleet/r1/pose", count=count, seconds=SECONDS))
    await asyncio.sleep(SECONDS / 2)
    publisher = bus.publisher("fleet/r1/pose", topics.POSE)
    for _ in range(messages):
        publisher.put(b"\x80")
    assert await echoing is done
    out, err = capfd.readouterr()
    assert (out.count("\n"), err) == (messages, said)
