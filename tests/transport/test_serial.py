"""Serial links over pairs of pseudo-terminals, on both event loops."""

import asyncio
import contextlib
import os
import sys
import termios
import tty
from collections.abc import AsyncIterator

import pytest

from tests.transport.recorder import SOON_S, Recorder
from zbridge.errors import LinkError
from zbridge.protocol.address import SerialAddress
from zbridge.transport import serial
from zbridge.transport.by_address import connect
from zbridge.transport.link import STALLED_S
from zbridge.transport.serial import SerialLink

pytestmark = pytest.mark.both_loops


class Line:
    """A serial line: its far end (``fd``, ``read``, ``unplug``), and a link over it with what that brings."""

    def __init__(self) -> None:
        self.fd, self.near = os.openpty()
        tty.setraw(self.near)
        os.set_blocking(self.fd, False)
        self.address = SerialAddress(os.ttyname(self.near), 57600)

    async def connect(self) -> None:
        self.recorder = Recorder()
        link = await connect(self.address, self.recorder)
        assert isinstance(link, SerialLink)
        assert self.recorder.link is link
        self.link = link

    async def read(self, size: int) -> bytes:
        """Read ``size`` bytes; whoever writes continues meanwhile."""
        data = b""
        async with asyncio.timeout(SOON_S):
            while len(data) < size:
                with contextlib.suppress(BlockingIOError):
                    data += os.read(self.fd, size - len(data))
                await asyncio.sleep(0.001)
        return data

    def fill(self) -> int:
        """Write until the line takes no more; return how much."""
        sent = 0
        while self.link.ready:
            self.link.write(bytes(1000))
            sent += 1000
            assert sent < 1_000_000
        return sent

    def unplug(self) -> None:
        for fd in (self.fd, self.near):
            with contextlib.suppress(OSError):
                os.close(fd)
        self.fd = self.near = -1


@pytest.fixture
async def line() -> AsyncIterator[Line]:
    made = Line()
    await made.connect()
    yield made
    made.link.abort()
    await made.recorder.until("lost")
    made.unplug()


async def test_bytes_go_both_ways_at_the_configured_speed_but_for_while_paused(line: Line) -> None:
    every_byte = bytes(range(256))
    assert (line.link.peer, line.link.ready, line.link.silent_s) == (str(line.address), True, 0.0)
    assert termios.tcgetattr(line.near)[4:6] == [termios.B57600, termios.B57600]
    line.link.write_datagram(b"nobody's")
    line.link.write(every_byte)
    assert await line.read(256) == every_byte
    for call in (line.link.pause_reading, line.link.pause_reading):
        call()
    os.write(line.fd, every_byte)
    await asyncio.sleep(0.02)
    assert not line.recorder.data
    for call in (line.link.resume_reading, line.link.resume_reading):
        call()
    await line.recorder.until("received", received=256)
    assert line.recorder.data == every_byte


async def test_a_line_that_takes_nothing_is_not_ready_and_what_waits_is_unacknowledged_until_it_takes(line) -> None:
    assert line.link.unacknowledged_s == 0.0
    sent = line.fill()
    await asyncio.sleep(0.05)
    sent += line.fill()  # a busy kernel moves some bytes late
    line.recorder.calls.clear()
    await asyncio.sleep(STALLED_S + 0.1)
    assert "writable" not in line.recorder.calls
    assert STALLED_S < line.link.unacknowledged_s < SOON_S
    await line.read(sent)
    await line.recorder.until("writable")
    assert (line.link.ready, line.link.unacknowledged_s) == (True, 0.0)


@pytest.mark.parametrize("writing", [False, True])
async def test_an_unplugged_device_is_lost_once_with_a_reason_and_not_within_a_write(line: Line, writing: bool) -> None:
    if writing:
        line.link.pause_reading()
    line.unplug()
    if writing:
        line.link.write(b"x")
        assert "lost" not in line.recorder.calls
        assert not line.link.ready
    await line.recorder.until("lost")
    assert (line.recorder.reason or "").startswith("connection lost: ")
    line.link.write(b"x")
    for call in (line.link.pause_reading, line.link.resume_reading, line.link.close, line.link.abort):
        call()
    await asyncio.sleep(0)
    assert (line.link.ready, line.link.unacknowledged_s, line.recorder.calls.count("lost")) == (False, 0.0, 1)


async def test_close_writes_what_waits_first(line: Line) -> None:
    sent = line.fill()
    line.link.close()
    line.link.close()
    line.link.write(b"too late")
    assert await line.read(sent) == bytes(sent)
    await line.recorder.until("lost")
    assert line.recorder.reason == "closed"


async def test_close_waits_for_a_line_that_takes_nothing_only_so_long(line: Line, monkeypatch) -> None:
    monkeypatch.setattr(serial, "CLOSE_S", 0.05)
    line.fill()
    line.link.close()
    await line.recorder.until("lost")


async def test_a_line_in_use_is_refused_and_free_again_after_it(line: Line) -> None:
    with pytest.raises(LinkError, match="another program uses this line"):
        await connect(line.address, Recorder())
    line.link.abort()
    await line.recorder.until("lost")
    await line.connect()
    os.write(line.fd, b"x")
    await line.recorder.until("received", received=1)


@pytest.mark.parametrize(
    ("path", "reason"), [("/dev/no-such-line", "No such file or directory"), (__file__, "Could not configure port")]
)
async def test_what_is_no_serial_line_is_an_error_with_the_reason(path: str, reason: str) -> None:
    with pytest.raises(LinkError, match=reason):
        await connect(SerialAddress(path, 9600), Recorder())


async def test_without_pyserial_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(LinkError, match=r"install zbridge\[serial\]"):
        await connect(SerialAddress("/dev/ttyUSB0", 9600), Recorder())
