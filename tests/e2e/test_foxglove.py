"""``zbridge foxglove`` with real gateways, real Zenoh and real WebSockets: who looks, who drives, who is refused."""

from __future__ import annotations

import json
import signal
import socket
import ssl
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus

from tests.certificates import Authority
from tests.e2e.conftest import HOST, Bench, until
from tests.e2e.rigs.foxglove_viewer import Viewer, viewing
from tests.ports import free_port
from tests.views.foxglove.recordings import BEGIN_NS, record
from tests.views.protobuf import read
from zbridge.views.schemas import foxglove_schema

PAGE, EVIL = "http://robots.example", "http://evil.example"
TOKEN = "0123456789abcdef0123456789abcdef"


class Server:
    """A process of ``zbridge foxglove``."""

    def __init__(self, bench: Bench, *arguments: str) -> None:
        self.port = free_port()
        listen = ("--listen", f"{HOST}:{self.port}")
        self.process = bench.zbridge("foxglove", *arguments, *listen)
        assert self.process.stdout is not None
        line = ""
        while "Foxglove connects to" not in line:
            line = self.process.stdout.readline()
            assert line, "the server ended"

    def memory_mb(self) -> float:
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) / 1024

    def listening(self) -> set[int]:
        """Give the TCP ports at which the process listens."""
        inodes = {
            str(link.readlink()).removeprefix("socket:[").removesuffix("]")
            for link in Path(f"/proc/{self.process.pid}/fd").iterdir()
            if str(link.readlink()).startswith("socket:")
        }
        rows = [
            row.split()
            for table in ("tcp", "tcp6")
            for row in Path(f"/proc/{self.process.pid}/net/{table}").read_text().splitlines()[1:]
        ]
        return {int(row[1].rpartition(":")[2], 16) for row in rows if row[3] == "0A" and row[9] in inodes}


@pytest.fixture
def server(bench: Bench) -> Iterator[Server]:
    """A simulated robot, its gateway, and a server at which a page may drive."""
    bench.serve(bench.simulator())
    until(lambda: bench.fleet.last("r1/control") and bench.fleet.last("r1/pose"), what="control and a pose")
    server = Server(bench, "--connect", bench.endpoint, "--drive", "--origin", PAGE)
    yield server
    server.process.send_signal(signal.SIGTERM)
    bench.ended_within(server.process, 10)


def holder(bench: Bench) -> str | None:
    name: str | None = bench.fleet.last("r1/control").get("holder")
    return name


def at(bench: Bench) -> tuple[float, float]:
    pose = bench.fleet.last("r1/pose")
    return (pose["x"], pose["y"])


def drives(viewer: Viewer, bench: Bench, forward: float = 0.5) -> None:
    """Hold a button down until the robot has moved in the viewer's name."""
    began = at(bench)

    def moved() -> bool:
        viewer.twist(1, forward=forward)
        viewer.read()
        return at(bench) != began and (holder(bench) or "").startswith("foxglove.")

    until(moved, what="motion")


def stays_free(bench: Bench) -> None:
    """Wait until the robot is free, and stands."""
    until(lambda: holder(bench) is None, what="a free robot")
    poses = bench.fleet.seen["fleet/r1/pose"]

    def stands() -> bool:
        seen = len(poses)
        until(lambda: len(poses) >= seen + 4, what="poses")
        return len({(pose["x"], pose["y"]) for pose in poses[-3:]}) == 1

    until(stands, what="a robot that stands")


def test_a_viewer_sees_what_it_subscribed_to_and_drives_and_gives_back_what_it_holds(
    bench: Bench, server: Server
) -> None:
    with viewing(server.port, "/?name=anna", origin=PAGE) as viewer:
        viewer.subscribe("/r1/pose", "/r1/tf", "/r1/map", "/r1/control", "/r1/log")
        viewer.until(lambda: len(viewer.shown) == 5 and len(viewer.shown["/r1/pose"]) > 3, "five channels")
        pose = read(foxglove_schema("PoseInFrame"), viewer.shown["/r1/pose"][-1][1])
        assert pose["frame_id"] == "r1/map"
        assert read(foxglove_schema("Grid"), viewer.shown["/r1/map"][-1][1])["column_count"] > 0
        assert json.loads(viewer.shown["/r1/control"][-1][1])["state"] == "free"
        assert viewer.told[0]["op"] == "serverInfo"

        viewer.publish_on(1, "/r1/cmd_vel")
        drives(viewer, bench)
        assert holder(bench) == "foxglove.anna.1"
        stays_free(bench)  # its silence ends the motion and the lease

        drives(viewer, bench)
        viewer.socket.socket.shutdown(socket.SHUT_RDWR)  # gone, without a word
        stays_free(bench)
    assert server.listening() == {server.port}  # there is no way round the front


def test_a_stop_is_open_to_who_may_not_drive_and_who_is_stopped_must_let_go_first(bench: Bench, server: Server) -> None:
    with viewing(server.port, origin=PAGE) as driver, viewing(server.port) as looker:
        driver.publish_on(1, "/r1/cmd_vel")
        looker.publish_on(1, "/r1/cmd_vel")
        looker.publish_on(2, "/r1/stop", schemaName="std_msgs/Empty")
        looker.twist(1, forward=1.0)
        looker.until(lambda: looker.warned("you may look and stop, not drive"), "a refusal")
        looker.call("/r1/light", 5, on=True)
        looker.until(lambda: looker.told[-1]["op"] == "serviceCallFailure", "a refused call")
        looker.say("setParameters", parameters=[{"name": "r1.mode", "value": "autonomous"}])
        drives(driver, bench)
        looker.publish(2, b"{}")

        def stopped() -> bool:
            driver.twist(1, forward=0.5)  # the button is still held
            driver.read()
            return driver.warned("let go for a second")

        until(stopped, what="a stop")
        for _ in range(10):
            driver.twist(1, forward=0.5)
        stays_free(bench)
        driver.twist(1)  # let go
        drives(driver, bench)
        looker.call("/stop", 6)
        looker.until(lambda: looker.answers.get(6) == b'{"ok":true}', "the answer to a stop")
        until(lambda: bench.fleet.last("r1/control")["state"] == "stopped", what="a stopped robot")


def test_a_robot_that_a_viewer_latched_is_driven_by_nobody_before_a_driver_unlatches_it(
    bench: Bench, server: Server
) -> None:
    with viewing(server.port, origin=PAGE) as driver, viewing(server.port) as looker:
        driver.publish_on(1, "/r1/cmd_vel")
        for number, service in enumerate(("/r1/latch", "/latch")):
            drives(driver, bench)
            looker.call(service, number, reason="a cable is loose")
            looker.until(lambda number=number: looker.answers.get(number) == b'{"ok":true}', "the answer to a latch")
            looker.until(lambda: looker.warned("(a cable is loose)"), "the news that it is latched")

            def refused() -> bool:
                driver.twist(1)
                driver.twist(1, forward=0.5)
                driver.read()
                return driver.warned("latched by ")

            until(refused, what="a refusal")
            stays_free(bench)
            unlatch = service.replace("latch", "unlatch")
            looker.call(unlatch, 5)
            looker.until(lambda: looker.told[-1]["op"] == "serviceCallFailure", "a refused call")
            driver.call(unlatch, 10 + number)
            driver.until(
                lambda number=number: driver.answers.get(10 + number) == b'{"ok":true}', "the answer to a release"
            )
            driver.told.clear()
            driver.twist(1)  # let go


def test_switches_are_parameters_that_follow_the_robot(bench: Bench, server: Server) -> None:
    def values(viewer: Viewer) -> dict[str, Any]:
        told = [
            entry for message in viewer.told if message["op"] == "parameterValues" for entry in message["parameters"]
        ]
        return {entry["name"]: entry["value"] for entry in told}

    with viewing(server.port, origin=PAGE) as viewer, viewing(server.port) as other:
        for one in (viewer, other):
            one.until(lambda one=one: "/r1/scan" in one.channels, "channels")
            one.say("getParameters", parameterNames=[], id="all")
            one.say("subscribeParameterUpdates", parameterNames=[])
        viewer.until(lambda: "r1.lidar" in values(viewer), "parameters")
        lidar = values(viewer)["r1.lidar"]
        viewer.say("setParameters", parameters=[{"name": "r1.lidar", "value": not lidar}], id="set")
        other.until(lambda: values(other).get("r1.lidar") is not lidar, "the news")
        until(lambda: bench.fleet.last("r1/lidar").get("on") is not lidar, what="a switched lidar")
        viewer.say("setParameters", parameters=[{"name": "r1.lidar", "value": "maybe"}])
        viewer.until(lambda: viewer.warned("lidar = 'maybe': expected one of True, False"), "a refusal")
        viewer.call("/r1/mode", 1, mode="manual")
        viewer.until(lambda: viewer.answers.get(1) == b'{"ok":true}', "the mode")
        until(lambda: (holder(bench) or "").startswith("foxglove."), what="a lease that is held for the mode")
        viewer.call("/r1/mode", 2, mode="none")
        stays_free(bench)
        viewer.call("/r1/mode", 3, mode="manual")
        viewer.until(lambda: viewer.answers.get(3) == b'{"ok":true}', "the mode again")
        viewer.socket.socket.shutdown(socket.SHUT_RDWR)  # gone, without a word: what it held for the mode is released
        stays_free(bench)
        other.until(lambda: values(other)["r1.mode"] == "none", "the end of the mode")


def test_foreign_origins_and_missing_tokens_are_turned_away_and_counted(bench: Bench) -> None:
    token = bench.folder / "token"
    token.write_text(TOKEN)
    metrics = f"{HOST}:{free_port()}"
    server = Server(bench, "--connect", bench.endpoint, "--token", str(token), "--drive", "--metrics", metrics)
    for path, origin, status in (
        ("/", EVIL, 403),
        (f"/?token={TOKEN}", EVIL, 403),
        ("/", None, 401),
        ("/?token=wrong", None, 401),
        ("/", "https://app.foxglove.dev", 401),
    ):
        with pytest.raises(InvalidStatus) as refused, viewing(server.port, path, origin=origin):
            pass
        assert refused.value.response.status_code == status
    with viewing(server.port, f"/?token={TOKEN}") as viewer:
        viewer.until(lambda: viewer.told, "a greeting")
    with urlopen(f"http://{metrics}/metrics") as answer:
        counted = answer.read().decode()
    assert 'zbridge_foxglove_refused_total{reason="origin"} 2' in counted
    assert 'zbridge_foxglove_refused_total{reason="token"} 3' in counted
    server.process.send_signal(signal.SIGTERM)
    said = server.process.communicate()[0]
    assert TOKEN not in said
    assert "may drive" in said


def test_a_server_with_a_certificate_is_reached_by_tls_alone(bench: Bench) -> None:
    authority = Authority(bench.folder / "lab")
    files = authority.issue("server")
    certificate, key = files / "certificate.pem", files / "key.pem"
    path = record(bench.folder / "a.mcap", 1)
    server = Server(bench, str(path), "--tls-certificate", str(certificate), "--tls-key", str(key))
    trusting = ssl.create_default_context(cafile=authority.ca)
    with viewing(server.port, scheme="wss", ssl=trusting) as viewer:
        viewer.subscribe("/r1/pose")
        viewer.until(lambda: viewer.shown.get("/r1/pose"), "a pose")
        assert viewer.socket.socket.version() in ("TLSv1.2", "TLSv1.3")
    with pytest.raises(ssl.SSLCertVerificationError), viewing(server.port, scheme="wss"):
        pass
    with pytest.raises((InvalidMessage, ConnectionClosed, ConnectionError)), viewing(server.port):
        pass


def test_hostile_viewers_are_refused_and_ended_and_nothing_moves_or_grows(bench: Bench, server: Server) -> None:
    with viewing(server.port) as quiet:
        quiet.subscribe("/r1/pose")
        quiet.until(lambda: quiet.shown, "a pose")
        before_mb, began = server.memory_mb(), at(bench)
        with viewing(server.port, origin=PAGE) as foreign:
            foreign.publish_on(1, "/r2/cmd_vel")
            foreign.publish_on(2, "/r1/cmd_vel", schemaName="std_msgs/String")
            foreign.publish_on(3, "/r1/cmd_vel", encoding="cdr")
            foreign.publish_on(4, "/r1/../r1/cmd_vel")
            for number in (1, 2, 3, 4, 99):
                foreign.twist(number, forward=1.0)
            foreign.publish_on(5, "/r1/cmd_vel")
            for payload in (b"", b"garbage", b'{"linear":{"x":1e999}}', b"[" * 5000):
                foreign.publish(5, payload)
            for message in (
                "garbage",
                "{}",
                '{"op":"subscribe","subscriptions":[{"id":1,"channelId":99}]}',
                b"\x77",
                b"",
            ):
                foreign.socket.send(message)
            foreign.say("unsubscribe", subscriptionIds=[7, 8])
            foreign.until(lambda: foreign.warned("there is no robot 'r2'"), "a refusal")
            foreign.until(lambda: foreign.warned("expected 'geometry_msgs/Twist'"), "another")
        with viewing(server.port) as flooding, pytest.raises(ConnectionClosed):
            flood(flooding)
        with viewing(server.port) as large:
            large.socket.send("x" * 2_000_000)
            with pytest.raises(ConnectionClosed):
                large.until(lambda: False, "the end")
        deaf = raw_viewer(server.port)
        asked = json.dumps({"op": "getParameters", "parameterNames": [], "id": "x" * 1000}).encode()
        for _ in range(300):
            deaf.sendall(masked(asked))
        for data in (b"GET / HTTP/1.1\r\n" + b"x" * 99_999, b"\x16\x03\x01garbage", b"", bytes(9999)):
            with socket.create_connection((HOST, server.port)) as stranger:
                stranger.sendall(data)
        seen = len(quiet.shown["/r1/pose"])
        quiet.until(lambda: len(quiet.shown["/r1/pose"]) > seen + 10, "poses continue")
        deaf.close()
        assert at(bench) == began
        assert holder(bench) is None
        assert server.memory_mb() < before_mb + 30


def flood(viewer: Viewer) -> None:
    """Say as much as the server takes."""
    while True:
        viewer.say("subscribeParameterUpdates", parameterNames=["x" * 1000])


def raw_viewer(port: int) -> socket.socket:
    """Open a WebSocket by hand, which never reads."""
    peer = socket.create_connection((HOST, port))
    peer.sendall(
        b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
    )
    assert b" 101 " in peer.recv(256)
    return peer


def masked(text: bytes) -> bytes:
    """Frame a text message as clients do, with a mask of zeros."""
    return b"\x81\xfe" + struct.pack(">H", len(text)) + bytes(4) + text


def test_robots_come_and_go(bench: Bench) -> None:
    server = Server(bench, "--connect", bench.endpoint, "--robot", "r1")
    with viewing(server.port) as viewer:
        viewer.until(lambda: viewer.told, "a greeting")
        assert viewer.channels == {}
        gateway = bench.serve(bench.simulator())
        viewer.subscribe("/r1/status")
        viewer.until(lambda: viewer.shown.get("/r1/status"), "a status")
        gateway.end()
        viewer.until(
            lambda: not viewer.channels and set(viewer.services) == {"/stop", "/latch", "/unlatch"}, "no robot"
        )


def test_a_recording_is_played_paused_sped_up_and_sought(bench: Bench) -> None:
    server = Server(bench, str(record(bench.folder / "a.mcap", 60)))
    with viewing(server.port) as viewer:
        viewer.subscribe("/r1/pose", "/r1/map", "/r1/scan")
        viewer.until(lambda: len(viewer.shown) == 3, "the first messages, while it is paused")
        info = viewer.told[0]
        assert info["capabilities"] == ["time", "playbackControl"]
        assert info["dataStartTime"] == {"sec": BEGIN_NS // 10**9, "nsec": 0}
        assert viewer.states == [(1, BEGIN_NS, 1.0, False, "")]

        poses = viewer.shown["/r1/pose"]
        viewer.play(speed=4.0, request="a")
        viewer.until(lambda: len(poses) > 40, "poses")
        assert viewer.states[-1][0::4] == (0, "a")
        viewer.play(play=False, request="b")
        viewer.until(lambda: viewer.states[-1][4] == "b", "a pause")
        times = [time for time, _ in poses]
        assert times == list(range(BEGIN_NS, times[-1] + 1, 50_000_000))  # each one, once, in order

        viewer.play(play=False, seek_ns=BEGIN_NS + 15 * 10**9, request="c")
        viewer.until(lambda: poses[-1][0] == BEGIN_NS + 15 * 10**9, "the pose at that time")
        assert viewer.states[-1] == (1, BEGIN_NS + 15 * 10**9, 1.0, True, "c")
        assert viewer.shown["/r1/map"][-1][0] == BEGIN_NS  # the map of then
        viewer.play(speed=20.0, request="d")
        viewer.until(lambda: viewer.states[-1][0] == 3, "the end")
        viewer.until(lambda: poses[-1][0] == BEGIN_NS + 1199 * 50_000_000, "the last pose")  # news overtake messages
        viewer.twist(1, forward=1.0)
        viewer.until(lambda: viewer.warned("channel 1 is not one of yours"), "a refusal")
