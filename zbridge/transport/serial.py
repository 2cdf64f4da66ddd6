"""Serial links: a robot at the end of a serial line, 8 data bits, no parity, 1 stop bit, no flow control.

pyserial (extra ``zbridge[serial]``) opens and configures the line; the event loop reads and writes its descriptor.
Knows no frame, session or protocol.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import os
import struct
import termios
import time
from typing import Any

from zbridge.errors import LinkError
from zbridge.protocol.address import SerialAddress
from zbridge.protocol.kept import Exported
from zbridge.transport.backlog import Backlog
from zbridge.transport.link import STALLED_S, Link, Receiver
from zbridge.transport.transferable import Parcel

READ_BYTES = 4096
"""Most bytes taken from a line before the loop serves others; the kernel's buffer of a terminal holds no more."""
CLOSE_S = 1.0
"""Seconds for a closing line to send what was written before."""
POLL_S = 0.01
"""Seconds between two polls of a closing line whose last bytes are not sent yet."""
_INT = struct.Struct("=i")


class SerialLink(Link):
    """A serial line. Made by :func:`connect`; a line that fails is closed and its receiver told so.

    What the driver does not take at once waits here, and ``ready`` is False meanwhile: one write at most, as long as
    the caller writes only while ``ready`` is True. A write counts as acknowledged when its bytes have left the
    driver's output queue.
    """

    def __init__(self, address: SerialAddress, port: Any, receiver: Receiver) -> None:
        super().__init__(receiver)
        self.peer = str(address)
        self._port = port
        self._fd: int = port.fileno()
        self._loop = asyncio.get_running_loop()
        self._backlog = Backlog()
        self._unwritten = b""
        self._open = True
        self._reading = False
        self._suspended = False
        self._close_by: float | None = None

    def __repr__(self) -> str:
        return f"<SerialLink {self.peer}>"

    def begin(self) -> None:
        """Attach the receiver and begin to read; called once."""
        self.resume_reading()
        self.receiver.attached(self)

    @property
    def descriptors(self) -> tuple[int, ...]:
        return (self._fd,) if self._open else ()

    @property
    def ready(self) -> bool:
        """Whether the driver takes what is written."""
        return self._open and self._close_by is None and not self._unwritten

    def write(self, data: bytes) -> None:
        if not self._open or self._close_by is not None:
            return
        self._backlog.written(len(data), time.monotonic())
        if self._unwritten:
            self._unwritten += data
        else:
            self._write(data)
            if self._unwritten:
                self._loop.add_writer(self._fd, self._write_on)

    @property
    def unacknowledged_s(self) -> float:
        """Seconds for which the oldest byte written has waited in the driver's output queue; see :class:`Link`."""
        backlog = self._backlog
        if backlog.since is None or not self._open:
            return 0.0
        now = time.monotonic()
        if now - backlog.since > STALLED_S:
            backlog.settle(self._unsent())
        return backlog.waited_s(now)

    def pause_reading(self) -> None:
        if self._reading:
            self._reading = False
            self._loop.remove_reader(self._fd)

    def resume_reading(self) -> None:
        if self._open and self._close_by is None and not self._reading and not self._suspended:
            self._reading = True
            self._loop.add_reader(self._fd, self._read)

    def suspend(self) -> None:
        self._suspended = True
        self.pause_reading()

    def resume(self) -> None:
        self._suspended = False
        self.resume_reading()

    def export(self, parcel: Parcel) -> Exported:
        """Put the line into a parcel: its lock goes with the descriptor, and what the driver has is still sent."""
        return {"serial": parcel.put(self._fd)}

    def detach(self) -> None:
        """Give up the own end of a line that another process has now."""
        self.pause_reading()
        self._open = False
        with contextlib.suppress(OSError):
            self._port.close()

    def close(self) -> None:
        """Close the line after what was written, within :data:`CLOSE_S`; idempotent."""
        if self._open and self._close_by is None:
            self.pause_reading()
            self._close_by = self._loop.time() + CLOSE_S
            self._close_when_sent()

    def abort(self) -> None:
        self._end("closed")

    def _read(self) -> None:
        self.reads()
        try:
            data = os.read(self._fd, READ_BYTES)
        except (BlockingIOError, InterruptedError):
            self.receiver.received(b"")  # who watches the reads learns that nothing was taken
            return
        except OSError as error:
            self._end(f"connection lost: {error.strerror or error}")
            return
        if data:
            self.receiver.received(data)
        else:  # Linux shows an unplugged device as one that is always readable and has nothing to read
            self._end("connection lost: the device is gone")

    def _write(self, data: bytes) -> None:
        """Give the driver what it takes of ``data``; keep the rest."""
        try:
            self._unwritten = data[os.write(self._fd, data) :]
        except (BlockingIOError, InterruptedError):
            self._unwritten = data
        except OSError as error:
            self._end(f"connection lost: {error.strerror or error}")

    def _write_on(self) -> None:
        self._write(self._unwritten)
        if self._open and not self._unwritten:
            self._loop.remove_writer(self._fd)
            if self._close_by is None:
                self.receiver.writable()

    def _close_when_sent(self) -> None:
        """Poll until the output queue is empty, or time is up: the kernel itself would block in ``close``."""
        if not self._open or self._close_by is None:
            return
        if self._unsent() and self._loop.time() < self._close_by:
            self._loop.call_later(POLL_S, self._close_when_sent)
        else:
            self._end("closed")

    def _unsent(self) -> int:
        """Count the bytes that were written and have not left the driver's output queue."""
        queued = 0
        with contextlib.suppress(OSError):  # the device is gone; the next read or write tells
            (queued,) = _INT.unpack(fcntl.ioctl(self._fd, termios.TIOCOUTQ, bytes(_INT.size)))
        return queued + len(self._unwritten)

    def _end(self, reason: str) -> None:
        """Close the line and tell the receiver, later: the caller may be in the middle of a write."""
        if not self._open:
            return
        self.pause_reading()
        if self._unwritten:
            self._loop.remove_writer(self._fd)
        if self._unsent():  # else the kernel waits in close for bytes that nobody takes
            with contextlib.suppress(OSError, termios.error):  # the device is gone, and its output queue with it
                termios.tcflush(self._fd, termios.TCOFLUSH)
        self._open, self._unwritten = False, b""
        with contextlib.suppress(OSError):
            self._port.close()
        self._loop.call_soon(self.receiver.lost, reason)


def connect(address: SerialAddress, receiver: Receiver) -> SerialLink:
    """Open the line for this process alone; raise LinkError if it is missing, in use, or cannot be configured.

    Runs on the event loop: a line opens within milliseconds, whether anybody is at its other end or not.
    """
    link = SerialLink(address, _opened(address), receiver)
    link.begin()
    return link


def attach(address: SerialAddress, descriptor: int, receiver: Receiver) -> SerialLink:
    """Use a line that another process opened and configured."""
    link = SerialLink(address, os.fdopen(descriptor, "r+b", buffering=0), receiver)
    link.begin()
    return link


def _opened(address: SerialAddress) -> Any:
    try:
        import serial
    except ImportError as error:
        raise LinkError(f"{address}: serial lines need pyserial: install zbridge[serial]") from error
    try:
        return serial.Serial(address.path, address.baud, exclusive=True, timeout=0, write_timeout=0)
    except (OSError, ValueError, OverflowError, termios.error) as error:
        raise LinkError(f"{address}: {_explained(error)}") from error


def _explained(error: Exception) -> str:
    """Return why a line could not be opened; pyserial's errors repeat the path and hide the number."""
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EBUSY):
        return "another program uses this line"
    return os.strerror(number) if number else str(error)
