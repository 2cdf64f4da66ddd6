"""The console for programs, on a real socket: what it answers, and whom it refuses."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import socket
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.client import World
from tests.views.console.programs import PASSWORD, Programs
from tests.views.console.serving import served
from zbridge.fleet import topics
from zbridge.fleet.messages import Map, Pose, Status
from zbridge.views.console import api, callers, console, http_server
from zbridge.views.console.api import OPERATIONS
from zbridge.views.console.callers import COOKIE
from zbridge.views.console.journal import Journal
from zbridge.views.console.rights import Caller
from zbridge.views.console.users import User, hash_password, new_token, save_users

CONFIRMED = "stopped (their gateways sent it)"
HASHED = hash_password(PASSWORD)


class Lab(Programs):
    """Programs and browsers before a console, and its robots."""

    def __init__(self, world: World, at: str, folder: Path, tokens: dict[str, str]) -> None:
        super().__init__(at, tokens)
        self.world, self.folder = world, folder

    def journal(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.folder / "journal").read_text().splitlines()]


@pytest.fixture
async def open_console(tmp_path: Path) -> AsyncIterator[Lab]:
    """A console without users."""
    world = World("r1", "r2")
    async with served(world.fleet, world.bus.join("console"), tmp_path / "roster") as at:
        yield Lab(world, at, tmp_path, {})


@pytest.fixture
async def programs(tmp_path: Path) -> AsyncIterator[Lab]:
    """A console with a user of each role, who also has a token."""
    world, tokens, known = World("r1", "r2"), dict[str, str](), dict[str, User]()
    for role in ("viewer", "operator", "supervisor"):
        tokens[role], kept = new_token()
        known[role] = User(role, HASHED, {"lab": kept})  # type: ignore[arg-type]
    save_users(tmp_path / "users.toml", known)
    settings = {"users": tmp_path / "users.toml", "journal": tmp_path / "journal"}
    async with served(world.fleet, world.bus.join("console"), tmp_path / "roster", **settings) as at:
        yield Lab(world, at, tmp_path, tokens)


async def ended(page: Any) -> tuple[int, str]:
    """Wait until the console closes a socket; give its code and its reason."""
    with contextlib.suppress(ConnectionClosed):
        async with asyncio.timeout(5):
            while True:
                await page.recv()
    return page.close_code, page.close_reason


# What it answers


async def test_robots_and_what_they_publish_are_read(open_console: Lab) -> None:
    world = open_console.world
    world.gateway.publish(topics.STATUS, Status("established", protocol="tcpudp", commands=("stop", "drive")))
    world.gateway.publish(topics.MAP, Map(1, 2, 0.5, (0.0, 1.0), np.array([[0, 2]], np.uint8)))
    await asyncio.sleep(0.7)
    robots = (await open_console.ask("GET", "/api/robots")).json["robots"]
    assert [row["name"] for row in robots] == ["r1", "r2"]
    assert (await open_console.ask("GET", "/api/robots/r1")).json["protocol"] == "tcpudp"
    assert (await open_console.ask("GET", "/api/robots/r1/status")).json["commands"] == ["stop", "drive"]
    assert (await open_console.ask("GET", "/api/robots/r1/control")).json["state"] == "free"
    assert (await open_console.ask("GET", "/api/robots/r1/map")).json["cells"] == [[0, 2]]
    asking = asyncio.create_task(open_console.ask("GET", "/api/robots/r1/pose"))
    while not asking.done():
        world.gateway.publish(topics.POSE, Pose(1.0, 2.0, float("nan")))
        await asyncio.sleep(0.02)
    assert {name: (await asking).json[name] for name in ("x", "y", "heading")} == {"x": 1.0, "y": 2.0, "heading": None}


@pytest.mark.parametrize("path", ["/api/robots/r9", "/api/robots/r9/status", "/api/robots/r1/scan", "/api/robots/r%2A"])
async def test_what_is_not_there_is_404_with_a_reason(open_console: Lab, path: str) -> None:
    answer = await open_console.ask("GET", path)
    assert answer.status == 404
    assert answer.json["error"]


async def test_a_program_stops_and_releases(open_console: Lab) -> None:
    one = await open_console.ask("POST", "/api/robots/r1/stop")
    assert (one.status, one.json) == (200, {"text": "r1 stopped (its gateway sent it)", "good": True})
    everything = await open_console.ask("POST", "/api/stop")
    assert everything.json == {"text": f"2 of 2 {CONFIRMED}", "good": True}
    assert {gateway.control.state for gateway in open_console.world.gateways.values()} == {"latched"}
    released = await open_console.ask("POST", "/api/unlatch")
    assert released.json == {"text": "2 of 2 released", "good": True}
    await open_console.world.fleet["r2"].latch("wet floor")
    answer = await open_console.ask("POST", "/api/unlatch", {"robot": "r2"})
    assert answer.json == {"text": "r2: 1 latched stops released", "good": True}


async def test_events_begin_with_all_and_go_on_with_changes(open_console: Lab) -> None:
    host, _, port = open_console.host.partition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(f"GET /api/events HTTP/1.1\r\nHost: {open_console.host}\r\n\r\n".encode())
    told: list[dict[str, Any]] = []

    async def until(name: str) -> Any:
        async with asyncio.timeout(10):
            while True:
                line = await reader.readline()
                if line.startswith(b"data: "):
                    told.append(json.loads(line[6:]))
                    if name in told[-1]:
                        return told[-1][name]

    assert await until("full")
    await open_console.ask("POST", "/api/robots/r1/stop")
    assert await until("notices")
    writer.close()


async def test_the_document_names_every_route_and_no_other(open_console: Lab) -> None:
    document = (await open_console.ask("GET", "/api/openapi.json")).json
    described = {(path, method) for path, methods in document["paths"].items() for method in methods}
    assert described == {(each.path, each.method.lower()) for each in OPERATIONS}
    for path, method in described:
        operation = document["paths"][path][method]
        assert operation["summary"]
        assert ("requestBody" in operation) is (path in ("/api/login", "/api/unlatch"))
        answer = await open_console.ask("DELETE", path.format(robot="r1"))
        assert answer.status in (403, 405)
    assert document["components"]["schemas"]["UnlatchRequest"]["properties"]["robot"]["type"] == "string"
    real = {(each.path, each.method) for each in OPERATIONS}
    for path in ("/api/robots/r1/sensors", "/api/users", "/api"):
        assert (path, "GET") not in real
        assert (await open_console.ask("GET", path)).status == 404


# Whom it refuses


async def test_without_a_login_nothing_is_told_and_nothing_done(programs: Lab) -> None:
    for each in OPERATIONS:
        if each.right is not None:
            answer = await programs.ask(each.method, each.path.format(robot="r1"))
            assert answer.status == 401, each.path
            assert answer.headers["www-authenticate"] == "Bearer"
    for bad in ("Bearer x", "Basic YTpi", f"Bearer {programs.tokens['viewer']}x", "Bearer ", "x"):
        assert (await programs.ask("GET", "/api/robots", Authorization=bad)).status == 401
    for path in ("/socket", "/drive/r1"):
        with pytest.raises(InvalidStatus):
            async with programs.page(path):
                pytest.fail("it was accepted")
    assert not any(gateway.machine.stops for gateway in programs.world.gateways.values())


async def test_a_browser_logs_in_and_out_and_an_old_cookie_is_worth_nothing(programs: Lab) -> None:
    answer = await programs.log_in("operator")
    cookie = answer.headers["set-cookie"]
    name, _, rest = cookie.partition("=")
    assert name == COOKIE == "__Host-zbridge"
    assert {"HttpOnly", "Secure", "SameSite=Strict", "Path=/"} <= {part.strip() for part in rest.split(";")}
    headers = {"Cookie": cookie.partition(";")[0], "Origin": programs.at, "X-Zbridge-Csrf": answer.json["csrf"]}
    me = (await programs.ask("GET", "/api/me", **headers)).json
    assert (me["user"], me["role"], me["may"]) == (
        "operator",
        "operator",
        ["drive", "look", "stop", "switch", "unlatch"],
    )
    async with programs.page(Cookie=headers["Cookie"]) as page:
        first = json.loads(await page.recv())
        assert first["me"]["user"] == "operator"
        out = await programs.ask("POST", "/api/logout", **headers)
        assert "Max-Age=0" in out.headers["set-cookie"]
        assert await ended(page) == (4401, "the login has ended")
    assert (await programs.ask("GET", "/api/me", **headers)).status == 401
    with pytest.raises(InvalidStatus):
        async with programs.page(Cookie=headers["Cookie"]):
            pytest.fail("it was accepted")


async def test_a_forged_request_of_a_logged_in_browser_does_nothing(programs: Lab) -> None:
    headers = await programs.browser("supervisor")
    for changed in (
        {"X-Zbridge-Csrf": "x"},
        {"X-Zbridge-Csrf": ""},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
    ):
        assert (await programs.ask("POST", "/api/stop", **{**headers, **changed})).status == 403
    without = {name: value for name, value in headers.items() if name != "Origin"}
    assert (await programs.ask("POST", "/api/stop", **without)).status == 403, "a browser names its page"
    assert not programs.world.gateway.machine.stops
    assert (await programs.ask("POST", "/api/stop", **headers)).status == 200


async def test_a_program_without_users_is_no_page_of_another_site(open_console: Lab) -> None:
    assert (await open_console.ask("POST", "/api/stop", Origin="http://evil.example")).status == 403
    forged = {"Sec-Fetch-Site": "cross-site"}
    assert (await open_console.ask("POST", "/api/stop", **forged)).status == 403
    assert (await open_console.ask("POST", "/api/login", {"user": "a", "password": "b"})).status == 404


@pytest.mark.parametrize("user", ["viewer", "nobody", "", "ann\n", "x" * 2000])
async def test_a_wrong_password_is_refused_and_says_no_more(programs: Lab, user: str) -> None:
    answer = await programs.log_in(user, "wrong password")
    assert answer.status in (400, 401)
    assert answer.status == 400 or answer.json == {"error": "no such user, or another password"}
    assert "set-cookie" not in answer.headers


async def test_a_thousand_attempts_are_refused_before_they_are_hashed(
    programs: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(api, "REFUSED_S", 0.0)
    hashed = list[str | None]()
    compare = callers.is_password
    monkeypatch.setattr(callers, "is_password", lambda known, given: (hashed.append(known), compare(known, given))[1])
    answers = await asyncio.gather(*(programs.log_in("viewer", f"guess {number}") for number in range(1000)))
    statuses = [answer.status for answer in answers]
    assert statuses.count(401) == len(hashed) == 5
    assert statuses.count(429) == 995
    assert len(programs.journal()) == 5
    metrics = (await programs.ask("GET", "/metrics", user="viewer")).body.decode()
    assert 'zbridge_console_requests_refused_total{status="429"} 995' in metrics


async def test_what_a_role_may_not_is_refused_though_it_sends_the_message_by_hand(programs: Lab) -> None:
    assert (await programs.ask("POST", "/api/unlatch", user="operator")).status == 403
    assert (await programs.ask("POST", "/api/unlatch", {"robot": "r1"}, user="viewer")).status == 403
    headers = await programs.browser("viewer")
    with pytest.raises(InvalidStatus):
        async with programs.page("/drive/r1", Cookie=headers["Cookie"]):
            pytest.fail("it was accepted")
    async with programs.page(Cookie=headers["Cookie"]) as page:
        for request in (
            {"do": "switch", "robot": "r1", "name": "light", "on": True},
            {"do": "release"},
            {"do": "unlatch", "robot": "r1"},
            {"do": "forget", "robot": "r1"},
        ):
            await page.send(json.dumps(request))
            async with asyncio.timeout(5):
                while "warning" not in (told := json.loads(await page.recv())):
                    continue
            assert "viewer (viewer) may not" in told["warning"]
    operator = await programs.browser("operator")
    async with programs.page("/drive/r1", Cookie=operator["Cookie"]) as drive:
        await drive.send(json.dumps({"do": "take", "takeover": True}))
        async with asyncio.timeout(5):
            while "may not take a robot over" not in (
                json.loads(await drive.recv()).get("control", {}).get("notice") or ""
            ):
                continue
    assert programs.world.machine.commands == []
    assert programs.world.gateway.questions("takeover") == []


async def test_what_users_do_is_written_down_with_who_and_what_came_of_it(programs: Lab) -> None:
    await programs.ask("POST", "/api/robots/r1/stop", user="viewer")
    await programs.log_in(PASSWORD, "wrong password")  # who typed it as the name
    await programs.log_in("viewer", "wrong password")
    headers = await programs.browser("operator")
    async with programs.page("/drive/r1", Cookie=headers["Cookie"]) as drive:
        await drive.send(json.dumps({"do": "take"}))
        async with asyncio.timeout(5):
            while json.loads(await drive.recv()).get("control", {}).get("state") != "held":
                continue
        assert programs.world.gateway.control.holder == "console.operator"
    await asyncio.sleep(0.2)
    await asyncio.sleep(0.2)
    lines = [(line.get("user", ""), line["action"], line.get("robot"), line["result"]) for line in programs.journal()]
    assert lines[:8] == [
        ("viewer", "stop", "r1", "asked"),
        ("viewer", "stop", "r1", "r1 stopped (its gateway sent it)"),
        ("", "login", None, "refused: no such user, or another password"),
        ("viewer", "login", None, "refused: no such user, or another password"),
        ("operator", "login", None, "ok"),
        ("operator", "take", "r1", "asked"),
        ("operator", "drive", "r1", "has control"),
        ("operator", "drive", "r1", "the page was closed or reloaded"),
    ]
    assert all(line["address"] == "127.0.0.1" and line["time"] for line in programs.journal())


def test_neither_clocks_nor_others_keep_a_users_lines_out_of_the_journal(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = list[str]()
    journal = Journal(lines.append, lambda: 0.0)
    ann, bob = Caller("ann", "operator", frozenset()), Caller("bob", "operator", frozenset())
    for _ in range(200):
        journal.note(bob, "mode none", "r1")
        journal.note(bob, "login", result="no", refused=True)
    count = len(lines)
    assert count == 120
    monkeypatch.setattr(time, "time_ns", lambda: 0)
    journal.note(ann, "stop_all", result="asked")
    assert [json.loads(line)["action"] for line in lines[count:]] == ["stop_all"]
    assert sum(json.loads(line).get("left_out", 0) for line in lines) == 280


async def test_a_user_who_is_removed_is_out_at_once(programs: Lab) -> None:
    headers = await programs.browser("operator")
    async with programs.page(Cookie=headers["Cookie"]) as page:
        save_users(programs.folder / "users.toml", {})
        assert await ended(page) == (4401, "the login has ended")
    assert (await programs.ask("GET", "/api/robots", **headers)).status == 401
    assert (await programs.ask("GET", "/api/robots", user="operator")).status == 401


async def test_a_file_of_users_that_is_broken_keeps_those_of_before_and_is_said(programs: Lab) -> None:
    headers = await programs.browser("operator")
    async with programs.page(Cookie=headers["Cookie"]) as page:
        (programs.folder / "users.toml").write_text("[users")
        async with asyncio.timeout(5):
            while "users.toml: not TOML" not in (json.loads(await page.recv()).get("fault") or ""):
                continue
        assert (await programs.ask("GET", "/api/robots", user="viewer")).status == 200
        await page.close()
    async with programs.page(Cookie=headers["Cookie"]) as late:
        assert "users.toml: not TOML" in json.loads(await late.recv())["fault"]


# What it bounds


async def test_a_removed_user_does_nothing_more_by_a_socket_that_it_does_not_read(programs: Lab) -> None:
    headers = await programs.browser("operator")
    await asyncio.sleep(0.7)
    async with (
        programs.page(Cookie=headers["Cookie"]) as page,
        programs.page("/drive/r1", Cookie=headers["Cookie"]) as drive,
    ):
        await programs.ask("POST", "/api/logout", **headers)
        await page.send(json.dumps({"do": "stop", "robot": "r1"}))
        await drive.send(json.dumps({"do": "take"}))
        await page.wait_closed()
        await drive.wait_closed()
    assert not programs.world.gateway.machine.stops
    assert programs.world.gateway.questions("acquire") == []


async def test_one_user_has_its_share_of_those_who_follow_and_drive(
    programs: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "FOLLOWERS_EACH", 1)
    monkeypatch.setattr(console, "DRIVES_EACH", 1)
    operator, supervisor = await programs.browser("operator"), await programs.browser("supervisor")
    for path in ("/socket", "/drive/r1"):
        async with programs.page(path, Cookie=operator["Cookie"]):
            with pytest.raises(InvalidStatus):
                async with programs.page(path, Cookie=operator["Cookie"]):
                    pytest.fail("it was accepted")
            async with programs.page(path, Cookie=supervisor["Cookie"]):
                pass


async def test_a_body_that_nobody_reads_keeps_no_connection(programs: Lab) -> None:
    host, _, port = programs.host.partition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    head = f"POST /api/stop HTTP/1.1\r\nHost: {programs.host}\r\nContent-Length: 1000000\r\n\r\n"
    writer.write(head.encode())
    async with asyncio.timeout(3):
        answer = await reader.read()
    assert answer.startswith(b"HTTP/1.1 401")
    writer.close()


async def test_large_heads_and_bodies_are_refused(programs: Lab) -> None:
    with contextlib.suppress(OSError, http.client.HTTPException):
        answer = await programs.ask("GET", "/", **{"X-Large": "x" * 1_000_000})
        assert answer.status == 400
    assert (await programs.log_in("viewer", "x" * 100_000)).status == 400
    assert (await programs.ask("POST", "/api/login", b"{" * 100, Origin=programs.at)).status == 400
    assert (await programs.ask("GET", "/api/robots", user="viewer")).status == 200


async def test_slow_requests_are_ended_and_idle_connections_bounded(
    programs: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http_server, "REQUEST_S", 0.5)
    monkeypatch.setattr(http_server, "EACH", 40)
    host, _, port = programs.host.partition(":")
    idle = [socket.create_connection((host, int(port))) for _ in range(100)]
    try:
        await asyncio.sleep(0.2)
        slow = idle[0]
        slow.sendall(b"GET / HTTP/1.1\r\nHo")
        ended = 0
        async with asyncio.timeout(5):
            while ended < 100:
                await asyncio.sleep(0.1)
                ended = 0
                for each in idle:
                    each.setblocking(False)
                    with contextlib.suppress(BlockingIOError):
                        try:
                            ended += each.recv(1, socket.MSG_PEEK) == b""
                        except ConnectionError:
                            ended += 1
        assert (await programs.ask("GET", "/api/robots", user="viewer")).status == 200
    finally:
        for each in idle:
            each.close()


@pytest.mark.parametrize(
    "path", ["/static/../server.py", "/static/%2e%2e/server.py", "/api/../server.py", "//etc/passwd"]
)
async def test_no_path_leads_out_of_the_pages(programs: Lab, path: str) -> None:
    assert (await programs.ask("GET", path)).status == 404


async def test_a_host_name_that_somebody_rebound_reaches_nothing(programs: Lab) -> None:
    for method, path in (("GET", "/api/robots"), ("POST", "/api/stop"), ("GET", "/")):
        answer = await programs.ask(method, path, user="supervisor", Host="evil.example")
        assert answer.status == 403
    assert not programs.world.gateway.machine.stops
