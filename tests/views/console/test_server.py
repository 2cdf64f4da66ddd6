"""The console's server on a real socket: what it serves, whom it refuses, and what a slow page costs."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import math
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import pytest
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.client import Gateway, at, subscriptions
from tests.ports import HOST
from tests.views.console.conftest import Scene
from zbridge.errors import ConfigError, LinkError
from zbridge.fleet import topics
from zbridge.fleet.messages import Pose, Status
from zbridge.protocol.address import Address
from zbridge.views.console import console, orders, page, server
from zbridge.views.console.http_server import listener

STATIC = Path(server.__file__).parent / "static"
CONFIRMED = "stopped (their gateways sent it)"


def states(message: dict[str, Any]) -> list[tuple[str, str]]:
    return [(row["name"], row["state"]) for row in message.get("rows", ())]


async def latched(robot: Gateway) -> None:
    """Wait until a robot is latched: within a second, which is less than a stop of all takes to be judged."""
    async with asyncio.timeout(1):
        while robot.control.state != "latched":  # noqa: ASYNC110
            await asyncio.sleep(0.01)


def notice(message: dict[str, Any], of: str) -> dict[str, Any]:
    """What a message says of an order of a robot, or "" of all; nothing if it does not."""
    found: dict[str, Any] = message.get("notices", {}).get(of) or {}
    return found


async def until(opened: ClientConnection, condition: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    """Read messages until one meets a condition."""
    async with asyncio.timeout(10):
        while True:
            received = await opened.recv()
            message: dict[str, Any] = json.loads(received) if isinstance(received, str) else {}
            if condition(message):
                return message


async def test_a_page_gets_all_robots_and_what_has_come_of_a_stop(scene: Scene) -> None:
    async with scene.page() as opened, scene.page() as other:
        first = await until(opened, lambda message: len(message.get("rows", ())) == 2)
        assert sorted(row["name"] for row in first["rows"]) == ["r1", "r2"]
        await opened.send(json.dumps({"do": "stop_all"}))
        assert (await until(opened, lambda message: notice(message, "")))["notices"][""]["good"] is None
        done = await until(other, lambda message: notice(message, "").get("good") is not None)
        assert done["notices"][""]["text"] == f"2 of 2 {CONFIRMED}"
        assert {gateway.control.state for gateway in scene.world.gateways.values()} == {"latched"}
        await until(opened, lambda message: all(row["latched"] for row in message.get("rows", [{"latched": 0}])))
        late = scene.page()
        async with late as opened_late:
            snapshot = await until(opened_late, lambda message: message.get("full"))
            assert snapshot["notices"][""]["text"] == f"2 of 2 {CONFIRMED}"


async def test_a_robot_that_was_released_and_driven_is_stopped_by_the_next_press_at_once(scene: Scene) -> None:
    """The stop before is confirmed, and movement is still watched for."""
    robot = scene.world.gateways["r1"]
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "stop_all"}))
        await latched(robot)
        await asyncio.sleep(orders.SAME_PRESS_S)
        await scene.world.fleet.unlatch()
        async with scene.world.others.control("ann") as drive:
            await drive(forward=0.5)
            stops = robot.machine.stops
            await opened.send(json.dumps({"do": "stop_all"}))
            await latched(robot)
        assert robot.machine.stops > stops
        done = await until(opened, lambda message: notice(message, "").get("good") is not None)
        assert done["notices"][""]["text"] == f"2 of 2 {CONFIRMED}"


async def test_a_stop_right_after_a_release_is_a_press_of_its_own(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orders, "SAME_PRESS_S", 60.0)
    robot = scene.world.gateways["r1"]
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "stop_all"}))
        await latched(robot)
        await opened.send(json.dumps({"do": "stop_all"}))
        await opened.send(json.dumps({"do": "release"}))
        async with asyncio.timeout(1):
            while robot.control.state == "latched":  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        await opened.send(json.dumps({"do": "stop_all"}))
        await latched(robot)
        done = await until(opened, lambda message: notice(message, "").get("good") is not None)
    assert done["notices"][""]["text"] == f"2 of 2 {CONFIRMED}"


async def test_what_came_of_an_earlier_stop_hides_no_later_release(scene: Scene) -> None:
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "stop_all"}))
        await latched(scene.world.gateways["r2"])
        await opened.send(json.dumps({"do": "release"}))
        await until(opened, lambda message: notice(message, "").get("text") == "2 of 2 released")
        await asyncio.sleep(2.0)
        async with scene.page() as late:
            snapshot = await until(late, lambda message: message.get("full"))
    assert snapshot["notices"][""]["text"] == "2 of 2 released"


async def test_a_robot_of_the_roster_that_is_not_on_the_bus_is_missing_from_a_stop_of_all(scene: Scene) -> None:
    scene.roster.add(["r9"])
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "stop_all"}))
        done = await until(opened, lambda message: notice(message, "").get("good") is not None)
    text = f"2 of 3 {CONFIRMED}; r9 without a gateway, which nothing can stop from here"
    assert (done["notices"][""]["text"], done["notices"][""]["good"]) == (text, False)


async def test_of_single_robots_the_last_news_are_kept_and_bad_ones_the_longest(scene: Scene) -> None:
    good = [f"r{number}" for number in range(1, 3)]
    bad = [f"gone{number}" for number in range(console.NOTICES - 1)]
    async with scene.page() as opened:
        for robot in (*bad, *good):
            await opened.send(json.dumps({"do": "stop", "robot": robot}))
        done = await until(opened, lambda message: all(notice(message, robot).get("good") is False for robot in bad))
    assert [robot for robot in done["notices"] if robot in bad] == sorted(bad)
    assert len(done["notices"]) == console.NOTICES


async def test_the_last_news_are_shown_though_all_others_are_bad(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "NOTICES", 1)
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "stop", "robot": "gone"}))
        await until(opened, lambda message: notice(message, "gone").get("good") is False)
        await opened.send(json.dumps({"do": "stop", "robot": "r1"}))
        await until(opened, lambda message: notice(message, "r1").get("good"))


async def test_a_second_press_of_one_is_answered_too(scene: Scene) -> None:
    async with scene.page() as opened:
        for robot in ("", "r1"):
            request = {"do": "stop", "robot": robot} if robot else {"do": "stop_all"}
            for _ in range(2):
                await opened.send(json.dumps(request))
            first = await until(opened, lambda message: notice(message, robot))  # noqa: B023
            at = notice(first, robot)["at"]
            await until(opened, lambda message: notice(message, robot).get("at", at) > at)  # noqa: B023


async def test_a_pose_that_nobody_expects_hides_no_report(scene: Scene) -> None:
    robot = scene.world.gateways["r1"]
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "stop_all"}))
        await latched(robot)
        await asyncio.sleep(0.7)  # it is watched now
        for heading in (0.0, math.inf):
            robot.publish(topics.POSE, Pose(0.0, 0.0, heading))
        done = await until(opened, lambda message: notice(message, "").get("good") is not None)
    assert "r1 still moves by its own pose or speed" in done["notices"][""]["text"]


async def test_an_order_that_fails_says_so(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    async def fail(*arguments: Any) -> None:
        raise ZeroDivisionError("nobody knows why")

    monkeypatch.setattr(orders, "stop_fleet", fail)
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "stop_all"}))
        done = await until(opened, lambda message: notice(message, "").get("good") is False)
    assert done["notices"][""]["text"].startswith("STOP ALL: this console failed: ")


async def test_a_stop_is_sent_however_many_orders_are_under_way(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orders, "ORDERS", 1)
    async with scene.page() as opened:
        await until(opened, lambda message: len(message.get("rows", ())) == 2)
        await opened.send(json.dumps({"do": "stop", "robot": "gone"}))
        for request in ({"do": "stop", "robot": "lost"}, {"do": "unlatch", "robot": "r1"}):
            await opened.send(json.dumps(request))
            told = await until(opened, lambda message: "warning" in message)
            assert (told["action"], told["robot"]) == (request["do"], request["robot"])
            assert told["warning"].endswith("NOT sent: 1 orders are under way; STOP ALL always works")
        await opened.send(json.dumps({"do": "stop", "robot": "r1"}))
        await until(opened, lambda message: notice(message, "r1").get("good"))
        await opened.send(json.dumps({"do": "stop_all"}))
        await latched(scene.world.gateways["r2"])


async def test_what_is_said_of_one_robot_hides_nothing_that_was_said_of_all(scene: Scene) -> None:
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "stop_all"}))
        await until(opened, lambda message: notice(message, "").get("good"))
        await opened.send(json.dumps({"do": "stop", "robot": "r9"}))
        done = await until(opened, lambda message: notice(message, "r9").get("good") is False)
        assert done["notices"][""]["text"] == f"2 of 2 {CONFIRMED}"


async def test_a_release_names_who_is_latched_by_a_stop_of_its_own(scene: Scene) -> None:
    await scene.world.fleet["r2"].latch("wet floor")
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "release"}))
        done = await until(opened, lambda message: notice(message, "").get("good") is not None)
    said = done["notices"][""]
    assert not said["good"]
    assert said["text"].endswith("still latched by a stop of its own, released on the robot's page: r2")


async def test_one_robot_is_stopped_and_the_other_one_is_not(scene: Scene) -> None:
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "stop", "robot": "r2"}))
        done = await until(opened, lambda message: notice(message, "r2").get("good") is not None)
    assert done["notices"]["r2"]["text"] == "r2 stopped (its gateway sent it)"
    assert scene.world.gateways["r2"].machine.stops
    assert not scene.world.gateways["r1"].machine.stops


async def test_a_robot_that_was_there_is_missing_until_it_is_forgotten(scene: Scene, tmp_path: Path) -> None:
    async with scene.page() as opened:
        await until(opened, lambda message: len(message.get("rows", ())) == 2)
        await scene.world.gateways["r2"].vanish()
        await until(opened, lambda message: ("r2", "NO GATEWAY") in states(message))
        assert (tmp_path / "fleet.roster").read_text() == "r1\nr2\n"
        await opened.send(json.dumps({"do": "forget", "robot": "r1"}))  # it is there
        await opened.send(json.dumps({"do": "forget", "robot": "r2"}))
        assert (await until(opened, lambda message: message.get("gone")))["gone"] == ["r2"]


async def robot_news(opened: ClientConnection, path: str) -> Any:
    """Read what a robot published until a key comes; give the robot and the message."""
    async with asyncio.timeout(10):
        while True:
            received = await opened.recv()
            frame = msgpack.unpackb(received) if isinstance(received, bytes) else {"news": ()}
            for news in frame["news"]:
                if news[0] == path:
                    return frame["robot"], msgpack.unpackb(news[3])


async def test_a_page_gets_what_the_robot_publishes_that_it_looks_at(scene: Scene) -> None:
    async with scene.page() as opened, scene.page() as other:
        await opened.send(json.dumps({"do": "look", "robot": "r1"}))
        await robot_news(opened, "status")
        scene.world.pose(7.0)
        scene.world.gateways["r2"].publish(topics.POSE, at(8.0))
        robot, pose = await robot_news(opened, "pose")
        assert (robot, pose["x"]) == ("r1", 7.0)
        await opened.send(json.dumps({"do": "look", "robot": "r2"}))
        assert (await robot_news(opened, "status"))[0] == "r2"
        assert subscriptions(scene.world.bus, "fleet/r1/*") == 0
        await opened.send(json.dumps({"do": "look"}))
        await opened.send(json.dumps({"do": "stop", "robot": "r1"}))
        await until(other, lambda message: notice(message, "r1").get("good"))
        assert subscriptions(scene.world.bus, "fleet/r2/*") == 0


async def test_a_page_that_is_closed_looks_at_nothing(scene: Scene) -> None:
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "look", "robot": "r1"}))
        await robot_news(opened, "status")
    async with asyncio.timeout(5):
        while subscriptions(scene.world.bus, "fleet/r1/*"):  # noqa: ASYNC110
            await asyncio.sleep(0.01)


async def test_who_drove_and_who_stopped_a_robot_is_told(scene: Scene) -> None:
    async with scene.page() as opened:
        await opened.send(json.dumps({"do": "look", "robot": "r1"}))
        async with scene.world.others.control("ann"):
            await opened.send(json.dumps({"do": "stop", "robot": "r1"}))
            await until(opened, lambda message: notice(message, "r1").get("good"))
        await opened.send(json.dumps({"do": "look", "robot": "r1"}))
        _, entries = await robot_news(opened, "@history")
        assert [entry["text"] for entry in entries] == ["ann drives", "stopped by this console: ann no longer drives"]


async def test_a_switch_is_sent_or_refused_by_what_the_robot_accepts(scene: Scene) -> None:
    scene.world.gateway.publish(topics.STATUS, Status("established", commands=("stop", "light")))
    async with scene.page() as opened:
        for name in ("light", "lidar"):
            await opened.send(json.dumps({"do": "switch", "robot": "r1", "name": name, "on": True}))
            done = await until(opened, lambda message: notice(message, "r1"))
            good = name == "light"
            assert notice(done, "r1")["good"] is good
    assert [name for name, _ in scene.world.machine.commands] == ["light"]


async def test_a_page_hears_something_while_nothing_changes(scene: Scene) -> None:
    async with scene.page() as opened:
        await until(opened, lambda message: message == {})


@pytest.mark.parametrize("origin", [None, "http://evil.example", "http://127.0.0.1:1", "https://127.0.0.1", "null"])
async def test_a_socket_of_another_page_is_refused(scene: Scene, origin: str | None) -> None:
    with pytest.raises(InvalidStatus) as refused:
        async with scene.page(origin=origin):
            pytest.fail("it was accepted")
    assert refused.value.response.status_code == 403


async def test_a_name_that_somebody_elses_dns_turns_here_is_refused(scene: Scene) -> None:
    for path in ("/", "/static/app.js"):
        status, _, _ = await scene.get(path, Host=f"evil.example:{scene.at.rpartition(':')[2]}")
        assert status == 403
    status, _, _ = await scene.get("/", Host=f"localhost:{scene.at.rpartition(':')[2]}")
    assert status == 200


async def test_every_answer_forbids_what_a_page_of_ours_does_not_need(scene: Scene) -> None:
    for path in ("/", "/static/app.js", "/static/vendor/htm-preact.js", "/nothing"):
        _, headers, _ = await scene.get(path)
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert (headers["x-content-type-options"], headers["cache-control"]) == ("nosniff", "no-cache")


def test_the_pages_are_small() -> None:
    files = [path.read_bytes() for path in STATIC.rglob("*") if path.is_file()]
    assert sum(map(len, files)) <= 200_000
    assert sum(len(gzip.compress(content)) for content in files) <= 80_000


async def test_files_beside_the_pages_are_not_served(scene: Scene) -> None:
    for path in ("/static/../server.py", "/static/%2e%2e/server.py", "/static/..%2fserver.py", "/server.py"):
        assert (await scene.get(path))[0] == 404


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        b"",
        '{"do": "switch", "robot": "r1", "name": "drive"}',
        '{"do": "drive"}',
        '{"do": "stop", "more": 1}',
        "x" * (page.MOST_BYTES + 1),
    ],
)
async def test_a_page_that_sends_what_it_must_not_is_closed_and_others_stay(scene: Scene, text: str | bytes) -> None:
    async with scene.page() as good, scene.page() as bad:
        await bad.send(text)
        with pytest.raises(ConnectionClosed):
            await until(bad, lambda message: False)
        await good.send(json.dumps({"do": "stop", "robot": "r1"}))
        await until(good, lambda message: notice(message, "r1").get("good"))


async def test_there_are_no_more_pages_than_fit(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "FOLLOWERS", 1)
    async with scene.page() as first:
        await until(first, lambda message: message.get("full"))
        with pytest.raises(InvalidStatus):
            async with scene.page():
                pytest.fail("it was accepted")
    async with asyncio.timeout(5):
        while True:
            with contextlib.suppress(InvalidStatus):
                async with scene.page() as next_one:
                    await until(next_one, lambda message: message.get("full"))
                    return


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.0.2", "::", "example.org"])
def test_off_loopback_it_needs_tls_and_users(host: str) -> None:
    with pytest.raises(ConfigError, match="expected --tls-certificate"):
        server.ConsoleSettings(Address(host, 8080))
    files = {"certificate": Path("c.pem"), "key": Path("k.pem"), "hosts": ("console.lab",)}
    with pytest.raises(ConfigError, match="expected --users"):
        server.ConsoleSettings(Address(host, 8080), **files)  # type: ignore[arg-type]
    server.ConsoleSettings(Address(host, 8080), users=Path("users.toml"), **files)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"own_role": "operator"}, "every user of this machine could use the console's certificate"),
        ({"hosts": ("console.lab",)}, "expected --users"),
        ({"certificate": Path("c.pem")}, "expected both, or neither"),
        ({"proxied": True}, "--proxied: expected an address of loopback, and --host"),
    ],
)
def test_settings_that_let_somebody_in_by_mistake_are_errors(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        server.ConsoleSettings(Address(HOST, 8080), **settings)


@pytest.mark.parametrize(
    ("settings", "port", "origins"),
    [
        ({}, 8080, ["http://127.0.0.1:8080", "http://localhost:8080"]),
        (
            {"hosts": ("console.lab",), "users": Path("u")},
            8080,
            ["http://console.lab:8080", "http://127.0.0.1:8080", "http://localhost:8080"],
        ),
        ({"hosts": ("console.lab",), "users": Path("u"), "proxied": True}, 8080, ["https://console.lab"]),
        (  # behind something that passes port 443 on, as in the chart
            {"hosts": ("console.lab:443",), "users": Path("u"), "certificate": Path("c"), "key": Path("k")},
            8443,
            [
                *("https://console.lab:443", "https://127.0.0.1:8443", "https://localhost:8443"),
                "https://console.lab",
            ],
        ),
        (
            {"certificate": Path("c"), "key": Path("k")},
            443,
            [
                *("https://127.0.0.1:443", "https://localhost:443"),
                *("https://127.0.0.1", "https://localhost"),
            ],
        ),
    ],
)
def test_the_origins_of_its_own_pages(settings: dict[str, Any], port: int, origins: list[str]) -> None:
    assert server.ConsoleSettings(Address(HOST, port), **settings).origins(HOST, port) == origins


def test_a_port_that_is_taken_is_an_error_that_names_it() -> None:
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(LinkError, match=str(port)):
            listener(Address(HOST, port))
