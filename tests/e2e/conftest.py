"""Real processes, real sockets, real Zenoh, all on loopback; every process is ended by its id."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgpack
import pytest
import zenoh

from tests.machine import Patience, Withheld, contended_s
from tests.proofs import Holder, packed

T = TypeVar("T")
WAIT_S = 10.0


_PORTS = range(20_000, 32_000)
"""Below those that the kernel gives to connections."""
_WORKERS = 16
_given: set[int] = set()


def _own_ports() -> range:
    """Give the ports of this process: each worker of pytest-xdist has its own, as they know nothing of each other."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    return _PORTS if worker is None else _PORTS[int(worker.removeprefix("gw")) % _WORKERS :: _WORKERS]


def free_port() -> int:
    """Find a port, for TCP and UDP, that nobody is given by chance: what listens there may be away for a while."""
    while True:
        port = random.choice(_own_ports())
        if port in _given:
            continue
        _given.add(port)
        with contextlib.suppress(OSError), socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind(("127.0.0.1", port))
            udp.bind(("127.0.0.1", port))
            return port


def until(condition: Callable[[], T], timeout_s: float = WAIT_S, what: str = "condition") -> T:
    """Wait until ``condition()`` is true and give its value. A busy machine puts the timeout off."""
    patience = Patience(timeout_s)
    while True:
        over = patience.over
        value = condition()
        if value:
            return value
        if over:
            raise AssertionError(f"{what} not within {timeout_s} s")
        time.sleep(0.01)


def start(*arguments: str, **popen: Any) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "zbridge", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        **popen,
    )


def end(process: subprocess.Popen[str], number: int = signal.SIGTERM, within_s: float = 5.0) -> str:
    """End a process by its id, within so many seconds unless the machine is busy; give what it printed."""
    if process.poll() is None:
        process.send_signal(number)
    patience = Patience(within_s)
    while True:
        try:
            return process.communicate(timeout=0.2)[0]
        except subprocess.TimeoutExpired:
            if patience.over:
                process.kill()


class Lease:
    """The lease of one robot by plain Zenoh and MessagePack, renewed on a thread until it is closed or has ended."""

    def __init__(self, session: zenoh.Session, robot: str, how: str, wishes: dict[str, Any]) -> None:
        self._session = session
        self._key = f"fleet/{robot}/@rpc/control/"
        self.answer = self._ask(f"{how}/{wishes['who']}", packed(wishes))
        assert self.answer["ok"], self.answer
        self.held = Holder.of(self.answer, robot)
        self._closed = threading.Event()
        threading.Thread(target=self._renew, daemon=True).start()

    def _ask(self, name: str, payload: bytes) -> dict[str, Any]:
        """Ask one thing about the lease; an error is no answer."""
        for reply in self._session.get(self._key + name, payload=payload, timeout=3.0):
            if reply.ok is not None:
                answer: dict[str, Any] = msgpack.unpackb(reply.ok.payload.to_bytes())
                return answer
        return {"ok": False, "reason": f"no answer to {name}"}

    def _renew(self) -> None:
        with contextlib.suppress(zenoh.ZError):  # the session was closed
            while not self._closed.wait(self.answer["expires_in_s"] / 3):
                if not self._ask("renew", self.held.question("renew"))["ok"]:
                    return

    def release(self) -> dict[str, Any]:
        """Give the lease back."""
        self.close()
        return self._ask("release", self.held.question("release"))

    def close(self) -> None:
        """Renew it no longer."""
        self._closed.set()


class Fleet:
    """A Zenoh session of the test, what it saw, and the robots it holds."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.seen: dict[str, list[dict[str, Any]]] = {}
        self._leases: dict[str, Lease] = {}
        self._subscriber = session.declare_subscriber("fleet/**", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        fields = msgpack.unpackb(sample.payload.to_bytes())
        self.seen.setdefault(str(sample.key_expr), []).append({**fields, "at": time.monotonic()})

    def last(self, path: str) -> dict[str, Any]:
        return (self.seen.get(f"fleet/{path}") or [{}])[-1]

    def get(self, key: str, timeout_s: float = 3.0, **fields: Any) -> list[Any]:
        """Plain get: the decoded replies, errors too."""
        payload = msgpack.packb(fields) if fields else None
        return [
            msgpack.unpackb((reply.ok or reply.err).payload.to_bytes())
            for reply in self.session.get(key, payload=payload, timeout=timeout_s)
        ]

    def hold(self, robot: str, who: str = "test", *, how: str = "acquire", **wishes: Any) -> Lease:
        """Acquire a robot and keep its lease; from now on every command for it is the holder's."""
        self.let_go(robot)
        lease = self._leases[robot] = Lease(self.session, robot, how, {"who": who, **wishes})
        return lease

    def let_go(self, robot: str) -> None:
        """Renew the lease no longer, and command without it."""
        lease = self._leases.pop(robot, None)
        if lease is not None:
            lease.close()

    def put(self, path: str, **fields: Any) -> None:
        self.put_payload(path, msgpack.packb(fields))

    def put_payload(self, path: str, payload: bytes) -> None:
        robot, _, command = path.partition("/@cmd/")
        lease = self._leases.get(robot)
        self.session.put(
            f"fleet/{path}",
            payload,
            attachment=lease.held.attachment(command, payload) if lease is not None else None,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def close(self) -> None:
        """Renew nothing any more."""
        for robot in tuple(self._leases):
            self.let_go(robot)

    def tokens(self, key: str = "fleet/*/@alive/gateway") -> list[str]:
        return [str(reply.ok.key_expr) for reply in self.session.liveliness().get(key, timeout=2) if reply.ok]

    def state(self, robot: str) -> str | None:
        return self.last(f"{robot}/status").get("state")


class Bench:
    """Everything a test starts."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self.folder = folder
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._stack = stack
        self._processes: list[int] = []
        self._withheld = Withheld()
        self.fleet = Fleet(self._stack.enter_context(self.router()))
        self._stack.callback(lambda: self.fleet.close())

    def router(self) -> zenoh.Session:
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", f'["{self.endpoint}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        return zenoh.open(config)

    def zbridge(self, *arguments: str, **popen: Any) -> subprocess.Popen[str]:
        process = start(*arguments, **popen)
        self.count(process.pid)
        self._stack.callback(end, process, signal.SIGKILL)
        return process

    def count(self, pid: int) -> None:
        """Count what is withheld from this process too."""
        self._processes.append(pid)

    def ended_within(self, process: subprocess.Popen[str], seconds: float) -> None:
        """Wait for the end of a process.

        A busy machine excuses as long as anything waited for a processor: a process that has ended cannot be asked.
        """
        contended, began = contended_s(), time.monotonic()
        until(lambda: process.poll() is not None, what="the end of the process")
        took_s = time.monotonic() - began
        assert took_s < seconds + contended_s() - contended, f"it took {took_s:.2f} s"

    @property
    def withheld_s(self) -> float:
        """The processor time that was withheld so far from this process and those it started: what excuses a delay."""
        return self._withheld.seconds(self._processes)

    def simulator(self, port: int, protocol: str = "tcpudp", *more: str) -> subprocess.Popen[str]:
        process = self.zbridge("simulate", protocol, "--listen", f"tcp://127.0.0.1:{port}", *more)
        assert process.stdout is not None
        assert "listening" in process.stdout.readline()
        return process

    def configuration(self, robot: str, port: int, more: str = "") -> Path:
        file = self.folder / f"{robot}.toml"
        file.write_text(
            f'[robot]\nname = "{robot}"\n'
            f'[device]\nprotocol = "tcpudp"\nconnect = ["tcp://127.0.0.1:{port}"]\n'
            f'[bus]\nconnect = ["{self.endpoint}"]\nmulticast = false\n{more}'
        )
        return file

    def gateway(self, robot: str, port: int, more: str = "") -> subprocess.Popen[str]:
        return self.zbridge("run", str(self.configuration(robot, port, more)))

    def serve(self, robot: str, port: int, more: str = "") -> subprocess.Popen[str]:
        """Start a gateway and wait until its robot is established."""
        process = self.gateway(robot, port, more)
        until(lambda: self.fleet.state(robot) == "established", what="established")
        return process


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with contextlib.ExitStack() as stack:
        yield Bench(tmp_path, stack)
