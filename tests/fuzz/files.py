"""Targets of recordings, cameras and HTTP: files and answers of programs that are not ours."""

from __future__ import annotations

import contextlib
import io
import re
import tomllib
from collections.abc import Iterator
from typing import Any

from tests.bounds import most_kept
from tests.camera import camera_bytes
from tests.fuzz.target import Target, comparable, cut, require_same
from tests.views.recording import files as recorded
from zbridge.app import config, endpoint
from zbridge.camera.mjpeg import HEAD_BYTES, PICTURE_BYTES, MjpegReader, is_jpeg, jpeg_size
from zbridge.errors import ConfigError, ProtocolError
from zbridge.fleet.topics import KeySpace
from zbridge.views.recording import reader, summary, wire_tape

KEYS = KeySpace("fleet", "r1")
KEPT_BYTES = PICTURE_BYTES + HEAD_BYTES + (1 << 20)


def read_recording(data: bytes) -> None:
    """Read a file as MCAP; count what it holds, and find the frames of its links."""
    found = reader.RecordingReader(io.BytesIO(data))
    messages, summaries = [], {}
    for message in found.messages():
        messages.append(message)
        channel = message.channel
        summaries.setdefault(channel, summary.KeySummary(channel.topic, channel.encoding, channel.schema)).note(message)
    assert found.ended or found.fault, "a file that ends nowhere"
    seen = [channel.topic for channel in summaries]
    summary.robots_of(seen)
    for each in summaries.values():
        assert each.rate_hz >= 0
    for link in wire_tape.wire_links(KEYS, seen):
        list(wire_tape.steps(messages, KEYS, link))


def read_camera(data: bytes) -> None:
    """Read a camera's answer whole and cut; both must give the same pictures and the same fault."""
    if not data:
        return
    require_same("the pictures depend on the cut", _pictures([data[1:]]), _pictures(list(cut(data[1:], data[0]))))


def _pictures(reads: list[bytes]) -> list[Any]:
    mjpeg, parts, fault = MjpegReader(), [], ""
    try:
        for read in reads:
            found = mjpeg.receive(read)
            parts += found
            assert most_kept(mjpeg) <= KEPT_BYTES
            for part in found:
                assert is_jpeg(part.jpeg)
                jpeg_size(part.jpeg)
    except ProtocolError as error:
        fault = str(error)
    if fault and len(reads) == 1:  # one broken read gives none of its parts
        return [fault]
    return [fault] if fault else [comparable(parts), mjpeg.head, mjpeg.ended, mjpeg.rejected]


def answer_http(data: bytes) -> None:
    """Answer a request to the metrics endpoint."""
    found = endpoint.parse(data)
    if found is None:
        assert len(data) <= endpoint.REQUEST_BYTES
    elif isinstance(found, tuple):
        assert found[0] in ("GET", "HEAD")
        assert found[1].startswith("/")


def read_configuration(data: bytes) -> None:
    """Read a configuration: nothing but ConfigError says that it is none."""
    with contextlib.suppress(ConfigError, tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError):
        config.plan(tomllib.loads(data.decode()))


def targets() -> Iterator[Target]:
    """Yield the targets."""
    yield Target("mcap", read_recording, _recordings, ("zbridge/views/recording/reader.py",
                 "zbridge/views/recording/wire_tape.py", "zbridge/views/recording/summary.py"), 8192)  # fmt: skip
    yield Target("mjpeg", read_camera, _answers, ("zbridge/camera/mjpeg.py",), 8192)
    yield Target("http", answer_http, _requests, (), 1024)
    yield Target("configuration", read_configuration, _configurations, ())


def _recordings() -> Iterator[bytes]:
    status = recorded.packed(state="established", links=[{"name": "robot", "state": "established", "peer": "p"}])
    frames = [recorded.channel(1, "fleet/r1/@wire/robot/in"), recorded.channel(2, "fleet/r1/status"),
              recorded.channel(3, "fleet/r1/@wire/robot/out"), recorded.message(2, status), recorded.message(3, b"hi"),
              recorded.message(1, b"\1\2")]  # fmt: skip
    schema = recorded.record(0x03, b"\1\0" + recorded.text("zbridge.Pose.v1") + recorded.text("x") + bytes(4))
    metadata = recorded.record(0x0C, recorded.text("zbridge") + bytes(4))
    head = recorded.MAGIC + recorded.HEADER
    yield head + b"".join(frames) + recorded.END
    yield head + schema + metadata + recorded.channel(1, "fleet/r1/pose", 1) + recorded.message(1) + recorded.END
    yield head + recorded.chunk(b"".join(frames), checksum=0) + recorded.END
    for compression in ("zstd", "lz4"):
        packed = _packed(compression, b"".join(frames))
        yield head + recorded.chunk(b"".join(frames), checksum=0, compression=compression, of=packed) + recorded.END


def _packed(compression: str, data: bytes) -> bytes:
    if compression == "zstd":
        import zstandard

        return zstandard.ZstdCompressor().compress(data)
    import lz4.frame

    packed: bytes = lz4.frame.compress(data)
    return packed


def _answers() -> Iterator[bytes]:
    pictures = b"".join(camera_bytes.part(camera_bytes.jpeg(number, 8)) for number in range(3))
    yield b"\0" + camera_bytes.HEAD + pictures + b"--FRAME--\r\n"
    unsized = re.sub(rb"Content-Length: [0-9]+\r\n", b"", pictures)
    yield b"\1" + camera_bytes.HEAD + unsized + b"--FRAME--\r\n"
    yield b"\2" + camera_bytes.HEAD.replace(b"boundary=FRAME", b'boundary="--FRAME"').replace(b"\r\n", b"\n") + pictures
    yield b"\3HTTP/1.1 404 Not Found\r\n\r\n"


def _requests() -> Iterator[bytes]:
    yield from (f"GET {path} HTTP/1.0\r\n\r\n".encode() for path in ("/", "/metrics", "/healthz", "/readyz", "/no"))


def _configurations() -> Iterator[bytes]:
    yield b'[robot]\nname = "r1"\n[device]\nprotocol = "alf"\nconnect = ["tcp://127.0.0.1:6666"]\n'
    yield (
        b'[robot]\nname = "r1"\n[[hq]]\nprotocol = "tcpudp"\nlisten = "tcp://127.0.0.1:1"\noptions = {udp = true}\n'
        b'[bus]\nmode = "client"\nconnect = ["tcp/h:1"]\n[control]\nlease_s = 3.0\n[metrics]\nlisten = "h:1"\n'
    )
