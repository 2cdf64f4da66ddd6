"""A robot's camera with a real HTTP server, a real gateway and real Zenoh: who is shown what, and when."""

from __future__ import annotations

import base64
import contextlib
import os
import socket
import threading
import time
from collections.abc import Iterator
from itertools import count
from typing import Any

import msgpack
import pytest
import zenoh

from tests.camera.camera_bytes import HEAD, jpeg
from tests.e2e.conftest import Bench, Fleet, device, end, until
from tests.e2e.rigs.fake_camera import FakeCamera
from tests.e2e.rigs.foxglove_viewer import viewing
from tests.ports import free_port
from tests.views.protobuf import read
from tests.views.recording import files
from zbridge.views.schemas import foxglove_schema

HOST = "127.0.0.1"


class Listener:
    """Listens to the images of r1, from now on."""

    def __init__(self, session: zenoh.Session) -> None:
        self.images: list[dict[str, Any]] = []
        self._subscriber: Any = session.declare_subscriber("fleet/r1/image", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        assert str(sample.encoding) == "application/msgpack;zbridge.Image.v1"
        self.images.append(msgpack.unpackb(sample.payload.to_bytes()))

    def saw(self, picture: bytes) -> dict[str, Any] | None:
        return next((image for image in self.images if image["data"] == picture), None)

    def leave(self) -> None:
        self._subscriber.undeclare()


class Viewer:
    """A legacy HQ program's connection to the relay: keeps all bytes that come."""

    def __init__(self, port: int, *, reads: bool = True) -> None:
        until(lambda: self._connects(port), what="a relay that listens")
        self.received = b""
        self.socket.sendall(b"GET /stream.mjpg HTTP/1.1\r\nHost: robot:8000\r\nConnection: keep-alive\r\n\r\n")
        if reads:
            threading.Thread(target=self._read, daemon=True).start()

    def _connects(self, port: int) -> bool:
        with contextlib.suppress(OSError):
            self.socket = socket.create_connection((HOST, port), timeout=30)
            return True
        return False

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while data := self.socket.recv(65536):
                self.received += data

    def leave(self) -> None:
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)
        self.socket.close()


@pytest.fixture
def camera() -> Iterator[FakeCamera]:
    made = FakeCamera(free_port())
    made.start()
    with contextlib.closing(contextlib.ExitStack()) as stack:
        stack.callback(made.stop)
        yield made


def quiet(bench: Bench) -> Fleet:
    """Listen to the status only, and no longer to everything."""
    bench.fleet.subscriber.undeclare()
    return Fleet(bench.fleet.session, "fleet/*/status")


def with_camera(bench: Bench, camera: FakeCamera, more: str = "") -> Fleet:
    """Start the gateway of a robot that is away but for its camera."""
    fleet = quiet(bench)
    bench.gateway(device(free_port()), f'[camera]\nurl = "{camera.url}"\n{more}')
    until(fleet.state, what="a gateway")
    return fleet


def shown(camera: FakeCamera, listener: Listener, picture: bytes) -> dict[str, Any]:
    """Show a picture, again every 0.5 s, until the listener has seen it; give its image. A full bus drops pictures."""
    tries = count()

    def sees() -> dict[str, Any] | None:
        if next(tries) % 50 == 0:
            camera.show(picture)
        return listener.saw(picture)

    return until(sees, 20.0, what="the picture")


def ended_for_want_of_viewers(camera: FakeCamera) -> None:
    """Wait for the end of a connection whose pictures still come."""

    def ended() -> bool:
        camera.show(jpeg(4))
        return camera.clients == 0

    until(ended, what="the end of the connection that nobody needs")


def test_the_camera_is_asked_only_while_somebody_listens_and_pictures_come_byte_for_byte(
    bench: Bench, camera: FakeCamera
) -> None:
    fleet = with_camera(bench, camera)
    beats = len(fleet.seen["fleet/r1/status"])
    until(lambda: len(fleet.seen["fleet/r1/status"]) > beats + 1, what="two seconds of a robot that nobody watches")
    assert camera.requests == []

    listener, other = Listener(fleet.session), Listener(fleet.session)
    picture = jpeg(1, 5000, width=1280, height=720)
    image = shown(camera, listener, picture)
    expected = {"format": "jpeg", "data": picture, "width": 1280, "height": 720, "stamp_ns": image["stamp_ns"]}
    assert image == expected
    assert abs(image["stamp_ns"] / 1e9 - time.time()) < 60
    largest = jpeg(2, 4 * 1024 * 1024 - 49)
    shown(camera, listener, largest)
    (request,) = camera.requests
    assert request.startswith(b"GET /stream.mjpg HTTP/1.0\r\n")

    listener.leave()
    shown(camera, other, jpeg(3))
    other.leave()
    ended_for_want_of_viewers(camera)
    assert len(camera.requests) == 1


def test_a_camera_that_dies_shows_on_status_and_comes_back(bench: Bench, camera: FakeCamera) -> None:
    fleet = with_camera(bench, camera)
    listener = Listener(fleet.session)
    shown(camera, listener, jpeg(1))
    assert "camera" not in fleet.reason()
    camera.stop()
    until(lambda: f"camera {camera.url}: Connection refused" in fleet.reason(), 20.0, what="a status that says so")
    camera.start()
    until(lambda: camera.clients, 30.0, what="the next attempt")
    shown(camera, listener, jpeg(2))
    until(lambda: "camera" not in fleet.reason(), what="a status that no longer says so")


GARBAGE = {
    "no boundary": (HEAD.replace(b"; boundary=FRAME", b""), "the answer names no boundary"),
    "noise": (os.urandom(200_000).replace(b"HTTP", b""), "the answer is not HTTP|an HTTP head of more than 16384"),
    "silence": (HEAD, "no picture for 0.5 s"),
}


def test_garbage_ends_the_connection_shows_on_status_and_harms_nothing(bench: Bench, camera: FakeCamera) -> None:
    camera.answers += [answer for answer, _ in GARBAGE.values()]
    fleet = with_camera(bench, camera, "stall_s = 0.5\n")
    listener = Listener(fleet.session)
    for _, reasons in GARBAGE.values():
        until(lambda reasons=reasons: any(each in fleet.reason() for each in reasons.split("|")), 20.0, what=reasons)
    until(lambda: not camera.answers and camera.clients, 30.0, what="the next attempt")
    shown(camera, listener, jpeg(1))
    assert len(listener.images) == len([image for image in listener.images if image["data"].startswith(b"\xff\xd8")])
    until(lambda: "camera" not in fleet.reason(), what="a status that no longer says so")


def test_two_hq_programs_get_what_the_camera_writes_from_one_connection_and_a_third_that_never_reads_holds_nobody_up(
    bench: Bench, camera: FakeCamera
) -> None:
    port = free_port()
    fleet = with_camera(bench, camera, f'relay = "{HOST}:{port}"\n')
    first, slow = Viewer(port), Viewer(port, reads=False)
    until(lambda: camera.clients == 1, what="the connection to the camera")
    camera.show(jpeg(1))
    written = lambda: camera.written[0] if camera.written else b""  # noqa: E731
    until(lambda: jpeg(1) in written() == first.received, what="head, header and picture as the camera wrote them")

    second = Viewer(port)
    until(lambda: second.received == written(), what="the same, for a program that came later")
    for number in range(100, 160):
        camera.show(jpeg(number, 100_000))
    last = jpeg(159, 100_000)
    for viewer in (first, second):
        until(lambda viewer=viewer: viewer.received.endswith(last + b"\r\n"), what="the newest picture")
        parts, whole = viewer.received.split(b"--FRAME\r\n"), written().split(b"--FRAME\r\n")
        assert parts[0] == whole[0]
        assert [part for part in parts if part not in whole] == [], "every part is whole"
    assert (len(camera.requests), camera.clients) == (1, 1)

    for viewer in (first, second, slow):
        viewer.leave()
    ended_for_want_of_viewers(camera)
    assert "camera" not in fleet.reason()


def test_pictures_are_recorded_and_shown_to_foxglove_byte_for_byte(bench: Bench, camera: FakeCamera) -> None:
    with_camera(bench, camera)
    path, port, picture = bench.folder / "a.mcap", free_port(), jpeg(9, 5000)

    def image(payload: bytes) -> bytes:
        return base64.b64decode(read(foxglove_schema("CompressedImage"), payload)["data"])

    recorder = bench.zbridge("record", "r1", "-o", str(path), "--connect", bench.endpoint)
    server = bench.zbridge("foxglove", "--listen", f"{HOST}:{port}", "--connect", bench.endpoint)
    assert "recording" in recorder.stdout.readline()
    assert "Foxglove connects" in server.stdout.readline()
    with viewing(port) as viewer:
        viewer.subscribe("/r1/image")

        def seen() -> bool:
            camera.show(picture)
            return picture in [image(payload) for _, payload in viewer.shown.get("/r1/image", ())]

        viewer.until(seen, "the picture")
    end(recorder)
    kept = files.read(path)
    assert picture in [msgpack.unpackb(data)["data"] for topic, _, _, data in kept if topic == "fleet/r1/image"]
    assert picture in [image(data) for topic, _, _, data in kept if topic == "/r1/image"]
