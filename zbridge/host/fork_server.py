"""The fork server: a process that imported everything, and forks a gateway process on request. Opens no bus.

Theory of operation. The supervisor starts the server as a program, so that its code is what is installed then. It
imports what a gateway needs, sends :class:`Ready`, and waits for requests. A gateway is forked twice: the process in
between ends at once, and the gateway becomes a child of the supervisor, which is the reaper of its descendants. So the
server may end, or be replaced, at any time, and no gateway notices.

A fork takes only the thread that forks: the server must have one thread. It runs no event loop, and a forked process
begins with the channel, the standard streams and nothing else that is open, and with the signals of a new process.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import NoReturn

import msgspec

from zbridge.app.config import plan
from zbridge.errors import ZbridgeError, describe
from zbridge.host.fd_channel import FdChannel, Fork, Forked, Ready, Rehearse, close_all
from zbridge.host.replacement import restore
from zbridge.protocol.plugin import find_protocol, protocol_names

IMPORTED = ("numpy", "uvloop", "serial", "encodings.idna", "zbridge.bus.zenoh", "zbridge.app.gateway")
"""What a gateway imports late; what is not installed is left out."""
_NAME_BYTES = 15
"""Bytes of a process's name in the kernel."""


class Birth(msgspec.Struct, frozen=True):
    """What a forked gateway begins with: the request, and its descriptors. content: of its file, in memory.

    take_over: -1: nobody to take over from.
    """

    request: Fork
    channel: int
    content: int
    take_over: int = -1

    def read(self) -> bytes:
        """Read the content of the file, and close its descriptor."""
        with os.fdopen(self.content, "rb") as file:
            file.seek(0)
            return file.read()


Run = Callable[[Birth], int]
"""``run(birth)``: be a gateway until it ends; returns the exit code."""


def serve(control: FdChannel, run: Run) -> None:
    """Import everything, then fork gateways until the other end of ``control`` is closed."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the supervisor ends this process, by closing its end
    _import_all()
    gc.collect()
    gc.freeze()
    control.send(Ready(threads()))
    while True:
        select.select([control], [], [])
        try:
            received = control.receive()
        except (BlockingIOError, ValueError):
            continue
        if received is None:
            return
        request, descriptors = received
        if isinstance(request, Fork) and len(descriptors) > 1:
            control.send(_forked(control, request, descriptors, run))
        elif isinstance(request, Rehearse) and descriptors:
            control.send(_rehearsed(descriptors[0]))
        close_all(descriptors)


def threads() -> int:
    """Count the threads of this process, those of libraries too."""
    return len(os.listdir("/proc/self/task"))


def _import_all() -> None:
    for name in IMPORTED:
        with contextlib.suppress(ImportError):
            import_module(name)
    for name in protocol_names():
        with contextlib.suppress(Exception):  # its own gateways say why; they share what the first check makes
            find_protocol(name)
            plan({"robot": {"name": "r1"}, "device": {"protocol": name, "connect": ["tcp://127.0.0.1:1"]}})


def _forked(control: FdChannel, request: Fork, descriptors: list[int], run: Run) -> Forked:
    """Fork twice; answer with the process id of the second."""
    if (count := threads()) != 1:
        return Forked(0, f"the fork server has {count} threads")
    pipe: tuple[int, ...] = ()
    try:
        reader, writer = pipe = os.pipe()
        middle = os.fork()
    except OSError as error:
        close_all(pipe)
        return Forked(0, f"fork: {error.strerror}")
    if not middle:
        _be_middle(writer, request, descriptors, run)
    os.close(writer)
    with os.fdopen(reader, "rb") as answer:
        pid = answer.read()
    os.waitpid(middle, 0)
    return Forked(int(pid)) if pid else Forked(0, "fork: the process in between failed")


def _rehearsed(state: int) -> Forked:
    """Do what the installed code does first in place of a supervisor."""
    try:
        import_module("zbridge.cli.supervise")
        restore(state)
    except Exception as error:  # whatever is wrong with the installed code
        why = str(error) if isinstance(error, ZbridgeError) else describe(error)
        return Forked(0, f"the installed code does not start: {why}")
    return Forked(os.getpid())


def _be_middle(writer: int, request: Fork, descriptors: list[int], run: Run) -> NoReturn:
    """Fork the gateway, write its process id to the pipe, and end."""
    try:
        pid = os.fork()
        if not pid:
            _be_gateway(request, descriptors, run)
        os.write(writer, str(pid).encode())
    finally:
        os._exit(0)


def _be_gateway(request: Fork, descriptors: list[int], run: Run) -> NoReturn:
    """Become a process like one that was just started, and run; never return into the server."""
    code = 1
    try:
        os.setsid()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _close_others({0, 1, 2, *descriptors})
        Path("/proc/self/comm").write_bytes(f"zb {request.robot}".encode()[:_NAME_BYTES])
        code = run(Birth(request, *descriptors[:3]))
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        os._exit(code)


def _close_others(open_descriptors: set[int]) -> None:
    for number in {int(name) for name in os.listdir("/proc/self/fd")} - open_descriptors:
        with contextlib.suppress(OSError):  # the descriptor by which the folder was listed
            os.close(number)
