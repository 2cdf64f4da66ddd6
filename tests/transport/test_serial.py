"""Serial links over pairs of pseudo-terminals, on both event loops."""

import asyncio
import os
import sys
import termios
import tty
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.transport.recorder import SOON_S, Recorder
from zbridge.errors import LinkError
from zbridge.protocol.address import SerialAddress
from zbridge.transport import serial
from zbridge.transport.by_address import connect
from zbridge.transport.link import STALLED_S
from zbridge.transport.serial import SerialLink

pytestmark = pytest.mark.both_loops


class Device:
    """The far end of a serial line."""

    def __init__(self) -> None:
        self.fd, self._near = os.openpty()
        tty.setraw(self._near)
        os.set_blocking(self.fd, False)
        self.address = SerialAddress(os.ttyname(self._near), 57600)

    def settings(self) -> list[Any]:
        return termios.tcgetattr(self._near)

    def write(self, data: bytes) -> None:
        os.write(self.fd, data)

    async def read(self, size: int) -> bytes:
        """Read ``size`` bytes; whoever writes goes on meanwhile."""
        data = b""
        async with asyncio.timeout(SOON_S):
            while len(data) < size:
                try:
                    data += os.read(self.fd, size - len(data))
                except BlockingIOError:
                    await asyncio.sleep(0.001)
        return data

    def unplug(self) -> None:
        for fd in (self.fd, self._near):
            if fd >= 0:
                os.close(fd)
        self.fd = self._near = -1


@pytest.fixture
def device() -> Iterator[Device]:
    made = Device()
    yield made
    made.unplug()


Line = tuple[SerialLink, Recorder]


async def connected(device: Device) -> Line:
    recorder = Recorder()
    link = await connect(device.address, recorder)
    assert isinstance(link, SerialLink)
    assert recorder.link is link
    return link, recorder


@pytest.fixture
async def line(device: Device) -> AsyncIterator[Line]:
    """A link over the line, and what it brings."""
    link, recorder = await connected(device)
    yield link, recorder
    link.abort()
    await recorder.until("lost")


def fill(link: SerialLink) -> int:
    """Write until the line takes no more; return how much."""
    sent = 0
    while link.ready:
        link.write(bytes(1000))
        sent += 1000
        assert sent < 1_000_000
    return sent


async def test_bytes_go_both_ways_whatever_they_are(device: Device) -> None:
    every_byte = bytes(range(256))
    link, recorder = await connected(device)
    assert (link.peer, link.ready, link.silent_s) == (str(device.address), True, 0.0)
    link.write(every_byte)
    assert await device.read(256) == every_byte
    device.write(every_byte)
    await recorder.until("received", received=256)
    assert recorder.data == every_byte
    link.abort()
    await recorder.until("lost")
    assert recorder.calls.count("lost") == 1


@pytest.mark.usefixtures("line")
async def test_the_line_has_the_configured_speed(device: Device) -> None:
    assert device.settings()[4:6] == [termios.B57600, termios.B57600]


async def test_a_line_that_takes_nothing_is_not_ready_until_it_takes_again(device: Device, line: Line) -> None:
    link, recorder = line
    sent = fill(link)
    assert "writable" not in recorder.calls
    await device.read(sent)
    await recorder.until("writable")
    assert link.ready


async def test_what_the_line_does_not_carry_is_unacknowledged(device: Device, line: Line) -> None:
    link, recorder = line
    assert link.unacknowledged_s == 0.0
    sent = fill(link)
    await asyncio.sleep(STALLED_S + 0.1)
    assert STALLED_S < link.unacknowledged_s < SOON_S
    await device.read(sent)
    await recorder.until("writable")
    assert link.unacknowledged_s == 0.0


async def test_nothing_is_read_while_paused(device: Device, line: Line) -> None:
    link, recorder = line
    link.pause()
    link.pause()
    device.write(b"abc")
    await asyncio.sleep(0.02)
    assert not recorder.data
    link.resume()
    link.resume()
    await recorder.until("received", received=3)


async def test_an_unplugged_device_is_lost_with_a_reason(device: Device, line: Line) -> None:
    link, recorder = line
    device.unplug()
    await recorder.until("lost")
    assert recorder.reason is not None
    assert recorder.reason.startswith("connection lost: ")
    link.write(b"x")
    link.pause()
    link.resume()
    link.close()
    link.abort()
    await asyncio.sleep(0)
    assert (link.ready, link.unacknowledged_s, recorder.calls.count("lost")) == (False, 0.0, 1)


async def test_a_write_to_an_unplugged_device_is_lost_later_and_not_within_the_write(device, line) -> None:
    link, recorder = line
    link.pause()
    device.unplug()
    link.write(b"x")
    assert "lost" not in recorder.calls
    assert not link.ready
    await recorder.until("lost")


async def test_close_writes_what_waits_first(device: Device, line: Line) -> None:
    link, recorder = line
    sent = fill(link)
    link.close()
    link.close()
    link.write(b"too late")
    assert await device.read(sent) == bytes(sent)
    await recorder.until("lost")
    assert recorder.reason == "closed"


async def test_close_waits_for_a_line_that_takes_nothing_only_so_long(device, monkeypatch, line) -> None:
    monkeypatch.setattr(serial, "CLOSE_S", 0.05)
    link, recorder = line
    fill(link)
    link.close()
    await recorder.until("lost")


async def test_a_line_in_use_is_refused_and_free_again_after_it(device: Device, line: Line) -> None:
    link, recorder = line
    with pytest.raises(LinkError, match="another program uses this line"):
        await connect(device.address, Recorder())
    link.abort()
    await recorder.until("lost")
    link, recorder = await connected(device)
    device.write(b"x")
    await recorder.until("received", received=1)
    link.abort()
    await recorder.until("lost")


async def test_datagrams_are_nobodys(device: Device, line: Line) -> None:
    link, _ = line
    link.write_datagram(b"lost")
    link.drop_source()
    link.write(b"kept")
    assert await device.read(4) == b"kept"


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


async def test_a_device_that_is_plugged_in_again_is_connected_again(device: Device, tmp_path: Path) -> None:
    line = tmp_path / "robot"
    line.symlink_to(device.address.path)
    address = SerialAddress(str(line), 57600)
    recorder = Recorder()
    await connect(address, recorder)
    device.unplug()
    await recorder.until("lost")
    again = Device()
    line.unlink()
    line.symlink_to(again.address.path)
    recorder = Recorder()
    link = await connect(address, recorder)
    again.write(b"back")
    await recorder.until("received", received=4)
    link.close()
    await recorder.until("lost")
    again.unplug()
